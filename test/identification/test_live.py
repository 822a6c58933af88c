"""Friction from streams: pairing by stamp, whatever the streams do."""

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
    """Feed the recording as two streams, the motion a little later on the way."""
    for stamp, depth, speed, force in samples:
        live.take_force(stamp, force)
        live.take_motion(stamp + shift, depth, speed if speeds else None)


def make() -> LiveFriction:
    """Return a live identification that forgets nothing within the recording."""
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


def test_finds_the_friction_that_was_simulated() -> None:
    """Stamps that agree are paired one by one."""
    live = make()
    assert live.estimate() == ()
    feed(live)
    assert live.samples == len(SAMPLES)
    assert live.dropped == {}
    # An ideal sensor: what is left is the transition between the regimes of the filter.
    check(live, 0.01)


def test_motion_between_the_stamps_of_the_force_is_interpolated() -> None:
    """A motion sampled 1.3 ms beside the force gives the same friction."""
    live = make()
    feed(live, shift=-1_300_000)
    assert live.samples >= len(SAMPLES) - 2
    # The interpolated speed is off by the ramps only, where nothing is used.
    check(live, 0.02)


def test_positions_alone_are_differentiated() -> None:
    """Without speeds the slope between two positions is the speed in their middle."""
    live = make()
    feed(live, speeds=False)
    check(live, 0.02)


@pytest.mark.parametrize('value', [nan, inf])
def test_what_is_not_finite_is_dropped_and_counted(value: float) -> None:
    """A sensor that fails for a while does not spoil the estimate."""
    live = make()
    for k, (stamp, depth, speed, force) in enumerate(SAMPLES):
        live.take_force(stamp, value if k % 50 == 0 else force)
        live.take_motion(stamp, depth, value if k % 75 == 0 else speed)
    assert live.dropped['not finite'] == -(-len(SAMPLES) // 50) - (-len(SAMPLES) // 75)
    check(live, 0.02)


def test_stamps_that_go_back_a_little_are_dropped() -> None:
    """Duplicates and messages overtaken on the way count once, or not at all."""
    live = make()
    for k, (stamp, depth, speed, force) in enumerate(SAMPLES):
        live.take_motion(stamp, depth, speed)
        live.take_force(stamp, force)
        if k % 10 == 0:
            live.take_force(stamp, 1e3)
            live.take_motion(stamp - 5_000_000, depth, 1e3)
    assert live.dropped == {'out of order': 2 * -(-len(SAMPLES) // 10)}
    check(live, 0.01)


def test_a_clock_that_is_set_back_starts_anew() -> None:
    """Estimation goes on with the new stamps as if it had begun with them."""
    live, fresh = make(), make()
    feed(live)
    earlier = [(stamp - 3600 * 10**9, *others) for stamp, *others in SAMPLES]
    feed(live, earlier)
    feed(fresh, earlier)
    assert live.dropped['clock set back'] >= 1
    assert live.samples == pytest.approx(fresh.samples, abs=2)
    check(live, 0.01)


def test_force_within_a_gap_of_the_motion_is_not_paired() -> None:
    """Nobody knows how the needle moved while the encoder was silent."""
    live = make()
    gap = range(400, 500)
    for k, (stamp, depth, speed, force) in enumerate(SAMPLES):
        live.take_force(stamp, force)
        if k not in gap:
            live.take_motion(stamp, depth, speed)
    assert live.dropped == {'no motion at their time': len(gap)}
    check(live, 0.02)


def test_one_stream_alone_takes_no_more_memory_than_its_share() -> None:
    """Force without motion waits, but not for ever."""
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
def test_what_cannot_be_done_is_refused_before_a_sample_comes(
    settings: FrictionSettings, forgetting: float, complaint: str
) -> None:
    """The settings are checked at once."""
    with pytest.raises(ParameterError, match=complaint):
        LiveFriction(settings, forgetting)
