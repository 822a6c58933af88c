# SPDX-License-Identifier: Apache-2.0
"""States of the nodes for 3D Slicer: lines, ages, and times of transmission."""

from __future__ import annotations

from needle_insertion.slicer.needle import NodeStates
from support.watched import report


def test_states_are_due_for_a_new_peer_after_a_change_and_each_second() -> None:
    states = NodeStates()
    states.take(report('plant', 'running'), 10.0)
    assert not states.is_due('', 10.0)
    assert states.is_due('a', 10.0)
    states.take(report('plant', 'running'), 10.5)
    assert not states.is_due('a', 10.5)
    states.take(report('plant', 'running', level=1), 10.6)
    assert states.is_due('a', 10.6)
    assert not states.is_due('a', 11.5)
    assert states.is_due('b', 11.5)
    assert states.is_due('b', 12.5)
    states.mark_changed(12.6)
    assert states.is_due('b', 12.6)


def test_lines_show_silent_nodes_and_omit_removed_nodes() -> None:
    states = NodeStates()
    states.take(report('recorder', 'unknown level', level=9), 0.0)
    states.take(report('plant', 'halted', level=2), 52.0)
    assert states.lines(58.0) == [
        'plant [ERROR, silent for 6 s]: halted',
        'recorder [9, silent for 58 s]: unknown level',
    ]
    assert states.lines(61.0) == ['plant [ERROR, silent for 9 s]: halted']


def test_number_of_nodes_is_limited() -> None:
    states = NodeStates()
    for number in range(30):
        states.take(report(f'node_{number:02d}', 'idle'), 0.0)
    states.take(report('node_00', 'active'), 1.0)
    lines = states.lines(1.0)
    assert len(lines) == 20
    assert lines[0] == 'node_00 [OK]: active'
