# SPDX-License-Identifier: Apache-2.0
"""Running topics as a recording: the same friction as from a bag, in any order of messages."""

from collections.abc import Iterable
from contextlib import suppress
from math import inf, nan
from pathlib import Path

from benchmarks.noises import FURTHER, NoiseKind, recorded
from hypothesis import given, settings
from hypothesis import strategies as st
from needle_dynamics import ParameterError
from needle_identification import (
    FrictionSettings,
    identify_friction,
    LiveRecording,
    read_friction_recording,
    Recording,
    RecordingError,
)
from needle_identification.bags.writer import BagWriter
from needle_ros.contract import BASE_WRENCH, JOINT_STATES
from needle_ros.errors import NeedleError
import numpy as np
from numpy.testing import assert_array_equal
import pytest
from support.samples import IDEAL, simulated, TRUTH

#: Strokes in both directions at two speeds, long enough for the filter to settle.
LEGS = tuple(
    leg for speed in (3e-3, 8e-3) for leg in ((0.0, 0.3), (speed, 1.2), (0.0, 0.3), (-speed, 1.2))
)
RECORDING = simulated(LEGS, sensor=IDEAL)
BEGIN = 1_700_000_000_000_000_000

#: Stamp [ns], depth [m], velocity [m/s] and force [N].
Sample = tuple[int, float, float, float]


def samples_of(recording: Recording) -> list[Sample]:
    stamps = np.round(recording.time * 1e9).astype(int) + BEGIN
    velocity = np.zeros(len(stamps)) if recording.velocity is None else recording.velocity
    columns = recording.depth, velocity, recording.force
    return list(zip(stamps.tolist(), *(one.tolist() for one in columns), strict=True))


SAMPLES = samples_of(RECORDING)


def fed(
    samples: Iterable[Sample] = SAMPLES,
    *,
    window: float = 1e3,
    shift: int = 0,
    velocities: bool = True,
) -> LiveRecording:
    """Return a live recording with samples, and with the motion at a shifted time [ns]."""
    live = LiveRecording(window)
    feed(live, samples, shift=shift, velocities=velocities)
    return live


def feed(
    live: LiveRecording, samples: Iterable[Sample], *, shift: int = 0, velocities: bool = True
) -> None:
    for stamp, depth, velocity, force in samples:
        live.take_force(stamp, force)
        live.take_motion(stamp + shift, depth, velocity if velocities else nan)


def check(live: LiveRecording, tolerance: float) -> None:
    """Compare the identified friction with the simulated parameters."""
    found = identify_friction(live.recording())
    for name in ('coulomb_friction', 'viscous_friction'):
        assert found[name].value == pytest.approx(getattr(TRUTH, name), rel=tolerance)


@pytest.mark.parametrize('kind', [NoiseKind(), *(FURTHER[one].kind for one in (
    'low-pass of 8 Hz', 'filtered velocity', 'play of the encoder', 'gravity',
))])  # fmt: skip
def test_live_friction_is_that_of_a_bag(tmp_path: Path, kind: NoiseKind) -> None:
    """The same samples of two topics: equal recordings, and so equal parameters and warnings."""
    made, _ = recorded(kind, np.random.default_rng(2))
    samples = samples_of(made)
    with BagWriter(tmp_path / 'bag') as bag:
        for topic in (JOINT_STATES, BASE_WRENCH):
            bag.add_topic(f'/{topic.name}', topic.type_name)
        write = {topic: topic.template().serialize for topic in (JOINT_STATES, BASE_WRENCH)}
        for stamp, depth, velocity, force in samples:
            speed = nan if kind.positions_only else velocity
            motion = write[JOINT_STATES](stamp, depth, 0.0, speed, 0.0, 0.0, 0.0)
            bag.write(f'/{JOINT_STATES.name}', motion, stamp)
            wrench = write[BASE_WRENCH](stamp, 0.0, force, 0.0, 0.0, 0.0, 0.0)
            bag.write(f'/{BASE_WRENCH.name}', wrench, stamp)
    read = read_friction_recording(tmp_path / 'bag')
    live = fed(samples, velocities=not kind.positions_only).recording()
    # The rests of these recordings are shorter than the margin: nothing is discarded.
    assert_array_equal(live.time, read.time)
    assert_array_equal(live.depth, read.depth)
    assert_array_equal(live.force, read.force)
    found, expected = identify_friction(live), identify_friction(read)
    assert found.parameters == expected.parameters
    assert found.warnings == expected.warnings


def test_simulated_friction_is_recovered() -> None:
    live = fed()
    assert live.samples == len(SAMPLES)
    assert live.dropped == {}
    # An ideal sensor: the error is the transition between the regimes of the filter.
    check(live, 0.01)


def test_motion_between_the_stamps_of_the_force_is_interpolated() -> None:
    """A motion sampled 1.3 ms before the force gives the same friction."""
    # The interpolated velocity is wrong only in the ramps, where no sample is used.
    check(fed(shift=-1_300_000), 0.02)


def test_positions_without_velocity_are_differentiated() -> None:
    check(fed(velocities=False), 0.02)


@pytest.mark.parametrize('offset', [-0.9, -0.4, 0.0, 0.4, 0.9])
def test_offset_of_the_clocks_is_corrected_as_in_a_bag(offset: float) -> None:
    """By the receive times, which have a latency of 1 ms; with the loss of a bag."""
    live, shift = LiveRecording(1e3), round(offset * 1e9)
    for stamp, depth, velocity, force in SAMPLES:
        live.take_force(stamp + shift, force, stamp + 1_000_000)
        live.take_motion(stamp, depth, velocity, stamp + 1_000_000)
    recording = live.recording()
    assert recording.clock_offset == pytest.approx(offset, abs=1e-6)
    assert ('clocks differ, corrected' in '; '.join(recording.losses)) == (offset != 0.0)
    check(live, 0.01)


def test_stamp_of_zero_is_the_receive_time() -> None:
    live = LiveRecording(1e3)
    for stamp, depth, velocity, force in SAMPLES:
        live.take_force(0, force, stamp)
        live.take_motion(stamp, depth, velocity, stamp)
    recording = live.recording()
    losses = f'{len(SAMPLES)} of base_wrench without a stamp, the receive time is used'
    assert recording.losses == (losses,)
    check(live, 0.01)


@given(before=st.integers(0, 3))
@settings(max_examples=4, deadline=None)
def test_velocities_alone_are_integrated(before: int) -> None:
    """A first depth after them: they count as not finite, as a missing depth in a bag."""
    live = LiveRecording(1e3)
    for stamp, _, velocity, force in SAMPLES:
        live.take_force(stamp, force)
        live.take_motion(stamp, nan, velocity)
    recording = live.recording()
    assert 'has no position' in '; '.join(recording.losses)
    assert live.dropped == {}
    # The integral of the sampled velocity: the rounded corners of the ramps.
    expected = RECORDING.depth - RECORDING.depth[0]
    assert np.abs(recording.depth - recording.depth[0] - expected).max() < 1e-5
    check(live, 0.01)
    mixed = LiveRecording(1e3)
    for k, (stamp, depth, velocity, force) in enumerate(SAMPLES):
        mixed.take_force(stamp, force)
        mixed.take_motion(stamp, nan if k < before else depth, velocity)
    assert mixed.dropped == ({'not finite': before} if before else {})
    assert_array_equal(mixed.recording().depth, fed(SAMPLES[before:]).recording().depth)


@pytest.mark.parametrize('step', [2, 10, 10_000])
@given(at=st.integers(10, len(SAMPLES) - 10), forces=st.booleans())
@settings(max_examples=10, deadline=None)
def test_single_stamp_in_the_future_is_discarded(step: int, at: int, forces: bool) -> None:
    """Of either topic, by 2 s and more: the recording is that without it."""
    live = fed(SAMPLES[:at])
    stamp = SAMPLES[at][0] + step * 10**9
    if forces:
        live.take_force(stamp, 5.0)
    else:
        live.take_motion(stamp, 0.05, 0.1)
    feed(live, SAMPLES[at:])
    assert live.dropped == {'stamp in the future': 1}
    expected = fed()
    for name in ('time', 'depth', 'force'):
        assert_array_equal(getattr(live.recording(), name), getattr(expected.recording(), name))


def test_clock_that_is_set_forward_discards_nothing() -> None:
    later = [(stamp + 10**13, depth, velocity, force) for stamp, depth, velocity, force in SAMPLES]
    live = fed([*SAMPLES[:1000], *later[1000:]])
    assert live.dropped == {}
    assert live.samples == len(SAMPLES)


@pytest.mark.parametrize('ended', [JOINT_STATES.name, BASE_WRENCH.name])
def test_topics_without_new_samples_are_an_error(ended: str) -> None:
    """Of both topics, or of one while the other is published."""
    live = fed()
    live.check_current()
    with pytest.raises(RecordingError, match='no new samples of'):
        live.check_current()
    for k in range(1, 4):
        stamp = SAMPLES[-1][0] + k * 500_000_000
        (live.take_force if ended == JOINT_STATES.name else live.take_motion)(stamp, 0.0)
    with pytest.raises(RecordingError, match=rf'{ended} is 1\.5 s older than'):
        live.check_current()


def test_samples_between_two_identifications_are_added() -> None:
    """The order of samples and recordings does not matter."""
    live = LiveRecording(1e3)
    for k in range(0, len(SAMPLES), 1000):
        feed(live, SAMPLES[k : k + 1000])
        live.recording()
    assert_array_equal(live.recording().force, fed().recording().force)


@pytest.mark.parametrize(
    ('value', 'kind'),
    [(nan, 'not finite'), (inf, 'not finite'), (-1e300, 'implausible'), (2e4, 'implausible')],
)
def test_implausible_values_are_discarded_and_counted(value: float, kind: str) -> None:
    """A temporary failure of a sensor does not change the estimate."""
    live = fed(
        (stamp, value if k % 75 == 0 else depth, velocity, value if k % 50 == 0 else force)
        for k, (stamp, depth, velocity, force) in enumerate(SAMPLES)
    )
    assert live.dropped == {kind: -(-len(SAMPLES) // 50) + -(-len(SAMPLES) // 75)}
    check(live, 0.02)


def test_late_and_repeated_stamps_are_reported() -> None:
    """A late sample is sorted; of two with the same stamp the first one is used."""
    live = LiveRecording(1e3)
    for k, (stamp, depth, velocity, force) in enumerate(SAMPLES):
        feed(live, [(stamp, depth, velocity, force)])
        if k % 10 == 0:
            live.take_force(stamp, 1e3)
            live.take_motion(stamp - 5_000_000, depth - 5e-3 * velocity, velocity)
    recording = live.recording()
    text = '; '.join(recording.losses)
    assert 'base_wrench with the stamp of another' in text
    assert 'joint_states out of order' in text
    check(live, 0.01)


def test_a_backward_clock_jump_restarts_the_recording() -> None:
    """Only the new stamps are used."""
    earlier = [(stamp - 3600 * 10**9, y, v, f) for stamp, y, v, f in SAMPLES]
    live = fed()
    feed(live, earlier)
    assert live.dropped == {'clock set back': 1}
    recording = live.recording()
    assert recording.time[-1] == pytest.approx(RECORDING.time[-1] - RECORDING.time[0], abs=0.02)
    check(live, 0.01)


def test_force_within_a_gap_of_the_motion_is_not_used() -> None:
    """The motion is unknown during a gap of the encoder."""
    live = LiveRecording(1e3)
    gap = range(400, 500)
    for k, (stamp, depth, velocity, force) in enumerate(SAMPLES):
        live.take_force(stamp, force)
        if k not in gap:
            live.take_motion(stamp, depth, velocity)
    assert 'not covered' in '; '.join(live.recording().losses)
    check(live, 0.02)


def test_memory_and_time_are_those_of_the_last_motions() -> None:
    """Motions beyond the window are discarded, and all samples beyond three windows."""
    step, window = 0.005, 4.0
    live = LiveRecording(window)
    end = 0.0
    lasts = []
    for speed, duration in [(4e-3, 10.0), (0.0, 2.0), (-5e-3, 3.0), (0.0, 50.0)]:
        for time in end + np.arange(0.0, duration, step):
            feed(live, [(BEGIN + round(1e9 * time), 0.1, speed, 0.5 * np.sign(speed))])
        end += duration
        recording = live.recording()
        lasts.append(len(recording.time) * step)
    # With a margin of 1 s before it: the window; with the rest; a second of the first motion, the
    # rest and the last motion; three windows.
    assert lasts == pytest.approx(
        [window + 1.0, window + 3.0, window + 3.0, 3.0 * window], abs=0.1
    )


numbers = st.floats(-0.2, 0.2) | st.sampled_from([0.0, nan, inf, -1e300])


@given(st.lists(st.tuples(st.integers(-2, 300), numbers, numbers, numbers), max_size=80))
@settings(max_examples=60)
def test_any_samples_give_a_recording_or_one_error(
    samples: list[tuple[int, float, float, float]],
) -> None:
    """Few, uneven, late, repeated or invalid samples: no other error, and no warning of NumPy."""
    live, stamp = LiveRecording(1.0), BEGIN
    for steps, depth, velocity, force in samples:
        stamp += 1_000_000 * steps
        live.take_motion(stamp, depth, velocity)
        live.take_force(stamp, force)
    with suppress(NeedleError):
        identify_friction(live.recording())


def test_missing_topic_is_named() -> None:
    live = LiveRecording(10.0)
    for k in range(30):
        live.take_force(1_000_000 * (k + 1), 1.0)
    assert live.samples == 0
    with pytest.raises(RecordingError, match='no samples of joint_states'):
        live.recording()


@pytest.mark.parametrize('window', [0.0, -1.0, nan, inf])
def test_invalid_window_is_rejected(window: float) -> None:
    with pytest.raises(ParameterError, match='window must be finite, > 0 s'):
        LiveRecording(window)


def test_all_settings_are_those_of_recordings() -> None:
    """Terms of the whole recording, and every estimator."""
    settings = FrictionSettings(terms=('coulomb', 'viscous', 'drift'), estimator='huber')
    found = identify_friction(fed().recording(), settings)
    assert found['force_drift'].determined
