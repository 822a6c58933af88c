# SPDX-License-Identifier: Apache-2.0
"""Friction from running topics: messages are paired by stamp, in any order."""

from math import inf, nan

from needle_dynamics import ParameterError
from needle_identification import FrictionSettings, ParameterEstimate
from needle_identification.friction.recursive import LiveFriction
import numpy as np
import pytest
from support.samples import IDEAL, simulated, TRUTH

#: Strokes in both directions at two speeds, long enough for the filter to settle.
LEGS = tuple(
    leg for speed in (3e-3, 8e-3) for leg in ((0.0, 0.3), (speed, 1.2), (0.0, 0.3), (-speed, 1.2))
)
RECORDING = simulated(LEGS, sensor=IDEAL)
STAMPS = np.round(RECORDING.time * 1e9).astype(int) + 1_700_000_000_000_000_000
SAMPLES = list(
    zip(STAMPS.tolist(), RECORDING.depth, RECORDING.velocity, RECORDING.force, strict=True)
)


def feed(
    live: LiveFriction,
    samples: list[tuple[int, float, float, float]] = SAMPLES,
    shift: int = 0,
    velocities: bool = True,
) -> None:
    """Feed a recording as two topics, with a small delay of the motion."""
    for stamp, depth, velocity, force in samples:
        live.take_force(stamp, force)
        live.take_motion(stamp + shift, depth, velocity if velocities else None)


def make() -> LiveFriction:
    """Build a live identification without forgetting."""
    return LiveFriction(FrictionSettings(), 1e6)


def values(live: LiveFriction) -> dict[str, ParameterEstimate]:
    return {one.name: one for one in live.estimate()}


def check(live: LiveFriction, tolerance: float) -> None:
    """Compare with the simulated parameters."""
    found = values(live)
    for name in ('coulomb_friction', 'viscous_friction'):
        assert found[name].determined
        assert found[name].value == pytest.approx(getattr(TRUTH, name), rel=tolerance)


def test_simulated_friction_is_recovered() -> None:
    """Equal stamps are paired directly."""
    live = make()
    assert live.estimate() == ()
    feed(live)
    assert live.samples == len(SAMPLES)
    assert live.dropped == {}
    # An ideal sensor: the error is the transition between the regimes of the filter.
    check(live, 0.01)


def test_motion_between_the_stamps_of_the_force_is_interpolated() -> None:
    """A motion sampled 1.3 ms before the force gives the same friction."""
    live = make()
    feed(live, shift=-1_300_000)
    assert live.samples >= len(SAMPLES) - 2
    # The interpolated velocity is wrong only in the ramps, where no sample is used.
    check(live, 0.02)


def test_positions_without_velocity_are_differentiated() -> None:
    """The velocity at the middle of two positions is their slope."""
    live = make()
    feed(live, velocities=False)
    check(live, 0.02)


@pytest.mark.parametrize(
    ('value', 'kind'),
    [(nan, 'not finite'), (inf, 'not finite'), (-1e300, 'implausible'), (2e4, 'implausible')],
)
def test_implausible_values_are_discarded_and_counted(value: float, kind: str) -> None:
    """A temporary failure of a sensor does not change the estimate."""
    live = make()
    for k, (stamp, depth, velocity, force) in enumerate(SAMPLES):
        live.take_force(stamp, value if k % 50 == 0 else force)
        live.take_motion(stamp, depth, value if k % 75 == 0 else velocity)
    assert live.dropped[kind] == -(-len(SAMPLES) // 50) - (-len(SAMPLES) // 75)
    check(live, 0.02)


def test_late_and_repeated_stamps_are_discarded() -> None:
    live = make()
    for k, (stamp, depth, velocity, force) in enumerate(SAMPLES):
        live.take_motion(stamp, depth, velocity)
        live.take_force(stamp, force)
        if k % 10 == 0:
            live.take_force(stamp, 1e3)
            live.take_motion(stamp - 5_000_000, depth, 10.0)
    assert live.dropped == {'out of order': 2 * -(-len(SAMPLES) // 10)}
    check(live, 0.01)


def test_a_backward_clock_jump_restarts_the_estimation() -> None:
    """The result is the result of the new stamps only."""
    live, fresh = make(), make()
    feed(live)
    earlier = [(stamp - 3600 * 10**9, *others) for stamp, *others in SAMPLES]
    feed(live, earlier)
    feed(fresh, earlier)
    assert live.dropped['clock set back'] >= 1
    assert live.samples == pytest.approx(fresh.samples, abs=2)
    check(live, 0.01)


def test_force_within_a_gap_of_the_motion_is_not_paired() -> None:
    """The motion is unknown during a gap of the encoder."""
    live = make()
    gap = range(400, 500)
    for k, (stamp, depth, velocity, force) in enumerate(SAMPLES):
        live.take_force(stamp, force)
        if k not in gap:
            live.take_motion(stamp, depth, velocity)
    assert live.dropped == {'no motion at their time': len(gap)}
    check(live, 0.02)


def test_the_buffer_is_bounded_if_one_topic_is_missing() -> None:
    """Force samples without motion are buffered up to a limit."""
    live = make()
    for k in range(30_000):
        live.take_force(1_000_000 * (k + 1), 1.0)
    assert len(live._force) == 20_000
    assert live.samples == 0
    assert live.estimate() == ()


@pytest.mark.parametrize(
    ('settings', 'forgetting', 'complaint'),
    [
        (FrictionSettings(), 0.0, 'forgetting must be finite and > 0'),
        (FrictionSettings(estimator='huber'), 60.0, 'estimator ordinary'),
    ],
)
def test_invalid_settings_are_rejected_at_once(
    settings: FrictionSettings, forgetting: float, complaint: str
) -> None:
    with pytest.raises(ParameterError, match=complaint):
        LiveFriction(settings, forgetting)
