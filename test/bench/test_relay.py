"""Steered insertions through real nodes, with a relay that drops or delays a message."""

from pathlib import Path

from benchmarks.relay import choose, Fault, insert, Link, LINKS
from needle_ros import contract
import numpy as np
import pytest

MOTION = Link('steering', 'controller', contract.JOINT_TRAJECTORY)
GUIDE = Link('steering', 'plant', contract.JOINT_TRAJECTORY)
WISH = Link('user', 'steering', contract.TARGET)
ANSWER = Link('steering', 'user', contract.DIAGNOSTICS)
COMMAND = Link('controller', 'plant', contract.WRENCH_COMMAND)


@pytest.mark.parametrize(
    ('fault', 'continuous'),
    [
        (Fault(MOTION, 2, 'drop', 0.0), False),
        (Fault(MOTION, 1, 'drop', 0.0), True),
        (Fault(GUIDE, 1, 'drop', 0.0), False),
        (Fault(MOTION, 2, 'delay', 0.95), False),
        (Fault(MOTION, 3, 'duplicate', 0.9), False),
        (Fault(WISH, 1, 'drop', 0.0), False),
        (Fault(ANSWER, 1, 'drop', 0.0), True),
        (Fault(COMMAND, 20, 'drop', 0.0), False),
    ],
)
def test_an_insertion_with_a_fault_reaches_its_target(
    tmp_path: Path, fault: Fault, continuous: bool
) -> None:
    outcome = insert(fault, tmp_path, continuous=continuous)
    assert outcome.end == 'target', outcome.line
    assert outcome.struck


def test_faults_are_chosen_among_all_links_and_messages() -> None:
    """The same for a seed."""
    rng, again = np.random.default_rng(1), np.random.default_rng(1)
    counts = insert_counts()
    faults = [choose(counts, rng) for _ in range(300)]
    assert faults == [choose(counts, again) for _ in range(300)]
    assert {fault.link for fault in faults} == {*LINKS}
    assert all(1 <= fault.number <= counts[fault.link] for fault in faults)
    assert all(0.0 <= fault.delay <= 1.0 for fault in faults)


def insert_counts() -> dict[Link, int]:
    """Return some numbers of messages."""
    return {link: 5 + k for k, link in enumerate(LINKS)}
