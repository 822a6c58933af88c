# SPDX-License-Identifier: Apache-2.0
"""Nodes that are suspended during an insertion in real time do not cause a lunge."""

from __future__ import annotations

from benchmarks.stalls import LIMIT, measure, Stall, START
import pytest

#: Durations of the stalls [s]: within the timeouts of plant and controller, and longer.
DURATIONS = (0.08, 0.6, 0.15)


@pytest.mark.requirement('S-213')
@pytest.mark.parametrize(
    ('request_kind', 'victim'),
    [('target', 'plant'), ('path', 'controller'), ('steering', 'steering')],
)
def test_suspended_node_does_not_cause_a_lunge(request_kind: str, victim: str) -> None:
    """The needle remains near the limits of the reference, with another loaded process."""
    stalls = [Stall(victim, 0.3, lasts) for lasts in DURATIONS]
    inward, outward, depth = measure(request_kind, stalls, load=1, rate=200.0)
    # Before, velocities were up to 41 mm/s. The overshoot is discussed in test_hold.py.
    assert max(inward, outward) < 2.0 * LIMIT
    assert depth > (START if request_kind != 'steering' else 0.001)
