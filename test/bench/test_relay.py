# SPDX-License-Identifier: Apache-2.0
"""Steered insertions through real nodes, with a relay that drops or delays a message."""

from pathlib import Path
from typing import Any

from benchmarks.relay import choose, insert, LINKS, MessageFault, Relay, TopicLink
from needle_ros import contract
import numpy as np
import pytest

MOTION = TopicLink('steering', 'controller', contract.JOINT_TRAJECTORY)
GUIDE = TopicLink('steering', 'plant', contract.JOINT_TRAJECTORY)
WISH = TopicLink('user', 'steering', contract.TARGET)
ANSWER = TopicLink('steering', 'user', contract.DIAGNOSTICS)
COMMAND = TopicLink('controller', 'plant', contract.WRENCH_COMMAND)


@pytest.mark.parametrize(
    ('fault', 'continuous'),
    [
        (MessageFault(MOTION, 2, 'drop', 0.0), False),
        (MessageFault(MOTION, 1, 'drop', 0.0), True),
        (MessageFault(GUIDE, 1, 'drop', 0.0), False),
        (MessageFault(MOTION, 2, 'delay', 0.95), False),
        (MessageFault(MOTION, 3, 'duplicate', 0.9), False),
        (MessageFault(WISH, 1, 'drop', 0.0), False),
        (MessageFault(ANSWER, 1, 'drop', 0.0), True),
        (MessageFault(COMMAND, 20, 'drop', 0.0), False),
    ],
)
def test_insertion_with_message_fault_reaches_target(
    tmp_path: Path, fault: MessageFault, continuous: bool
) -> None:
    outcome = insert(fault, tmp_path, continuous=continuous)
    assert outcome.end == 'target', outcome.line
    assert outcome.struck


def test_random_faults_cover_all_links_and_messages() -> None:
    """The choice is reproducible for a seed."""
    rng, again = np.random.default_rng(1), np.random.default_rng(1)
    counts = insert_counts()
    faults = [choose(counts, rng) for _ in range(300)]
    assert faults == [choose(counts, again) for _ in range(300)]
    assert {fault.link for fault in faults} == {*LINKS}
    assert all(1 <= fault.number <= counts[fault.link] for fault in faults)
    assert all(0.0 <= fault.delay <= 1.0 for fault in faults)


def insert_counts() -> dict[TopicLink, int]:
    """Return a number of messages for each link."""
    return {link: 5 + k for k, link in enumerate(LINKS)}


def test_clock_continues_after_late_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An older clock message arrives while the plant waits for the answer to a newer sample."""
    clock, before = TopicLink('plant', 'controller', contract.CLOCK), []
    take = Relay._take

    def late(self: Relay, sinks: Any, data: bytes) -> None:
        take(self, sinks, data)
        if self.armed and clock in [link for link, _ in sinks]:
            before.append(data)
            if len(before) == 300:
                dict(sinks)[clock](before[260])

    monkeypatch.setattr(Relay, '_take', late)
    assert insert(None, tmp_path).end == 'target'
    assert len(before) > 300
