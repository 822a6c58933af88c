# SPDX-License-Identifier: Apache-2.0
"""Charts of `needle watch`: thinned signals, and comparison of recordings."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_identification import BagWriter
from needle_insertion.watch import recorded
from needle_insertion.watch.live import RecordedReader
from needle_insertion.watch.recorded import compare, ShownRecording
from needle_ros import contract
import numpy as np
import pytest
from support.samples import EPOCH


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(201, 3000))
def test_extremes_of_long_recordings_are_kept(seed: int, count: int) -> None:
    """Smallest and largest value of each interval, whatever the number of earlier thinnings."""
    random = np.random.default_rng(seed)
    # Whole microseconds: the page has no finer times.
    times = np.cumsum(random.integers(500, 1500, count)) / 1e6
    values = random.normal(size=count)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recorded, '_MOST', 100)
        curve = recorded._Curve()
        for time, value in zip(times.tolist(), values.tolist(), strict=True):
            curve.add(time, value)
        points = curve.points()
    assert points is not None
    assert None not in points[1]
    assert len(points[0]) <= 100
    shown, intervals = (np.floor(one / curve._interval) for one in (np.array(points[0]), times))
    for interval in np.unique(intervals):
        drawn = np.array(points[1])[shown == interval]
        true = values[intervals == interval]
        assert (drawn.min(), drawn.max()) == (true.min(), true.max())


def test_gap_of_a_long_recording_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """One pause gives one gap, at its end."""
    monkeypatch.setattr(recorded, '_MOST', 100)
    curve = recorded._Curve()
    for time in np.arange(0.0, 10.0, 0.01):
        if not 4.0 < time < 7.0:
            curve.add(time, 1.0)
    points = curve.points()
    assert points is not None
    (at,) = [time for time, value in zip(*points, strict=True) if value is None]
    assert at == pytest.approx(7.0, abs=curve._interval)


def insertion(path: Path, delay: float, speed: float = 0.02) -> ShownRecording:
    """Record a needle that rests for a delay [s] and then moves for 2 s, at 100 Hz."""
    write = contract.JOINT_STATES.template().serialize
    with BagWriter(path) as bag:
        bag.add_topic('/joint_states', contract.JOINT_STATES.type_name)
        for time in np.arange(0.0, delay + 2.0, 0.01).tolist():
            stamp = EPOCH + round(1e9 * time)
            depth = 0.03 + speed * max(0.0, time - delay)
            bag.write('/joint_states', write(stamp, depth, *[0.0] * 5), stamp)
    return ShownRecording(path)


def test_compared_recordings_start_to_move_together(tmp_path: Path) -> None:
    """Signals and needle of the second are at its time plus the shift, which the page states."""
    first, other = insertion(tmp_path / 'a', 1.5), insertion(tmp_path / 'b', 0.4)
    found = compare(first, other)
    # Both are found at a sample.
    assert found.shift == pytest.approx(1.1, abs=1e-6)
    assert 'b: times shifted by +1.100 s, so that both move at 1.51' in found.words
    sent = found.content()
    times, depths = sent['signals']['depth']
    here, same = first.signals()['depth']
    for time in (1.6, 2.0, 3.0):
        assert np.interp(time, times, depths) == pytest.approx(np.interp(time, here, same))
        at = found.needle(time)
        assert at is not None
        # The newest samples, 10 ms apart, at 20 mm/s.
        tip = first.view(time).frame(time)['needle'][1][-1]
        assert at[1][-1] == pytest.approx(tip, abs=2.1e-4)
    # Before its first and after its last message the second has no needle.
    assert found.needle(1.0) is None
    assert (sent['begin'], sent['end']) == pytest.approx((1.1, 1.1 + other.duration))


def test_compared_recordings_have_different_names(tmp_path: Path) -> None:
    """Also sessions, whose bags are all folders with the name `bag`."""
    first, other = (insertion(tmp_path / name / 'bag', 0.5) for name in 'ab')
    found = compare(first, other)
    assert (first.name, other.name) == (str(tmp_path / 'a/bag'), str(tmp_path / 'b/bag'))
    assert found.words.startswith(f'{other.name}: times shifted by ')
    assert compare(first, first).recording.name == first.name


def test_recordings_are_aligned_by_a_stated_time(tmp_path: Path) -> None:
    """Also if the needle rests; without a time, the page states that they are not aligned."""
    first, still = insertion(tmp_path / 'a', 0.5), insertion(tmp_path / 'b', 0.5, speed=0.0)
    assert compare(first, still, -2.5).shift == -2.5
    found = compare(first, still)
    assert (found.shift, found.words) == (0.0, 'not aligned: the needle does not move in b')
    reader = RecordedReader(first, found)
    content = json.loads(asyncio.run(reader.next()))
    assert content['other']['words'] == found.words
    assert content['frame']['other'][1][-1] == pytest.approx(0.03)
