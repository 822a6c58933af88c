# SPDX-License-Identifier: Apache-2.0
"""The reference waits for the needle: stalls, commands without effect, force at its limit."""

from __future__ import annotations

from collections.abc import Sequence
from math import nan
import random

from benchmarks.loop import Loop, LoopFault, Sent
from benchmarks.stalls import fastest, insert, LIMIT, Stall, StalledLoop, START, TARGET, VICTIMS
from hypothesis import example, given, settings
from hypothesis import strategies as st
from needle_controller import Controller, Measurement, ReferenceLimits, Setpoint
from needle_controller.gains import LAWS
from needle_dynamics import NeedleParameters
from needle_dynamics.simulated.assembly import PlantSettings
from needle_ros.contract import NEWEST
from needle_ros.timing import NANOSECONDS
import numpy as np
import pytest

RATE = 200.0
PERIOD = 1e-3
PHANTOM = NeedleParameters.preset('phantom')

#: Overshoot of the velocity of the needle, relative to the limit of the reference. That of PID
#: without stalls is 0.15; at 200 Hz the other laws have 0.12 for a period after some stalls.
OVERSHOOT = 0.2

#: Velocity that a lost command adds when its force is held [m/s]: the acceleration limit of the
#: reference over the timeout of the plant.
HELD = ReferenceLimits().acceleration * PlantSettings().command_timeout

#: Largest distance from the target at rest [m]: dry friction, 0.56 N, over the stiffness of PID.
AT_REST = 1e-4

stalls = st.lists(
    st.builds(
        Stall,
        st.sampled_from(VICTIMS),
        st.floats(0.05, 1.0),
        st.one_of(st.floats(0.05, 0.3), st.floats(0.3, 5.0)),
    ),
    min_size=1,
    max_size=5,
)


@pytest.mark.requirement('S-210', 'S-213', 'S-214', 'S-215', 'S-317')
@pytest.mark.parametrize('kind', ['target', 'path'])
@pytest.mark.parametrize('law', LAWS)
@settings(max_examples=5)
@given(stalls)
@example([Stall('plant', 0.3, 0.09), Stall('commands', 0.3, 0.6), Stall('controller', 0.3, 0.12)])
# During the acceleration.
@example([Stall('plant', 0.0625, 0.0625)])
@example([Stall('commands', 0.0625, 0.09375)])
def test_velocities_after_stalls_are_within_limits(
    law: str, kind: str, happens: Sequence[Stall]
) -> None:
    """Of the reference by its limit, of the needle with an overshoot; the target is reached."""
    found = insert(law, kind, happens, rate=RATE)
    assert found.reference <= LIMIT * (1.0 + 1e-9)
    held = HELD if any(one.victim == 'commands' for one in happens) else 0.0
    assert max(found.inward, found.outward) <= LIMIT * (1.0 + OVERSHOOT) + held
    assert found.stop == ''
    assert abs(found.depth - TARGET) < AT_REST


def insert_with(law: str, **friction: float) -> tuple[StalledLoop, float]:
    """Return the loop 2 s after the friction changes in motion, and the insertion depth then."""
    loop = StalledLoop(law, RATE)
    loop.target(TARGET)
    for _ in range(200):
        loop.step()
    loop.change(**friction)
    begin = loop.depth
    for _ in range(400):
        loop.step()
    return loop, begin


@pytest.mark.requirement('S-209', 'S-211', 'S-220')
@pytest.mark.parametrize('law', LAWS)
def test_reference_waits_for_a_force_at_its_limit(law: str) -> None:
    """Of a needle that slides slowly: no stop, and the distance remains small."""
    loop, begin = insert_with(law, viscous=3000.0)
    assert loop.supervisor.authority.reason == ''
    # The limit of 15 N less dry friction, over 2 s. While the reference waits, the force is at its
    # limit; it falls below the limit for less than a quarter of the time after that.
    most = (15.0 - PHANTOM.coulomb_friction) / 3000.0 * 2.0
    assert 0.75 * most < loop.depth - begin < most
    # The distance at which the law reaches the force limit: 15 N over the stiffness of PID.
    assert abs(loop.references[-1][0] - loop.depth) < 15.0 / 6000.0 + 1e-4


@pytest.mark.requirement('S-218', 'S-219')
@pytest.mark.parametrize('law', LAWS)
def test_blocked_needle_is_detected_while_the_reference_waits(law: str) -> None:
    """By the monitor of the encoders, before the tracking error reaches its limit."""
    loop, _ = insert_with(law, coulomb=40.0)
    assert 'encoders do not move' in loop.supervisor.authority.reason
    # The tracking error would end the motion at 10 mm.
    assert loop.references[-1][0] - loop.depth < 4e-3


def drive(controller: Controller, samples: Sequence[tuple[float, float, float]]) -> list[float]:
    """Return the reference depths for samples of time [s], depth [m] and reported force [N]."""
    return [
        controller.command(
            Measurement(time=time, depth=depth, velocity=0.0, force=force)
        ).setpoint.position
        for time, depth, force in samples
    ]


@pytest.mark.requirement('S-212')
@pytest.mark.parametrize('force', [0.0, nan], ids=['none', 'not reported'])
@pytest.mark.parametrize('law', LAWS)
def test_reference_waits_for_a_reported_force(law: str, force: float) -> None:
    """From the first sample without it; forces that are not reported are assumed to act."""
    controller = Controller(PHANTOM, law)
    controller.set_target(TARGET)
    follows: list[Setpoint] = []
    time = 0.0
    depth, last = 0.02, 0.0
    for _ in range(300):
        command = controller.command(
            Measurement(time=time, depth=depth, velocity=command_velocity(follows), force=last)
        )
        follows.append(command.setpoint)
        depth, last, time = command.setpoint.position, command.force, time + PERIOD
    aims = drive(controller, [(time + k * PERIOD, depth, force) for k in range(50)])
    moved = aims[-1] - depth
    if force == 0.0:
        assert moved == 0.0
    else:
        assert moved == pytest.approx(50.0 * LIMIT * PERIOD, rel=0.05)


@pytest.mark.requirement('S-282', 'S-284')
@pytest.mark.parametrize('law', LAWS)
def test_lost_commands_do_not_make_the_needle_faster(law: str) -> None:
    """The plant holds a force that it reports, and is commanded another one."""
    # During the acceleration, when the force changes most.
    lost = [Stall('commands', 0.06, 0.03), Stall('commands', 0.3, 0.09)]
    found = insert(law, 'target', lost)
    # 5 % in the benchmark at 1 kHz, PID as without lost commands.
    assert found.inward <= LIMIT * (1.0 + (OVERSHOOT if law == 'pid' else 0.1))
    assert abs(found.depth - TARGET) < AT_REST


@pytest.mark.requirement('S-318')
@given(st.floats(-2.0, 2.0), st.floats(0.5, 2.0), st.floats(0.0, 1.0))
@example(0.0, 1.0, 0.0)
@settings(max_examples=20, deadline=None)
def test_other_reported_forces_do_not_delay_the_reference(
    offset: float, factor: float, noise: float
) -> None:
    """Of a sensor with an offset, another scale, or noise."""
    controller = Controller(PHANTOM)
    controller.set_target(TARGET)
    rng, aims = np.random.default_rng(1), list[Setpoint]()
    depth, last = 0.02, 0.0
    for k in range(1000):
        force = factor * last + offset + noise * float(rng.standard_normal())
        measured = Measurement(
            time=k * PERIOD, depth=depth, velocity=command_velocity(aims), force=force
        )
        command = controller.command(measured)
        aims.append(command.setpoint)
        depth, last = command.setpoint.position, command.force
    # One second at 10 mm/s less the acceleration in 0.1 s, and two periods. A hold lasts 10 ms or
    # more, which is 1 % of the path.
    assert aims[-1].position - 0.02 == pytest.approx(LIMIT * 0.95, rel=5e-3)


def stall_repeatedly(loop: StalledLoop, seed: int, lasts: float) -> None:
    """Stall the controller again and again for a time [s], more and less, fast and slow."""
    rng, periods, ends = random.Random(seed), round(lasts / PERIOD), 0.0
    for k in range(periods):
        if k % 700 == 0:
            shortest, loop.busy = rng.uniform(0.005, 0.04), rng.choice([1, 2, 5])
            longest, pause = shortest + rng.uniform(0.0, 0.06), rng.uniform(0.0005, 0.02)
        if k >= ends:
            stall = rng.uniform(shortest, longest)
            loop.stall('controller', stall)
            ends = k + (stall + rng.expovariate(1.0 / pause)) / PERIOD
        loop.step()
    loop.busy = 1


@pytest.mark.requirement('S-320')
@pytest.mark.parametrize('law', LAWS)
@settings(max_examples=1, deadline=None)
@given(st.integers(0, 10_000))
@example(1)
def test_repeated_gaps_do_not_keep_a_force(law: str, seed: int) -> None:
    """An integral that each gap keeps would move the needle away from its target, or past it."""
    loop = StalledLoop(law)
    for _ in range(20):
        loop.step()
    loop.target(TARGET - 0.01)
    stall_repeatedly(loop, seed, 6.0)
    for _ in range(3000):
        loop.step()
    depths = np.array([depth for _, depth in loop.track])
    # The needle moves by some 10 um when the law corrects a distance, PID overshoots by 0.4 mm.
    assert np.maximum.accumulate(depths).max() < TARGET - 0.01 + 6.0 * AT_REST
    assert (np.maximum.accumulate(depths) - depths).max() < 6.0 * AT_REST
    assert abs(loop.depth - TARGET + 0.01) < AT_REST


@pytest.mark.requirement('S-283')
@pytest.mark.parametrize('law', LAWS)
def test_needle_continues_at_its_velocity_after_a_gap(law: str) -> None:
    """The plant holds the last force: the law does not assume a needle without force."""
    loop = StalledLoop(law)
    for _ in range(20):
        loop.step()
    loop.target(TARGET)
    # Without a stall the integral of PID also changes the velocity.
    for _ in range(1500):
        loop.step()
    loop.stall('controller', 0.03)
    for _ in range(100):
        loop.step()
    depths = np.array([depth for _, depth in loop.track[-100:]])
    steps = np.diff(depths) / PERIOD
    # A law that assumes no force lets the needle slow down to a third of this.
    assert steps.min() > 0.9 * LIMIT
    assert steps.max() < 1.1 * LIMIT


@pytest.mark.requirement('S-312')
@pytest.mark.parametrize('busy', [2, 3])
@pytest.mark.parametrize('law', LAWS)
def test_busy_controller_answers_the_newest_measurements(law: str, busy: int) -> None:
    """One that is too slow for the rate: the needle moves as with a fast one."""
    loop = StalledLoop(law)
    loop.busy = busy
    for _ in range(20):
        loop.step()
    loop.follow(TARGET, 6.0)
    for _ in range(8000):
        loop.step()
    # The samples that wait, and the one that is processed.
    assert max(loop.ages) <= (NEWEST.depth + 1) * busy * PERIOD * 1e9
    inward, outward = fastest(loop.track)
    assert inward <= LIMIT * (1.0 + OVERSHOOT)
    assert outward < 0.1 * LIMIT
    assert abs(loop.depth - TARGET) < AT_REST
    assert loop.supervisor.authority.reason == ''


def command_velocity(follows: Sequence[tuple[float, ...]]) -> float:
    """Return the velocity of the last setpoint [m/s]."""
    return follows[-1][1] if follows else 0.0


@pytest.mark.requirement('S-216', 'S-217')
@pytest.mark.parametrize('gaps', [[0.005], [0.05], [0.15, 0.048]])
def test_time_of_a_path_waits_for_the_needle(gaps: Sequence[float]) -> None:
    """A path is continued where the needle rested, later by the stall; no part is skipped."""
    controller = Controller(PHANTOM)
    controller.follow([0.0, 4.0], [0.02, 0.05])
    aims: list[Setpoint] = []
    depth = 0.02
    times = np.arange(0.0, 5.0, PERIOD)
    # The needle follows exactly, except for stalls in which it rests: after 1 s, and after the
    # first measurement after that.
    for k, gap in enumerate(gaps):
        times[1000 + k :] += gap
    for time in times:
        velocity = aims[-1].velocity if aims else 0.0
        command = controller.command(Measurement(time=time, depth=depth, velocity=velocity))
        aims.append(command.setpoint)
        depth = command.setpoint.position
    steps = np.diff([one.position for one in aims])
    # A gap of some periods is no stall: the reference continues in time.
    short = max((gap for gap in gaps if gap < 0.01), default=0.0)
    assert np.abs(steps).max() <= LIMIT * (short + PERIOD) * (1.0 + 1e-6)
    assert aims[-1].position == 0.05


class _Late(LoopFault):
    """All measurements are late by the same time [s]."""

    def __init__(self, age: float) -> None:
        self._age = round(age * NANOSECONDS)

    def measured(self, sent: Sent) -> tuple[Sent]:
        return (sent._replace(late=self._age),)


@pytest.mark.requirement('S-310')
@pytest.mark.parametrize('law', LAWS)
def test_measurements_that_become_late_do_not_make_the_needle_overshoot(law: str) -> None:
    """By 20 ms from the middle of a motion on, and forever: no restart at each measurement."""
    loop, depths = Loop(law, 1000.0), list[float]()
    for k in range(4000):
        if k == 20:
            loop.target(TARGET)
        loop.step('joint_states', _Late(0.02) if k > 1000 else None)
        depths.append(loop.depth)
    # That of PID with a delay of 20 ms is 0.4 mm; with restarts it is 7 mm, of the others 2 mm.
    assert max(depths) < TARGET + 6.0 * AT_REST
    assert abs(depths[-1] - TARGET) < AT_REST


@pytest.mark.requirement('S-319', 'S-322')
@pytest.mark.parametrize('law', LAWS)
@settings(max_examples=3, deadline=None)
@given(st.floats(0.0, 0.095), st.integers(0, 500))
@example(0.0295, 70)
@example(0.09, 0)
def test_late_measurements_do_not_make_the_needle_oscillate(
    law: str, age: float, since: int
) -> None:
    """At any age; where the loop could be unstable no force acts, until they are in time again."""
    loop, depths, ends = Loop(law, 1000.0), list[float](), since + 700
    limit = Controller(PHANTOM, law).age_limits['insertion']
    for k in range(ends + 2000):
        if k == 20:
            loop.target(START + 0.01)
        loop.step('joint_states', _Late(age) if since < k < ends else None)
        depths.append(loop.depth)
        if k == ends - 1:
            assert ('is stable up to' in loop.supervisor.fault) == (age > limit)
    speeds = np.convolve(np.diff(depths), np.full(10, 0.1 / PERIOD), 'valid')
    # Without a limit of the age: 48 mm/s in both directions. Largest of 306 ages and times: 23.6
    # mm/s just within it, if the delay begins during the acceleration; 4.5 mm/s back from an
    # overshoot.
    assert speeds.max() < 2.5 * LIMIT
    assert speeds.min() > -0.6 * LIMIT
    assert abs(depths[-1] - START - 0.01) < AT_REST
    assert loop.supervisor.authority.reason == ''
