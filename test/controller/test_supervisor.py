# SPDX-License-Identifier: Apache-2.0
"""Commands of the axial supervisor for any sequence of events, without ROS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from math import inf, isfinite, nan
from typing import Any

from hypothesis import example, given, settings
from hypothesis import strategies as st
from needle_controller import Controller, ForceCommand, Measurement, ObserverSettings, SafetyLimits
from needle_controller.gains import LAWS
from needle_controller.hardware import HardwareSettings
from needle_controller.hardware import Robot as HardwareRobot
from needle_controller.supervisor import Supervisor
from needle_dynamics import NeedleModel, NeedleParameters
from needle_ros.event_log import EventLog, Severity
from needle_ros.requests import Verdict
from needle_ros.system_state import Authority, CLEAR_STOP, PAUSE, RESUME, RETRACT, STOP
from needle_ros.trajectories import JointPath, MOST_POINTS
from needle_ros.wire import Reading
import numpy as np
import pytest

PERIOD = 1_000_000
SECOND = 1000 * PERIOD
PHANTOM = NeedleParameters.preset('phantom')
TOPIC = 'wrench_command'


class Loop:
    """A supervisor with a target, its time, and all its commands."""

    def __init__(
        self,
        target: float | None = 0.1,
        observed: ObserverSettings | None = None,
        limits: SafetyLimits | None = None,
        simulated: bool = False,
    ) -> None:
        self.seconds = 0.0
        self.supervisor = Supervisor(steady=lambda: self.seconds)
        self.now = 100 * SECOND
        limits = limits or SafetyLimits(tracking_error=0.1)
        controller = Controller(PHANTOM)
        self.supervisor.configure(controller, limits, observed, simulated=simulated)
        self.supervisor.retract_depth = 0.01
        self.supervisor.activate(self.now, {TOPIC: 1})
        self.depth = 0.02
        if target is not None:
            self.aim(target)

    def aim(self, depth: float) -> ForceCommand | None:
        return self.supervisor.target(0, '', depth, 0.0, self.now)

    def measure(
        self, move: float = 0.0, velocity: float = 0.0, late: int = 0
    ) -> ForceCommand | None:
        """Measure a period later."""
        self.now += PERIOD
        self.depth += move
        return self.encoders(self.now - late, self.depth, velocity)

    def encoders(
        self, stamp: int, depth: float, velocity: float, *efforts: float
    ) -> ForceCommand | None:
        values = ((depth,), (velocity,), efforts)
        return self.supervisor.encoders(Reading(stamp, '', ('insertion',), values), self.now)

    def wrench(self, axial: float = 0.0, moment: float = 0.0) -> ForceCommand | None:
        values = ((0.0, axial, 0.0, moment, 0.0, 0.0),)
        return self.supervisor.wrench(Reading(self.now, 'needle_base', (), values), self.now)

    def tip(self, deflection: float = 0.0) -> ForceCommand | None:
        values = ((0.0, self.depth, deflection),)
        return self.supervisor.tip(Reading(self.now, 'needle_entry', (), values), self.now)

    def watch(self, nodes: int = 1) -> ForceCommand | None:
        return self.supervisor.watch(self.now, {TOPIC: nodes})

    def passes(self, time: int) -> ForceCommand | None:
        self.now += time
        return self.watch()

    def stop(self) -> ForceCommand | None:
        return self.request(STOP)

    def clear(self) -> ForceCommand | None:
        return self.request(CLEAR_STOP)

    def request(self, word: str) -> ForceCommand | None:
        return self.supervisor.request(word, self.now)[2]

    def pushes(self) -> ForceCommand:
        """Measure until a force is commanded."""
        answers = (self.measure() for _ in range(50))
        return next(answer for answer in answers if answer is not None and answer.force > 0.5)

    def said(self) -> list[str]:
        return [line for _, line in self.supervisor.events.take()]


#: Events of a control loop, except for a release of the stop.
EVENTS: list[Callable[[Loop], ForceCommand | None]] = [
    Loop.measure,
    lambda loop: loop.measure(1e-6, 1e-3),
    lambda loop: loop.measure(5e-3),
    lambda loop: loop.measure(0.0, 0.5),
    lambda loop: loop.measure(nan),
    lambda loop: loop.measure(0.0, inf),
    lambda loop: loop.measure(late=SECOND),
    lambda loop: loop.measure(late=-SECOND),
    lambda loop: loop.measure(late=3 * PERIOD),
    lambda loop: loop.encoders(loop.now, 0.02, 0.0),
    lambda loop: loop.supervisor.encoders(Reading(loop.now, '', (), ((), (), ())), loop.now),
    lambda loop: setattr(loop, 'depth', 0.02),
    Loop.wrench,
    lambda loop: loop.wrench(axial=50.0),
    lambda loop: loop.wrench(moment=nan),
    Loop.tip,
    lambda loop: loop.tip(0.06),
    Loop.watch,
    lambda loop: loop.watch(2),
    lambda loop: loop.passes(SECOND),
    lambda loop: loop.passes(-SECOND),
    lambda loop: loop.aim(0.05),
    lambda loop: loop.aim(nan),
    lambda loop: loop.request(PAUSE),
    lambda loop: loop.request(RESUME),
    lambda loop: loop.request(RETRACT),
    Loop.stop,
]
events = st.lists(st.sampled_from(EVENTS), max_size=40)


@pytest.mark.requirement('S-007', 'S-043', 'S-058')
@given(events, events)
def test_stop_gives_zero_force_until_cleared(
    before: list[Callable[[Loop], ForceCommand | None]],
    after: list[Callable[[Loop], ForceCommand | None]],
) -> None:
    """No command has a force or a motion, for any events before and after."""
    loop = Loop()
    for event in before:
        event(loop)
    loop.stop()
    stop = loop.supervisor.safety.stop
    answers = [event(loop) for event in after]
    answers.append(loop.measure())
    assert all(answer[1:] == (0.0, 0.0, (), ()) for answer in answers if answer is not None)
    assert loop.supervisor.safety.stop == stop


@pytest.mark.requirement('S-002', 'S-090')
@given(st.lists(st.sampled_from([*EVENTS, Loop.clear]), max_size=60))
def test_commands_have_the_stamp_of_a_measurement_or_the_present_time(
    happens: list[Callable[[Loop], ForceCommand | None]],
) -> None:
    """A nonzero force is finite, within its limit, and answers a measurement."""
    loop = Loop()
    measured = set()
    encoders = loop.supervisor.encoders

    def remember(reading: Reading, now: int) -> ForceCommand | None:
        measured.add(reading.stamp)
        return encoders(reading, now)

    loop.supervisor.encoders = remember  # type: ignore[method-assign]
    limits = loop.supervisor.controller.settings
    for event in happens:
        answer = event(loop)
        if answer is None:
            continue
        assert answer.stamp in measured or (answer.stamp == loop.now and answer.force == 0.0)
        assert isfinite(answer.force)
        assert abs(answer.force) <= limits.force_limit
        assert abs(answer.torque) <= limits.torque_limit
        assert not loop.supervisor.fault or answer.force == 0.0


@pytest.mark.requirement('S-002')
@given(events)
def test_valid_measurements_restart_the_motion_after_faults(
    happens: list[Callable[[Loop], ForceCommand | None]],
) -> None:
    """After any faults, a second of valid inputs, a cleared stop and a target give a force."""
    loop = Loop()
    for event in happens:
        event(loop)
    loop.depth = 0.02
    loop.passes(2 * SECOND)
    loop.request(RESUME)
    for _ in range(10):
        loop.measure()
        loop.wrench()
        loop.tip()
    loop.clear()
    # A needle that was moved during the fault needs a new target.
    loop.measure()
    loop.aim(0.1)
    answer = loop.pushes()
    assert answer.reference
    assert answer.error[0] == answer.reference[0] - loop.depth
    assert loop.supervisor.diagnose(loop.now)[:2] == (Severity.INFO, None)


@given(st.lists(st.sampled_from(EVENTS[:21]), max_size=30))
def test_zero_force_without_a_target(happens: list[Callable[[Loop], ForceCommand | None]]) -> None:
    """For any events except a target or a trajectory; a measurement still has an answer."""
    loop = Loop(target=None)
    assert all(answer.force == 0.0 for event in happens if (answer := event(loop)) is not None)
    loop.passes(0)
    loop.depth = 0.02
    last = loop.measure()
    assert last is not None
    assert last.force == 0.0


@pytest.mark.requirement('S-025', 'S-026', 'S-027', 'S-028', 'S-029', 'S-030', 'S-031')
def test_all_safety_limits_are_read_by_the_supervisor() -> None:
    """In a motion with measurements of all sensors; reads of other classes do not count."""
    read = set()

    class Recorded(SafetyLimits):
        def __getattribute__(self, name: str) -> Any:
            read.add(name)
            return super().__getattribute__(name)

    limits = Recorded(tracking_error=0.1)
    # The checks of the values read all of them.
    read.clear()
    loop = Loop(observed=ObserverSettings(), limits=limits)
    for _ in range(20):
        loop.measure()
        loop.wrench()
        loop.tip()
        loop.watch()
    loop.clear()
    assert {one.name for one in fields(SafetyLimits)} <= read


@pytest.mark.requirement('S-323')
@settings(max_examples=10, deadline=None)
@given(st.floats(2e-3, 9e-3), st.integers(25, 90))
def test_needle_that_moves_away_from_its_target_is_stopped(speed: float, gap: int) -> None:
    """Also if a gap before every second measurement restarts the reference at the needle."""
    loop = Loop(target=0.04, limits=SafetyLimits())
    loop.depth = 0.035
    loop.measure()
    step = speed * PERIOD / SECOND
    while not loop.supervisor.authority.reason and loop.depth > 0.01:
        loop.now += (gap - 1) * PERIOD
        loop.measure(-step * gap, -speed)
        loop.measure(-step, -speed)
    assert 'motion away from the target' in loop.supervisor.authority.reason
    # The second reading beyond the limit stops.
    assert 0.035 - loop.depth <= SafetyLimits().tracking_error + 2.0 * gap * step + 1e-9


def test_fault_of_the_same_kind_gets_one_line() -> None:
    """Also if its line begins with another word."""
    loop = Loop()
    loop.supervisor.events.take()
    for nodes in (2, 3):
        loop.watch(nodes)
    assert [line for _, line in loop.supervisor.events.take() if line] == [
        '2 nodes publish wrench_command; no force is commanded'
    ]
    assert loop.supervisor.fault == '3 nodes publish wrench_command'


class Robot:
    """A control loop around a robot that follows its commands or not, and may report its force."""

    def __init__(self, reports: bool = True) -> None:
        self.loop, self.reports = Loop(), reports
        self.velocity = 0.0

    def runs(self, periods: int, *, obeys: bool) -> None:
        for _ in range(periods):
            answer = self.loop.supervisor._last
            self.velocity = answer.reference[1] if obeys and answer.reference else 0.0
            self.loop.now += PERIOD
            self.loop.depth += self.velocity * 1e-9 * PERIOD
            effort = [answer.force if obeys else 0.0] if self.reports else []
            self.loop.encoders(self.loop.now, self.loop.depth, self.velocity, *effort)
            self.loop.supervisor.events.take()

    @property
    def aim(self) -> float:
        return self.loop.supervisor._last.reference[0]


@pytest.mark.requirement('S-078', 'S-099')
def test_reference_waits_while_plant_does_not_follow() -> None:
    """No stop is latched, the force stays, and the motion continues when the plant follows."""
    robot = Robot()
    supervisor = robot.loop.supervisor
    robot.runs(200, obeys=True)
    assert not supervisor.fault
    start = robot.loop.depth
    robot.runs(300, obeys=False)
    assert 'the plant does not follow: it reports 0 N' in str(supervisor.fault)
    waits = robot.aim
    robot.runs(1000, obeys=False)
    force = supervisor._last.force
    robot.runs(4000, obeys=False)
    # The time that the motion waits is a sum of 4000 periods, each rounded by 2e-16 of it.
    assert robot.aim == pytest.approx(waits, rel=1e-12)
    assert supervisor.safety.stop is None
    # A tenth of a second at the velocity of the reference, and its braking distance.
    assert 0.0 < waits - start < 0.01
    # The integral is frozen: the force does not grow.
    assert supervisor._last.force == pytest.approx(force, rel=1e-6)
    assert 0.0 < force < 10.0
    robot.runs(3000, obeys=True)
    assert not supervisor.fault
    assert robot.aim > waits + 0.02


@pytest.mark.requirement('S-078')
def test_gap_ends_the_wait_of_the_reference() -> None:
    """The motion restarts from the measured depth after a gap, with zero force at first."""
    robot = Robot()
    robot.runs(200, obeys=True)
    robot.runs(300, obeys=False)
    assert robot.loop.supervisor.fault
    robot.loop.now += SECOND
    robot.runs(10, obeys=False)
    depth = robot.loop.depth
    robot.runs(3000, obeys=True)
    assert not robot.loop.supervisor.fault
    assert robot.loop.depth > depth + 0.01


@pytest.mark.requirement('S-100')
@pytest.mark.parametrize('moves', [False, True])
def test_response_monitor_ignores_robots_without_force_or_in_motion(moves: bool) -> None:
    """Missing efforts, or zero efforts of a moving needle, are no fault."""
    robot = Robot(reports=False)
    robot.runs(500, obeys=moves)
    if moves:
        for _ in range(500):
            robot.runs(1, obeys=True)
            robot.loop.encoders(robot.loop.now, robot.loop.depth, robot.velocity, 0.0)
    assert not robot.loop.supervisor.controller.guide.waits


@pytest.mark.requirement('S-112')
def test_gap_does_not_hide_why_joint_states_are_rejected() -> None:
    """Without velocities, on a busy machine; the next valid message ends it."""
    loop = Loop()
    robot = HardwareRobot(HardwareSettings(joint='slide'))
    loop.supervisor.configure(Controller(PHANTOM), SafetyLimits(), None, robot)
    loop.supervisor.activate(loop.now, {TOPIC: 1})
    loop.now += PERIOD
    reading = Reading(loop.now, '', ('slide',), ((0.02,), (), ()))
    loop.supervisor.encoders(reading, loop.now)
    reason = loop.supervisor.fault
    assert reason.startswith("joint_states has no velocity of 'slide'")
    loop.now += SECOND
    loop.supervisor.watch(loop.now, {TOPIC: 1})
    stale = 'joint_states is stale: no valid message for 1.000 s'
    assert loop.supervisor.fault == f'{stale}; {reason}'
    valid = Reading(loop.now, '', ('slide',), ((0.02,), (0.0,), ()))
    loop.supervisor.encoders(valid, loop.now)
    loop.now += SECOND
    loop.supervisor.watch(loop.now, {TOPIC: 1})
    assert loop.supervisor.fault == stale


@given(st.integers(0, 2**62), st.sampled_from(LAWS))
@settings(max_examples=10, deadline=None)
@example(1_700_000_000 * SECOND, LAWS[0])
def test_commands_do_not_depend_on_the_origin_of_time(origin: int, law: str) -> None:
    """Also with wrench and tip, from the first sample on."""

    def commands(start: int) -> list[tuple[float, float]]:
        supervisor = Supervisor()
        supervisor.configure(Controller(PHANTOM, law), SafetyLimits(), ObserverSettings())
        supervisor.activate(start, {})
        found = []
        for k in range(1, 300):
            now, depth = start + k * SECOND // 1000, 0.02 + 4e-6 * max(k - 60, 0)
            if k == 5:
                supervisor.target(0, '', 0.05, 0.0, now)
            wrench = (0.0, 1.0, 1e-3 * (k % 7), 1e-4 * (k % 5), 0.0, 0.0)
            supervisor.wrench(Reading(now, 'needle_base', (), (wrench,)), now)
            supervisor.tip(Reading(now, 'needle_entry', (), ((0.0, depth, 1e-5 * (k % 3)),)), now)
            rate = 4e-3 if k > 60 else 0.0
            state = Reading(now, '', ('insertion',), ((depth,), (rate,), ()))
            answer = supervisor.encoders(state, now)
            supervisor.finish()
            assert answer is not None
            found.append((answer.force, answer.torque))
        return found

    assert commands(SECOND + origin) == commands(SECOND)


@pytest.mark.requirement('S-051', 'S-066')
@pytest.mark.requirement('S-281')
@pytest.mark.parametrize('lag', [1, 2, 50])
def test_late_clock_does_not_change_the_commands(lag: int) -> None:
    """With simulated time: a /clock is lost, or processed after the samples."""
    late, punctual = Loop(simulated=True), Loop(simulated=True)
    for k in range(300):
        # /clock is `lag` periods late in a part of the motion.
        behind = lag * PERIOD if 100 <= k < 200 else 0
        late.now -= behind
        answer, expected = late.measure(1e-5, 1e-2, late=-behind), punctual.measure(1e-5, 1e-2)
        late.now += behind
        assert answer == expected
    assert not late.supervisor.fault
    real = Loop()
    for _ in range(100):
        real.measure(1e-5, 1e-2)
    assert real.measure(1e-5, 1e-2, late=-2 * PERIOD) == ForceCommand(real.now)


def test_repeated_measurement_gets_the_same_command() -> None:
    """The reference is not published again; after a stop the command is zero."""
    loop = Loop()
    answer = loop.pushes()
    assert loop.encoders(loop.now, loop.depth, 0.0) == ForceCommand(*answer[:3])
    loop.stop()
    assert loop.encoders(loop.now, loop.depth, 0.0) == ForceCommand(loop.now)
    # A late measurement gets no command.
    assert loop.encoders(loop.now - PERIOD, loop.depth, 0.0) is None


@pytest.mark.requirement('S-037')
def test_measurement_beyond_a_limit_gets_one_zero_command_with_its_stamp() -> None:
    """The second reading in a row latches the stop, with no further command."""
    loop = Loop()
    loop.pushes()
    loop.supervisor.safety.guard.encoders(Measurement(time=0.0, depth=0.02, velocity=0.2))
    answer = loop.measure(0.0, 0.2)
    assert answer == ForceCommand(loop.now)
    assert loop.said()[-1] == (
        'stopped: insertion speed 0.2 m/s is beyond the limit of 0.1 m/s (safety.speed); '
        'no force until ~/clear_stop'
    )


@pytest.mark.requirement('S-045', 'S-057')
def test_inactive_supervisor_accepts_only_the_stop() -> None:
    """The stop survives configuration, and measurements are not answered."""
    supervisor = Supervisor()
    reading = Reading(SECOND, '', ('insertion',), ((0.02,), (0.0,), ()))
    assert supervisor.request(STOP, SECOND)[2] == ForceCommand(SECOND)
    assert supervisor.encoders(reading, SECOND) is None
    assert supervisor.target(0, '', 0.1, 0.0, SECOND) is None
    assert supervisor.events.last_rejection == 'target rejected: the controller is not active'
    assert supervisor.request(PAUSE, SECOND)[1] == (
        'pause refused: stopped: requested by a user; ~/clear_stop releases'
    )
    supervisor.configure(Controller(PHANTOM), SafetyLimits())
    supervisor.activate(SECOND, {})
    assert supervisor.encoders(reading, SECOND) == ForceCommand(SECOND)
    assert supervisor.diagnose(SECOND)[:2] == (
        Severity.ERROR,
        'requested by a user; ~/clear_stop releases',
    )


def test_load_of_ground_truth_is_compensated() -> None:
    """The load is added to the force of the law; a straight state adds nothing."""
    straight, bent = Loop(), Loop()
    state = [PHANTOM.length - 0.02, 0.0, 3e-4, 0.0]
    rest = (0.0,) * 4
    for loop, positions in ((straight, [*state[:2], 0.0, 0.0]), (bent, state)):
        reading = Reading(loop.now, '', (), (tuple(positions), rest, ()))
        assert loop.supervisor.truth(reading, loop.now) is None
    load = -NeedleModel(PHANTOM).bias_forces([*state, *rest])[0]
    forces = [[loop.measure().force for _ in range(20)] for loop in (straight, bent)]
    assert bent.supervisor.bending.load == pytest.approx(load)
    assert forces[1][-1] != forces[0][-1]
    wild = Reading(bent.now, '', (), ((0.18, 0.0, 1e308, 0.0), rest, ()))
    bent.supervisor.truth(wild, bent.now)
    assert bent.supervisor.bending.load == 0.0
    assert 'ignored' in bent.said()[-1]


@pytest.mark.requirement('S-075')
def test_load_of_ground_truth_ends_with_its_topic() -> None:
    """It is zero after the timeout of the measurements."""
    loop = Loop()
    state = (PHANTOM.length - 0.02, 0.0, 3e-4, 0.0)
    loop.supervisor.truth(Reading(loop.now, '', (), (state, (0.0,) * 4, ())), loop.now)
    loop.watch()
    assert loop.supervisor.bending.load != 0.0
    loop.passes(SECOND // 5)
    assert loop.supervisor.bending.load == 0.0


@pytest.mark.requirement('S-038')
def test_stop_resets_the_observer() -> None:
    """The stop, and its release."""
    loop = Loop(observed=ObserverSettings())
    observer = loop.supervisor.bending.observer
    for word in (STOP, CLEAR_STOP):
        loop.measure()
        loop.supervisor.finish()
        assert observer.ready
        loop.request(word)
        assert not observer.ready


def test_wrench_waits_for_encoders_of_its_stamp() -> None:
    """A wrench received before the encoder sample of its stamp is used with that sample."""
    loop = Loop(observed=ObserverSettings())
    taken: list[tuple[float, float] | None] = []
    observer = loop.supervisor.bending.observer
    observer.update = lambda *values: taken.append(values[3])  # type: ignore[method-assign]
    loop.measure()
    loop.now += PERIOD
    loop.wrench(moment=0.25)
    loop.encoders(loop.now, loop.depth, 0.0)
    loop.measure()
    loop.supervisor.finish()
    assert taken == [None, (0.0, 0.25), None]


def test_no_measurement_is_answered_before_the_activation() -> None:
    """Neither by a new supervisor nor by a configured one, with nothing left to finish."""
    supervisor = Supervisor()
    for configured in (False, True):
        if configured:
            supervisor.configure(Controller(PHANTOM), SafetyLimits())
        state = Reading(SECOND, '', ('insertion',), ((0.02,), (0.0,), ()))
        assert supervisor.encoders(state, SECOND) is None
        supervisor.finish()
        assert not supervisor.events.take()


def test_no_command_waits_for_the_observer() -> None:
    """Each update follows its command; a later update gives the same estimate."""
    estimates = []
    for later in (False, True):
        loop, rng = Loop(observed=ObserverSettings()), np.random.default_rng(1)
        observer = loop.supervisor.bending.observer
        assert observer is not None
        for _ in range(200):
            before = observer.ready and observer.tip_deflection
            loop.now += PERIOD
            loop.tip(1e-3 + 1e-5 * float(rng.standard_normal()))
            loop.measure(1e-5, 0.01)
            assert later or (observer.ready and observer.tip_deflection) == before
            if not later:
                loop.supervisor.finish()
                assert observer.tip_deflection != before
        loop.supervisor.finish()
        estimates.append(observer.tip_deflection)
    assert estimates[0] == estimates[1]


def test_invalid_observer_settings_are_named() -> None:
    """The error contains the parameter name."""
    with pytest.raises(ValueError, match=r'^observer\.filter_rate must be a whole multiple'):
        Supervisor().configure(
            Controller(PHANTOM), SafetyLimits(), ObserverSettings(filter_rate=1234.5)
        )


@pytest.mark.requirement('S-003')
def test_log_lines_of_a_kind_are_limited_to_one_per_second() -> None:
    """Each kind has its own limit; a line without a kind is always logged."""
    times = iter([0.0, 0.5, 1.0, 1.9, 2.1, 2.1])
    events = EventLog(steady=lambda: next(times))
    for number in range(5):
        events.add(Severity.WARNING, f'line {number}', 'stale')
    events.add(Severity.WARNING, 'another', 'jump')
    events.add(Severity.INFO, 'always')
    assert events.changed
    said = [line for _, line in events.take()]
    # Suppressed lines are counted in the next line of their kind.
    assert said == [
        *('line 0', 'line 2 (1 similar omitted)', 'line 4 (1 similar omitted)'),
        *('another', 'always'),
    ]
    assert not events.changed
    assert events.take() == []


@pytest.mark.requirement('S-003')
def test_rejections_are_merged_if_only_their_numbers_differ() -> None:
    """Of one second; each other reason has its line, also of the same topic."""
    now = 0.0
    events = EventLog(steady=lambda: now)
    depth = 'target rejected: the needle is at {} mm already'
    others = ['target rejected: paused', 'target rejected: stopped: a limit']
    frames = [f'target must be in frame {name!r}' for name in ('', 'tip', 'tool0', 'tool1')]
    for reason in [depth.format('-0.50'), *others, *frames, depth.format('1e-05'), *others]:
        events.reject(reason)
    assert [line for _, line in events.take()] == [depth.format('-0.50'), *others, *frames]
    assert events.rejected == 10
    now = 1.0
    events.reject(depth.format(3))
    assert [line for _, line in events.take()] == [f'{depth.format(3)} (1 similar omitted)']
    # Any number of reasons is bounded: afterwards those of a topic are merged.
    for number in range(2000):
        events.reject(f'target must be in frame {"a" * (number % 400)}{number:x}z')
    assert len(events.take()) <= 100


def test_many_rejected_targets_give_one_log_line_per_second() -> None:
    """All are counted; /diagnostics changes as often as the log."""
    loop = Loop()
    changes = 0
    for _ in range(1000):
        loop.supervisor.target(0, '', 9.0, 0.0, loop.now)
        changes += loop.supervisor.events.changed
        loop.supervisor.events.take()
    assert loop.supervisor.events.rejected == 1000
    assert changes == 1


@pytest.mark.requirement('S-175')
def test_path_with_too_many_points_is_rejected_in_a_short_line() -> None:
    """The number of points is checked first; long and unprintable lines are shortened."""
    loop = Loop()
    loop.said()
    many = [[float(k)] for k in range(MOST_POINTS + 1)]
    times = [float(k) for k in range(MOST_POINTS + 1)]
    loop.supervisor.trajectory(0, '', JointPath(['insertion'], times, many), loop.now)
    (line,) = loop.said()
    assert line == f'joint_trajectory rejected: a path may have at most {MOST_POINTS} points'
    loop.seconds += 1.0
    evil = '\x1b]0;evil\x07\u202e' + 1000 * 'x'
    loop.supervisor.trajectory(0, evil, JointPath(['insertion'], [1.0], [[0.03]]), loop.now)
    line = loop.said()[-1]
    assert len(line) <= 500
    assert line.isprintable()


@pytest.mark.requirement('S-035')
def test_force_above_eulers_load_gives_a_warning() -> None:
    """With almost the whole needle outside and stronger friction, it buckles at 13 N."""
    loop = Loop()
    loop.depth = 0.002
    loop.supervisor.target(0, '', 0.1, 0.0, loop.now)
    said = []
    for _ in range(800):
        # A fifth of the velocity of the reference.
        loop.measure(2e-6, 2e-3)
        said += loop.said()
    (line,) = (one for one in said if 'Euler' in one)
    assert "exceeds Euler's load 13.2 N of the part outside" in line


@pytest.mark.parametrize('what', ['target', 'trajectory'])
def test_request_is_valid_from_its_stamp_in_any_order_of_arrival(what: str) -> None:
    """The commands are equal; it is answered before the next sample, which may await that."""

    def run(before: int) -> list[ForceCommand | None]:
        loop, answers = Loop(target=None), []
        for k in range(20):
            if k == before:
                stamp = 100 * SECOND + 11 * PERIOD
                # The clock is published before the sample.
                now = max(loop.now, stamp)
                if what == 'target':
                    loop.supervisor.target(stamp, '', 0.1, 0.0, now)
                else:
                    path = JointPath(['insertion'], [0.0, 1.0], [[0.02], [0.0205]])
                    loop.supervisor.trajectory(stamp, '', path, now)
            answers.append(loop.measure())
            if k == 10 and before == 10:
                (answer,) = loop.supervisor.requests.status().answers
                assert answer.verdict is Verdict.ACCEPTED
        assert loop.said() == []
        return answers

    # The sample with index 10 has the stamp.
    late = run(before=11)
    assert late == run(before=10)
    forces = [answer.force for answer in late if answer is not None]
    assert forces[:11] == [0.0] * 11
    assert all(forces[11:])


def test_request_with_future_stamp_waits_and_retract_supersedes_it() -> None:
    """The later of two requests is executed."""
    loop = Loop(target=None)
    loop.measure()
    loop.supervisor.target(loop.now + 10 * PERIOD, '', 0.1, 0.0, loop.now)
    assert loop.supervisor.request(RETRACT, loop.now)[0]
    for _ in range(30):
        loop.measure()
    assert loop.supervisor.controller is not None
    assert loop.supervisor.controller.target == 0.01


@pytest.mark.requirement('S-291')
def test_target_sent_during_a_stop_is_not_followed_after_it() -> None:
    """It is late, or repeated by its sender."""
    loop = Loop()
    loop.measure()
    loop.stop()
    loop.measure()
    sent = loop.now
    loop.measure()
    loop.clear()
    loop.supervisor.target(sent, '', loop.depth + 0.01, 0.0, loop.now)
    assert all(answer is None or answer.force == 0.0 for answer in map(loop.measure, [0.0] * 50))


@pytest.mark.requirement('S-010', 'S-014')
def test_clearance_of_another_node_does_not_end_a_violation() -> None:
    """The limit stops the system again, also a retraction; below the limit the stop ends."""
    loop, other = Loop(), Authority('/steering')
    loop.measure()
    loop.request(RETRACT)
    for axial in (50.0, 50.0, 50.0):
        loop.measure()
        loop.wrench(axial)
    authority = loop.supervisor.authority
    assert 'axial force 50 N' in authority.reason
    other.receive(authority.state)
    assert other.request(CLEAR_STOP)[0]
    authority.receive(other.state)
    loop.supervisor.obey(loop.now)
    assert 'axial force 50 N' in authority.reason
    assert loop.measure() == ForceCommand(loop.now)
    loop.wrench(0.0)
    loop.clear()
    assert authority.reason == ''


def test_live_friction_changes_the_expected_motion() -> None:
    """A needle that does not move is blocked with this friction, not with twenty times it."""
    for factor, stops in ((1.0, True), (20.0, False)):
        loop = Loop()
        controller = loop.supervisor.controller
        loop.supervisor.change(
            replace(
                PHANTOM,
                coulomb_friction=factor * PHANTOM.coulomb_friction,
                viscous_friction=factor * PHANTOM.viscous_friction,
            ),
            controller.law,
            {},
        )
        for _ in range(300):
            loop.measure()
        assert bool(loop.supervisor.authority.reason) == stops


@pytest.mark.requirement('S-009')
def test_repeated_retraction_withdraws_a_needle_that_was_moved() -> None:
    """The state of the system remains the same in between."""
    loop = Loop(target=None)
    loop.measure()
    loop.request(RETRACT)
    for _ in range(2):
        loop.depth = 0.02
        loop.supervisor.activate(loop.now, {TOPIC: 1})
        loop.supervisor.controller.guide.forget()
        loop.measure()
        loop.request(RETRACT)
        assert loop.supervisor.controller.target == 0.01


@pytest.mark.requirement('S-085')
def test_clock_set_back_is_detected() -> None:
    """By more than the timeout of 0.1 s; forward steps and pauses of the clock are no fault."""
    supervisor, timeout = Supervisor(), SECOND // 10
    steps = [10.0, 10.0, 10.5, 99.0, 98.95, 50.0, 50.0]
    found = [supervisor.clock_went_back(round(t * SECOND), timeout) for t in steps]
    assert found == [0, 0, 0, 0, 0, 48.95, 0]


@pytest.mark.requirement('S-030', 'S-031', 'S-040')
@pytest.mark.parametrize(
    ('topic', 'component', 'size'),
    [
        *(('wrench', k, size) for k, size in enumerate([11.0, 31.0, 11.0, 1.1, 1.1, 1.1])),
        ('tip', 0, 0.051),
        ('tip', 2, 0.051),
    ],
)
@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_every_component_of_a_sensor_has_a_limit(
    topic: str, component: int, size: float, sign: float
) -> None:
    """Two readings beyond the limit stop; readings just within all limits do not."""
    loop = Loop()
    loop.aim(0.05)
    loop.pushes()
    values = [0.0] * (6 if topic == 'wrench' else 3)

    def read(scale: float) -> None:
        loop.measure()
        shown = [scale * one for one in values]
        if topic == 'wrench':
            loop.supervisor.wrench(Reading(loop.now, 'needle_base', (), (tuple(shown),)), loop.now)
        else:
            shown[1] += 0.02
            loop.supervisor.tip(Reading(loop.now, 'needle_entry', (), (tuple(shown),)), loop.now)

    values[component] = sign * size
    # A jump of the sensor is discarded first.
    for _ in range(3):
        read(0.9)
    assert loop.supervisor.authority.reason == ''
    for _ in range(3):
        read(1.0)
    assert 'is beyond the limit' in loop.supervisor.authority.reason


@pytest.mark.requirement('S-029')
@pytest.mark.parametrize(('within', 'beyond'), [(0.25, 0.26), (-0.045, -0.055)])
def test_depth_of_the_tip_has_a_limit(within: float, beyond: float) -> None:
    """50 mm and the tolerance outside of the range of depths, 1 to 200 mm."""
    guard = Loop().supervisor.safety.guard
    assert guard.tip(0.0, within) is None
    assert guard.tip(0.0, beyond) is None
    assert 'distance of the tip' in (guard.tip(0.0, beyond) or '')


@pytest.mark.requirement('S-030')
def test_component_that_a_sensor_does_not_measure_is_no_fault() -> None:
    """NaN in a component that the controller does not use."""
    loop = Loop()
    loop.aim(0.05)
    loop.pushes()
    for _ in range(5):
        loop.measure()
        wrench, tip = (nan, 1.0, 0.0, 0.0, nan, nan), (nan, nan, 1e-3)
        loop.supervisor.wrench(Reading(loop.now, 'needle_base', (), (wrench,)), loop.now)
        loop.supervisor.tip(Reading(loop.now, 'needle_entry', (), (tip,)), loop.now)
    assert loop.supervisor.authority.reason == ''
    status = loop.supervisor.diagnose(loop.now)[2]
    assert status.input['base_wrench'].accepted == status.input['tip_deflection'].accepted == 5
