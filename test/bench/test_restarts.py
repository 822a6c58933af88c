# SPDX-License-Identifier: Apache-2.0
"""Outcomes of interrupted insertions."""

from __future__ import annotations

from benchmarks.random_insertions import repeat
from benchmarks.restarts import names_action
import pytest
from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.logging import get_logger


@pytest.mark.parametrize(
    ('line', 'named'),
    [
        ('the insertion cannot be resumed: retract the needle to 1.00 mm first', True),
        ('the needle is at 20.00 mm and has been steered; retract it to 1.00 mm first', True),
        ('steering: target rejected: stopped: the sensor is frozen; ~/clear_stop releases', True),
        ('steering: target rejected: no joint_states received within 5 s', False),
        ('steering: no answer to target within 6 s', False),
        ('insertion is at 30 mm, not at 35 mm: joint_trajectory sent 4 times', False),
        ('steering: target rejected: paused; wait until the retraction has ended', False),
    ],
)
def test_only_documented_lines_name_an_action(line: str, named: bool) -> None:
    """A line that only mentions a sent message or a wait is a failure."""
    assert names_action(line) is named


@pytest.mark.parametrize('end', ['target', 'hangs'])
def test_status_is_that_of_the_worst_end(end: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Each insertion is a cell of the table, and one bad end misses the bar."""
    ends = iter(['target', end])
    status = repeat(
        lambda number, _rng, _logs: ('moving', next(ends), f'number {number}'),
        ('target',),
        ('hangs',),
        'killed while',
        2,
        1,
    )
    said = capsys.readouterr().out
    good = 2 - (end == 'hangs')
    assert f'| moving       | {good}      | {2 - good}     |' in said
    assert '1: number 1\n' in said
    assert status == (end == 'hangs')
    assert said.splitlines()[-1].startswith('missed' if status else 'met')
    # The level is that of the process, also of later tests.
    assert get_logger('plant').is_enabled_for(LoggingSeverity.ERROR)
