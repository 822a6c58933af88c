"""Friction from running topics: pairing by stamp, for any order of messages."""

from math import inf, nan

from needle_dynamics import ParameterError
from needle_identification import FrictionSettings, ParameterEstimate
from needle_identification.friction.live import LiveFriction
import numpy as np
import pytest
from support.samples import IDEAL, simulated, TRUTH

#: There and back at two speeds, slow enough for the filter to settle.
LEGS = tuple(
    leg for speed in (3e-3, 8e-3) for leg in ((0.0, 0.3), (speed, 1.2), (0.0, 0.3), (-speed, 1.2))
)
RECORDING = simulated(LEGS, sensor=IDEAL)
STAMPS = np.round(RECORDING.time * 1e9).astype(int) + 1_700_000_000_000_000_000
SAMPLES = list(
    zip(STAMPS.tolist(), RECORDING.depth, RECORDING.speed, RECORDING.force, strict=True)
)


def feed(
    live: LiveFriction,
    samples: list[tuple[int, float, float, float]] = SAMPLES,
    shift: int = 0,
    speeds: bool = True,
) -> None:
    """Feed the recording as two topics, the motion arriving a little later."""
    for stamp, depth, speed, force in samples:
        live.take_force(stamp, force)
        live.take_motion(stamp + shift, depth, speed if speeds else None)


def make() -> LiveFriction:
    """Return a live identification without forgetting."""
    return LiveFriction(FrictionSettings(), 1e6)


def values(live: LiveFriction) -> dict[str, ParameterEstimate]:
    """Return the estimates by name."""
    return {one.name: one for one in live.estimate()}


def check(live: LiveFriction, tolerance: float) -> None:
    """Compare with what was simulated."""
    found = values(live)
    for name in ('coulomb_friction', 'viscous_friction'):
        assert found[name].determined
        assert found[name].value == pytest.approx(getattr(TRUTH, name), rel=tolerance)


def test_simulated_friction_is_found() -> None:
    """Stamps that agree are paired one by one."""
    live = make()
    assert live.estimate() == ()
    feed(live)
    assert live.samples == len(SAMPLES)
    assert live.dropped == {}
    # An ideal sensor: what is left is the transition between the regimes of the filter.
    check(live, 0.01)


def test_motion_between_the_stamps_of_the_force_is_interpolated() -> None:
    """A motion sampled 1.3 ms before the force gives the same friction."""
    live = make()
    feed(live, shift=-1_300_000)
    assert live.samples >= len(SAMPLES) - 2
    # The interpolated speed is wrong only in the ramps, where no sample is used.
    check(live, 0.02)


def test_positions_alone_are_differentiated() -> None:
    """Without speeds the slope between two positions is the speed in their middle."""
    live = make()
    feed(live, speeds=False)
    check(live, 0.02)


@pytest.mark.parametrize(
    ('value', 'kind'),
    [(nan, 'not finite'), (inf, 'not finite'), (-1e300, 'absurd'), (2e4, 'absurd')],
)
def test_what_is_not_sane_is_dropped_and_counted(value: float, kind: str) -> None:
    """A temporary failure of a sensor does not change the estimate."""
    live = make()
    for k, (stamp, depth, speed, force) in enumerate(SAMPLES):
        live.take_force(stamp, value if k % 50 == 0 else force)
        live.take_motion(stamp, depth, value if k % 75 == 0 else speed)
    assert live.dropped[kind] == -(-len(SAMPLES) // 50) - (-len(SAMPLES) // 75)
    check(live, 0.02)


def test_late_and_repeated_stamps_are_dropped() -> None:
    """Repeated and late messages are not used twice."""
    live = make()
    for k, (stamp, depth, speed, force) in enumerate(SAMPLES):
        live.take_motion(stamp, depth, speed)
        live.take_force(stamp, force)
        if k % 10 == 0:
            live.take_force(stamp, 1e3)
            live.take_motion(stamp - 5_000_000, depth, 10.0)
    assert live.dropped == {'out of order': 2 * -(-len(SAMPLES) // 10)}
    check(live, 0.01)


def test_a_clock_that_is_set_back_restarts_the_estimation() -> None:
    """Estimation continues with the new stamps as if it had begun with them."""
    live, fresh = make(), make()
    feed(live)
    earlier = [(stamp - 3600 * 10**9, *others) for stamp, *others in SAMPLES]
    feed(live, earlier)
    feed(fresh, earlier)
    assert live.dropped['clock set back'] >= 1
    assert live.samples == pytest.approx(fresh.samples, abs=2)
    check(live, 0.01)


def test_force_within_a_gap_of_the_motion_is_not_paired() -> None:
    """The motion of the needle is unknown while the encoder is silent."""
    live = make()
    gap = range(400, 500)
    for k, (stamp, depth, speed, force) in enumerate(SAMPLES):
        live.take_force(stamp, force)
        if k not in gap:
            live.take_motion(stamp, depth, speed)
    assert live.dropped == {'no motion at their time': len(gap)}
    check(live, 0.02)


def test_memory_is_bounded_if_one_topic_is_missing() -> None:
    """Samples of the force wait for the motion in a buffer of limited length."""
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
    """The settings are checked at once."""
    with pytest.raises(ParameterError, match=complaint):
        LiveFriction(settings, forgetting)
