# SPDX-License-Identifier: Apache-2.0
"""
Random errors in `hardware.*`, on three simulated robots: motion of the needle before a refusal.

The robots know nothing about the controller: a stage in mm that follows positions, a spindle in
rad whose drive follows positions by a velocity loop, and a slide that is driven by forces. Each
error is also simulated without the check: it is harmful if the needle then moves more than 2 mm
beyond the requested motion, or rests elsewhere than the controller reports. Time is simulated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite, pi
from typing import Any, Final, NamedTuple

from benchmarks.measure import Bar
from benchmarks.page import Answer, PageSection, Tick
from benchmarks.robots import OTHER, RATE, SimulatedRobot, Slide, Spindle, Stage
from needle_controller import (
    Controller,
    ControllerSettings,
    ForceCommand,
    HardwareSettings,
    ReferenceLimits,
    Robot,
    SafetyLimits,
)
from needle_controller.commissioning import Commissioning, CommissioningSettings
from needle_controller.supervisor import Supervisor
from needle_dynamics import NeedleParameters
from needle_ros.errors import ParameterError
from needle_ros.process import cores
from needle_ros.process_pool import processes
from needle_ros.status import CommissioningPhase
from needle_ros.timing import NANOSECONDS
import numpy as np

#: Periods between two checks of the inputs.
_WATCH: Final = 10

#: Requested motion, and allowed distance from it [m].
_MOTION: Final = 0.01
HARMFUL: Final = 2e-3

#: Duration of a session [s], its request, and the rest after a refusal.
_DURATION: Final = 7.5
_REQUEST: Final = 1.0
_REST: Final = 0.5

_PHANTOM: Final = NeedleParameters.preset('phantom')
_AXES: Final = ('x', 'y', 'z', '-x', '-y', '-z')


@dataclass(frozen=True)
class RobotSetup:
    """A robot, and the parameters of the controller for it."""

    robot: Callable[[], SimulatedRobot]
    hardware: dict[str, Any]
    facts: dict[str, Any]
    #: Rate and delay of the controller.
    rate: float = RATE
    delay: int = 1
    #: Whether commands reach the robot.
    connected: bool = True


def setup(kind: type[SimulatedRobot], rng: np.random.Generator) -> RobotSetup:
    """Draw a robot with its correct configuration, and depths measured with a ruler."""
    sign = float(rng.choice([-1.0, 1.0]))
    scale = {Stage: 1e-3, Spindle: float(rng.choice([2e-3, 5e-3])) / (2.0 * pi), Slide: 1.0}[kind]
    zero = float(rng.uniform(-0.3, 0.3)) / scale
    axis, reaction = str(rng.choice(_AXES)), bool(rng.integers(2))
    # The friction within the uncertainty of the gains, the delay within the documented range.
    lag = float(rng.uniform(5e-3, 0.04))
    dead = int(rng.integers(0, 5)) if kind is not Slide else 1
    # A third of the needles start at the entry.
    depth = float(rng.uniform(0.0, 1e-3) if rng.integers(3) == 0 else rng.uniform(5e-3, 0.06))
    values: dict[str, Any] = {
        'joint': 'axis', 'gain': sign * scale, 'zero': zero, 'force_axis': axis,
        'reaction': reaction, 'friction': float(rng.uniform(0.7, 1.3)), 'lag': lag, 'dead': dead,
        'depth': depth,
        'other': float(rng.uniform(-0.3, 0.3)) / scale, 'seed': int(rng.integers(1 << 30)),
    }  # fmt: skip
    effort = kind is Slide
    hardware = {
        'joint': 'axis', 'sign': sign, 'scale': scale, 'zero': zero, 'force_axis': axis,
        'reaction': reaction, 'command': 'effort' if effort else 'position',
        'command_topic': 'commands',
        'command_type': 'joint_trajectory' if kind is Stage else 'float64_multi_array',
    }  # fmt: skip
    robot = kind(**values)
    depths = (float(rng.uniform(0.0, 0.01)), float(rng.uniform(0.12, 0.2)))
    off = rng.uniform(-2e-4, 2e-4, 3).tolist()
    facts = {
        'positions': tuple(robot.position(depth) for depth in depths),
        'depths': tuple(depth + error for depth, error in zip(depths, off, strict=False)),
        'start_depth': robot.depth + off[2],
    }
    return RobotSetup(lambda: kind(**values), hardware, facts)


# Errors: each returns a wrong configuration of a correct one.

_Error = Callable[[RobotSetup, np.random.Generator], RobotSetup]


def _changed(one: RobotSetup, **values: Any) -> RobotSetup:
    return replace(one, hardware={**one.hardware, **values})


def changed_robot(one: RobotSetup, **values: Any) -> RobotSetup:
    """Return the same configuration for another robot."""
    return replace(one, robot=lambda: replace(one.robot(), **values))


def _wrong_scale(one: RobotSetup, rng: np.random.Generator) -> RobotSetup:
    common = [1e3, 1e-3, 10.0, 0.1, 25.4, 2.0 * pi, 180.0 / pi, float(rng.uniform(0.3, 3.0))]
    return _changed(one, scale=one.hardware['scale'] * common[rng.integers(len(common))])


def _scale_and_zero(one: RobotSetup, rng: np.random.Generator) -> RobotSetup:
    # The depth at the start is correct.
    wrong = _wrong_scale(one, rng).hardware
    robot, gain = one.robot(), wrong['sign'] * wrong['scale']
    zero = robot.position(robot.depth) - robot.depth / gain
    return _changed(one, scale=wrong['scale'], zero=zero)


def _sign(one: RobotSetup, _rng: np.random.Generator) -> RobotSetup:
    return _changed(one, sign=-one.hardware['sign'])


def _sign_and_zero(one: RobotSetup, _rng: np.random.Generator) -> RobotSetup:
    # The depth at the start is correct.
    robot = one.robot()
    position = robot.position(robot.depth)
    return _changed(_sign(one, _rng), zero=2.0 * position - one.hardware['zero'])


def _zero(one: RobotSetup, rng: np.random.Generator) -> RobotSetup:
    off = float(rng.choice([-1.0, 1.0]) * rng.uniform(2e-3, 0.1))
    return _changed(one, zero=one.hardware['zero'] + off / one.hardware['scale'])


def _lost_zero(one: RobotSetup, rng: np.random.Generator) -> RobotSetup:
    # The encoder has another zero than at the time of the measurement.
    robot = one.robot()
    off = float(rng.choice([-1.0, 1.0]) * rng.uniform(2e-3, 0.1))
    return changed_robot(one, zero=robot.zero + off / robot.gain)


def _joint(one: RobotSetup, rng: np.random.Generator) -> RobotSetup:
    robot = one.robot()
    near = robot.position(robot.depth + float(rng.uniform(-0.02, 0.02)))
    return _changed(changed_robot(one, other=near), joint=OTHER)


def _rate(one: RobotSetup, rng: np.random.Generator) -> RobotSetup:
    return replace(one, rate=float(rng.choice([50.0, 100.0, 500.0, 1000.0])))


def _delay(one: RobotSetup, rng: np.random.Generator) -> RobotSetup:
    robot = one.robot()
    if isinstance(robot, Slide):
        return changed_robot(one, dead=int(rng.integers(4, 12)))
    return changed_robot(one, lag=float(rng.uniform(0.1, 0.3)), dead=int(rng.integers(5, 20)))


def _force_axis(one: RobotSetup, rng: np.random.Generator) -> RobotSetup:
    own = one.hardware['force_axis'][-1]
    return _changed(one, force_axis=str(rng.choice([a for a in _AXES if a[-1] != own])))


def _force_sign(one: RobotSetup, _rng: np.random.Generator) -> RobotSetup:
    return _changed(one, reaction=not one.hardware['reaction'])


def _lead(one: RobotSetup, _rng: np.random.Generator) -> RobotSetup:
    return _changed(one, lead=2.0, speed=50.0)


def _topic(one: RobotSetup, _rng: np.random.Generator) -> RobotSetup:
    return replace(one, connected=False)


def _two(one: RobotSetup, rng: np.random.Generator) -> RobotSetup:
    names = [name for name in ERRORS if name != 'two of these']
    for name in rng.choice(names, 2, replace=False):
        one = ERRORS[str(name)](one, rng)
    return one


ERRORS: Final[dict[str, _Error]] = {
    'scale': _wrong_scale,
    'scale with matching zero': _scale_and_zero,
    'sign': _sign,
    'sign with matching zero': _sign_and_zero,
    'zero': _zero,
    'zero of the encoder': _lost_zero,
    'joint': _joint,
    'rate': _rate,
    'delay': _delay,
    'force axis': _force_axis,
    'force sign': _force_sign,
    'lead and speed': _lead,
    'command topic': _topic,
    'two of these': _two,
}


class FirstMotionSession(NamedTuple):
    """Result of a session: reason of a refusal or stop, and motion of the needle."""

    reason: str
    #: Phase of the check; None if the controller was not configured.
    phase: CommissioningPhase | None
    #: Largest distance from the start [m], and from the requested motion.
    motion: float
    beyond: float
    #: Largest difference of the true and the reported motion, and of the depths at the end [m]
    #: if a target is set.
    apart: float
    error: float
    arrived: bool
    #: Result of a first motion that has passed.
    result: str = ''


def run(
    one: RobotSetup,
    *,
    check: bool,
    duration: float = _DURATION,
    limits: ReferenceLimits | None = None,
    words: Mapping[float, str] | None = None,
) -> FirstMotionSession:
    """
    Run a session with a request of 10 mm after 1 s; without the check, as far as it goes.

    `limits` are those of the reference, and `words` has further requests of a user by their
    times [s].
    """
    later = dict(words or {})
    robot, now = one.robot(), 1_700_000_000 * NANOSECONDS
    start = robot.depth
    period = round(NANOSECONDS / RATE)
    try:
        adapter = Robot(HardwareSettings(**one.hardware))
        control = ControllerSettings(rate=one.rate, delay=float(one.delay))
        controller = Controller(_PHANTOM, settings=control, limits=limits)
        adapter.configure(controller)
        facts = CommissioningSettings(enabled=check, **one.facts)
        commissioning = Commissioning(facts, adapter, controller, SafetyLimits())
    except ParameterError as error:
        return FirstMotionSession(str(error), None, 0.0, 0.0, 0.0, 0.0, False)
    controller.check = commissioning.command
    supervisor = Supervisor(lambda: now / NANOSECONDS)
    supervisor.configure(controller, SafetyLimits(), None, adapter)
    supervisor.activate(now, {'wrench_command': 1})
    begin, ends = now, now + round(duration * NANOSECONDS)
    requested, motion, beyond, apart, reported = False, 0.0, 0.0, 0.0, start
    first: float | None = None
    sample = 0
    named = one.hardware['command_type'] != 'float64_multi_array'
    while now < ends:
        now += period
        supervisor.wrench(adapter.wrench(robot.wrench(now)), now)
        reading, measured = robot.states(now), robot.depth
        answer: ForceCommand | None = supervisor.encoders(reading, now)
        if sample % _WATCH == 0:
            answer = supervisor.watch(now, {'wrench_command': 1}) or answer
        sample += 1
        value = None
        if answer is not None:
            stopped = supervisor.safety.stop is not None
            values = adapter.command(answer, supervisor.depth(now), stopped=stopped)
            if values is not None and one.connected:
                # A driver of named joints moves the named joint.
                moved = not named or adapter.settings.joint == robot.joint
                value = values[0] if moved and isfinite(values[0]) else None
        robot.take(value)
        if not isfinite(robot.depth) or abs(robot.depth) > 1e6:
            return FirstMotionSession('', commissioning.phase, inf, inf, inf, inf, False)
        motion = max(motion, abs(robot.depth - start))
        beyond = max(beyond, start - robot.depth, robot.depth - start - _MOTION)
        own = 0 if adapter.settings.joint == OTHER else 1
        reported = adapter.length(reading.values[0][own])
        first = reported if first is None else first
        apart = max(apart, abs(measured - start - (reported - first)))
        if not requested and now - begin > _REQUEST * NANOSECONDS:
            supervisor.target(0, '', start + _MOTION, 0.0, now)
            requested = True
        for time in [time for time in later if now - begin > time * NANOSECONDS]:
            supervisor.request(later.pop(time), now)
        if not check and max(beyond, apart) > HARMFUL:
            break
        if supervisor.safety.stop is not None and not later:
            ends = min(ends, now + round(_REST * NANOSECONDS))
    aimed = controller.target is not None
    return FirstMotionSession(
        supervisor.safety.stop or '',
        commissioning.phase,
        motion,
        beyond,
        apart,
        measured - reported if aimed else 0.0,
        aimed and abs(reported - start - _MOTION) < 5e-4,
        commissioning.result,
    )


class ErrorCase(NamedTuple):
    """An error on a robot; without an error for correct configurations."""

    error: str
    robot: type[SimulatedRobot]
    seed: int


class ErrorOutcome(NamedTuple):
    """Sessions with and without the check."""

    case: ErrorCase
    checked: FirstMotionSession
    #: None for a correct configuration.
    unchecked: FirstMotionSession | None

    @property
    def harmful(self) -> bool:
        """Whether the needle moves beyond the request, or is elsewhere than reported."""
        found = self.unchecked
        return found is not None and max(found.beyond, found.apart, abs(found.error)) > HARMFUL

    @property
    def refused(self) -> bool:
        """Whether the check ended the session, or a limit did."""
        return bool(self.checked.reason)


KINDS: Final = (Stage, Spindle, Slide)


def cases(count: int, correct: int) -> list[ErrorCase]:
    """Return random errors, each kind and robot equally often, and correct configurations."""
    names = list(ERRORS)
    found = [
        ErrorCase(names[k // len(KINDS) % len(names)], KINDS[k % len(KINDS)], k)
        for k in range(count)
    ]
    return found + [ErrorCase('', KINDS[k % len(KINDS)], 10_000 + k) for k in range(correct)]


def measure(case: ErrorCase) -> ErrorOutcome:
    """Run both sessions of a case."""
    rng = np.random.default_rng([7, case.seed])
    one = setup(case.robot, rng)
    if case.error:
        one = ERRORS[case.error](one, rng)
    return ErrorOutcome(case, run(one, check=True), run(one, check=False) if case.error else None)


def compare(tick: Tick, errors: int = 504, correct: int = 90) -> Answer:
    """Measure random errors and correct configurations."""
    tick('sessions in simulated time')
    with processes(cores()) as pool:
        return conclude(list(pool.map(measure, cases(errors, correct))))


def conclude(found: Sequence[ErrorOutcome]) -> Answer:
    """Return tables and bars of the measured cases."""
    wrong = [one for one in found if one.case.error]
    right = [one for one in found if not one.case.error]
    harmful = [one for one in wrong if one.harmful]
    sections = [
        PageSection(
            'Errors',
            ('error in `hardware.*`', 'sessions', 'harmful', 'of these refused', 'refused',
             'worst motion with the check [mm]', 'without [mm]'),
            [_row(name, [one for one in wrong if one.case.error == name]) for name in ERRORS],
            'Motion is the largest distance of the needle from its start until 0.5 s after the '
            'refusal; without the check, until the error is found to be harmful. A request is '
            '10 mm. An error is harmful if the needle, without the check, moves more than '
            '2 mm beyond the request, moves more than 2 mm otherwise than reported, or rests more '
            'than 2 mm from the reported depth.',
        ),
        PageSection(
            'Correct configurations',
            ('robot', 'sessions', 'refused', 'at the target'),
            [_correct(kind, [one for one in right if one.case.robot is kind]) for kind in KINDS],
            'Units, signs, zeros, sensor axes, friction (30 %), delays and noise are drawn, and '
            'depths are measured to 0.2 mm.',
        ),
    ]  # fmt: skip
    motion = 1e3 * max((one.checked.motion for one in wrong if one.refused), default=0.0)
    bars = [
        Bar('errors', float(len(wrong)), 500.0, at_least=True),
        Bar('harmful errors that are not refused',
            float(sum(not one.refused for one in harmful)), 0.0),
        Bar('motion of the needle before and after a refusal', motion, 1e3 * HARMFUL, 'mm'),
        Bar('correct configurations that are refused',
            float(sum(one.refused for one in right)), 0.0),
        Bar('correct configurations not at the target',
            float(sum(not one.checked.arrived for one in right)), 0.0),
    ]  # fmt: skip
    return sections, bars


def _row(name: str, found: Sequence[ErrorOutcome]) -> tuple[str, ...]:
    harmful = [one for one in found if one.harmful]
    refused = [one for one in found if one.refused]
    moved = [one.checked.motion for one in found if one.refused or one.harmful]
    return (
        name,
        f'{len(found)}',
        f'{len(harmful)}',
        f'{sum(one.refused for one in harmful)}',
        f'{len(refused)}',
        f'{1e3 * max(moved, default=0.0):.2f}',
        f'{1e3 * max((one.unchecked.motion for one in found if one.unchecked), default=0.0):.4g}',
    )


def _correct(kind: type[SimulatedRobot], found: Sequence[ErrorOutcome]) -> tuple[str, ...]:
    refused = sum(one.refused for one in found)
    arrived = sum(one.checked.arrived for one in found)
    return kind.__name__.lower(), f'{len(found)}', f'{refused}', f'{arrived}'
