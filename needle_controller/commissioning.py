"""Commissioning: compare a robot and its first motion with its configuration."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator
from dataclasses import dataclass
from math import nan
from typing import TypeAlias

from needle_controller.controller import Controller, ControllerOutput, Measurement
from needle_controller.hardware import POSITION, Robot, STAMPS
from needle_controller.laws.axis import Axis
from needle_controller.reference.setpoint import Setpoint
from needle_controller.safety.limits import SafetyLimits
from needle_controller.safety.rate_monitor import RateMonitor
from needle_ros.axes import AXES
from needle_ros.errors import JobError, ParameterError
from needle_ros.settings import check_constants, constant, flag
from needle_ros.status import CommissioningPhase
from needle_ros.timing import NANOSECONDS
import numpy as np

#: Value of `start_depth` that is not stated, and least distance of the two depths [m].
_UNSTATED, _APART = -1.0, 0.01
#: Measurements at rest before the motion, and standard deviations of noise that are no response.
_AT_REST, _SIGMAS = 100, 8.0
#: Tolerance of a displacement, as a fraction of `distance`, and longest time to settle [s].
_TOLERANCE, _SETTLING = 0.2, 1.0
#: The first force, as a fraction of the largest, and the time in which it doubles [s]: a wrong
#: unit delays the motion, but does not enlarge it.
_FIRST, _DOUBLING = 1e-5, 0.15
#: Least and largest force that begins the motion, as multiples of the nominal friction.
_WEAKER, _STRONGER = 0.1, 1.5
#: Number of measurements of a delay, and least change of the force that is a response [N].
_TRIES, _FELT = 3, 0.05

#: Receives measurements and yields forces [N].
_Steps: TypeAlias = Generator[float, Measurement, None]


@dataclass(frozen=True, slots=True, kw_only=True)
class CommissioningSettings:
    """Facts measured at the robot, and the first motion."""

    enabled: bool = flag(True, 'check hardware.* by the first motion; false skips the check')
    positions: tuple[float, ...] = constant(
        (), 'unit of the robot', 'two positions of the joint, from its topic', low=-1e9, high=1e9
    )
    depths: tuple[float, ...] = constant((), 'm', 'insertion depths measured there', low=-10.0)
    start_depth: float = constant(
        _UNSTATED, 'm', 'measured insertion depth at the start; -1: not stated', low=_UNSTATED
    )
    tolerance: float = constant(1e-3, 'm', 'tolerance of the measured depths', high=1.5e-3)
    distance: float = constant(5e-4, 'm', 'length of the first motion', low=1e-4, high=1.5e-3)
    speed: float = constant(1e-3, 'm/s', 'its speed', low=1e-4, high=5e-3)
    lag: float = constant(0.08, 's', 'largest delay of a robot that follows positions')

    def __post_init__(self) -> None:
        check_constants(self)
        counts = {len(self.positions), len(self.depths)}
        apart = counts == {2} and len({*self.positions}) == 2 and np.ptp(self.depths) >= _APART
        if counts != {0} and not apart:
            raise ParameterError(
                f'positions and depths must be two each, {_APART:g} m apart or more, got '
                f'{[*self.positions]} and {[*self.depths]}'
            )


def _require(condition: object, reason: str) -> None:
    if not condition:
        raise JobError(reason)


class Commissioning:
    """
    Compare the configuration with measured depths, and the first motion with the configuration.

    The first motion is small, slow, and out of the tissue. A robot with position commands follows
    a ramp. With efforts, the force grows from nearly zero until the needle moves. Before, no force
    acts and no position is commanded. `phase` and `result` are its state.
    """

    def __init__(
        self,
        settings: CommissioningSettings,
        robot: Robot,
        controller: Controller,
        limits: SafetyLimits,
    ) -> None:
        self._settings, self._robot, self._controller = settings, robot, controller
        self._time = self._depth = nan
        self.phase, self.result = CommissioningPhase.SKIPPED, ''
        if settings.enabled:
            self._check_configuration(limits)
            self._restart(CommissioningPhase.WAITING)

    def _check_configuration(self, limits: SafetyLimits) -> None:
        """Reject a sign, scale, zero, lead or speed that contradicts the measured depths."""
        settings, own = self._settings, self._robot.settings
        if not settings.positions:
            return
        (p, q), (a, b), tolerance = settings.positions, settings.depths, settings.tolerance
        gain = (b - a) / (q - p)
        zero, ratio = p - a / gain, abs(gain) / own.scale
        low, high = self._controller.settings.depths(self._controller.parameters)
        for name, error, most, valid in (
            ('sign', -own.sign * gain, 0.0, f'{-own.sign:g}'),
            ('scale', abs(ratio - 1.0) * (high - low), tolerance, f'{abs(gain):.6g}'),
            ('zero', abs(gain * (own.zero - zero)), tolerance, f'{zero:.6g}'),
            # In meters of the robot.
            ('lead', ratio * own.lead, limits.tracking_error, f'<= {limits.tracking_error:g}'),
            ('speed', ratio * own.speed, limits.speed, f'<= {limits.speed:g}'),
        ):
            if error > most:
                raise ParameterError(
                    f'hardware.{name} must be {valid} with the depths {a:.6g} and {b:.6g} m at '
                    f'{p:.6g} and {q:.6g} (hardware.commissioning), got {getattr(own, name):g}'
                )

    def _restart(self, phase: CommissioningPhase, result: str = '') -> None:
        """Discard all measurements."""
        own = self._controller.settings
        self._steps: _Steps | None = None
        #: Time, depth, velocity and force at rest, and changes since.
        self._rest: deque[tuple[float, ...]] = deque(maxlen=_AT_REST)
        self._rows = [np.zeros(6)]
        self._rate = RateMonitor(own.rate, own.measurement_timeout)
        self._robot.probe = nan
        self.phase, self.result = phase, result

    def command(self, measured: Measurement, moves: bool) -> ControllerOutput | None:
        """Answer a measurement; `moves` is a requested motion. Return None when it is passed."""
        if self.phase in (CommissioningPhase.SKIPPED, CommissioningPhase.PASSED):
            return None
        longest = self._controller.settings.measurement_timeout + self._controller.period
        elapsed, self._time = measured.time - self._time, measured.time
        if not 0.0 < elapsed <= longest or (self._steps is not None and not moves):
            self._restart(CommissioningPhase.WAITING)
        force = 0.0
        try:
            if self._steps is not None:
                force = self._steps.send(measured)
            else:
                self._depth = measured.depth
                self._rest.append(self._row(measured))
                if 0.0 < elapsed <= longest:
                    self._rate.add(round(NANOSECONDS * self._time), round(NANOSECONDS * elapsed))
                if moves and len(self._rest) == _AT_REST:
                    self._steps = self._first_motion()
                    next(self._steps)
                    self.phase = CommissioningPhase.MOVING
        except StopIteration:
            self._robot.probe = None
            return None
        except JobError as error:
            self._restart(CommissioningPhase.REFUSED, str(error))
        refusal = f'first motion refused: {self.result}' if self.result else None
        return ControllerOutput(force=force, setpoint=Setpoint(self._depth), refusal=refusal)

    def _row(self, measured: Measurement) -> tuple[float, ...]:
        return measured.time, measured.depth, measured.velocity, *self._robot.felt

    def _add(self, measured: Measurement) -> None:
        """Add a measurement; the joint must not move against or beyond the command."""
        self._rows.append(self._row(measured) - self._zero)
        most = self._settings.distance
        beyond = abs(self._rows[-1][1] + 0.5 * most) - (0.5 + _TOLERANCE) * most
        self._responds(beyond <= self._noise[1], f'at most {-1e3 * most:.3g} mm')

    def _responds(self, condition: object, command: str) -> None:
        _require(
            condition,
            f'the joint {self._robot.settings.joint!r} moved {1e3 * self._rows[-1][1]:+.3g} mm on '
            f'a command of {command}: hardware.joint, sign, scale, command, command_topic or '
            'command_joints, delay, or the driver',
        )

    def _check_at_rest(self) -> None:
        """Check that the facts are stated, and depth, rate and noise at rest."""
        settings, depth, noise = self._settings, self._zero[1], self._noise[1]
        _require(
            settings.positions and settings.start_depth > _UNSTATED,
            'hardware.commissioning.positions, depths and start_depth are not stated: measure the '
            'robot once (hardware.commissioning.enabled false skips this check)',
        )
        _require(
            abs(depth - settings.start_depth) <= settings.tolerance,
            f'the insertion depth is {depth:.6g} m, measured {settings.start_depth:g} m '
            '(hardware.commissioning.start_depth): hardware.joint or hardware.zero',
        )
        line = self._rate.warning() if self._robot.settings.stamps == STAMPS[0] else None
        _require(line is None, str(line))
        _require(
            noise <= settings.distance,
            f'the insertion depth at rest varies by {noise:.3g} m, more than '
            f'hardware.commissioning.distance {settings.distance:g} m',
        )

    def _first_motion(self) -> _Steps:
        """Move, and check velocity and force of the motion."""
        robot = self._robot
        self._zero = np.array([self._time, *np.mean(self._rest, axis=0)[1:]])
        self._noise = _SIGMAS * np.std(self._rest, axis=0)
        self._check_at_rest()
        lag = yield from (
            self._by_position() if robot.settings.command == POSITION else self._by_force()
        )
        rows = np.array(self._rows)
        moved, by_velocity = rows[-1, 1], np.diff(rows[:, 0]) @ rows[1:, 2]
        _require(
            robot.estimates or abs(by_velocity - moved) <= 0.5 * abs(moved) + self._noise[1],
            f'the position moved {1e3 * moved:.3g} mm, and {1e3 * by_velocity:.3g} mm by its '
            'velocity: unit of the velocity, or hardware.stamps',
        )
        # Largest change of the force, and its axis.
        change = max(rows[:, 3:], key=np.linalg.norm)
        axis = int(np.argmax(np.abs(change)))
        pull, felt = change[axis], 'no force measured'
        if abs(pull) > max(self._noise[3 + axis], _FELT):
            index, sign = robot.settings.axes()[axis]
            wanted = ('-' if sign * pull > 0.0 else '') + AXES[index]
            if axis == 1:
                wanted += f', or hardware.reaction to {not robot.settings.reaction}'.lower()
            _require(
                axis == 1 and pull < 0.0,
                f'the force on the needle changed by {pull:+.2f} N along {AXES[axis]} of '
                f'needle_base, not -y: set hardware.force_axis to {wanted}',
            )
            felt = f'force {pull:+.2f} N'
        self.phase = CommissioningPhase.PASSED
        self.result = f'moved {1e3 * moved:+.2f} mm, {1e3 * lag:.0f} ms late, {felt}'

    def _by_position(self) -> Generator[float, Measurement, float]:
        """Command a ramp; return the delay of the robot [s]."""
        settings, behind = self._settings, list[float]()
        length, duration = settings.distance, settings.distance / settings.speed
        time = moved = command = 0.0
        while time < duration or moved - command > _TOLERANCE * length:
            self._responds(time < duration + _SETTLING, f'{1e3 * command:.3g} mm')
            self._robot.probe = float(self._zero[1]) + command
            self._add((yield 0.0))
            time, moved, *_ = self._rows[-1]
            command = -min(settings.speed * time, length)
            if 0.5 * duration < time < duration:
                behind.append(moved - command)
        lag = float(np.mean(behind)) / settings.speed
        _require(
            lag <= settings.lag + self._controller.period,
            f'the robot follows {lag:.3g} s late, hardware.commissioning.lag is {settings.lag:g} '
            's: lower this delay, or the gains of the law for it',
        )
        return lag

    def _by_force(self) -> Generator[float, Measurement, float]:
        """Pull with a growing force until the needle moves; return the delay of its end [s]."""
        settings, own = self._settings, self._controller
        axis = Axis.insertion(own.parameters)
        dry = axis.coulomb * axis.breakaway * max(axis.withdrawal, 1.0)
        friction = dry + settings.speed * (axis.viscous + axis.inertia / _DOUBLING)
        most = min(_STRONGER * friction, own.settings.force_limit)
        # A busy machine may be late.
        for _ in range(_TRIES):
            begin, origin, *_ = time, moved, velocity = self._rows[-1][:3]
            pull = grown = 0.0
            while origin - moved <= _TOLERANCE * settings.distance + self._noise[1]:
                self._responds(grown < 2.0, f'{-pull:.3g} N, or model.*')
                grown = _FIRST * 2.0 ** ((time - begin) / _DOUBLING)
                pull = most * min(grown, 1.0)
                self._add((yield -pull))
                time, moved, velocity = self._rows[-1][:3]
            _require(
                pull >= _WEAKER * friction,
                f'the needle moves at {pull:.3g} N, the nominal friction is {friction:.3g} N: '
                'unit of the driver, hardware.scale, hardware.command or model.*',
            )
            end, fastest = time, abs(velocity)
            while abs(velocity) > 0.5 * fastest and time < end + _SETTLING:
                self._add((yield 0.0))
                time, _, velocity = self._rows[-1][:3]
            # Time in which the velocity halves without force.
            half = axis.inertia * fastest / max(2.0 * dry + axis.viscous * fastest, 1e-9)
            delay = (time - end) / own.period - 1.0
            allowed = own.delay + 1.0 + 3.0 * half / own.period
            if delay <= allowed or fastest <= self._noise[2]:
                return float(time - end)
        raise JobError(
            f'the force acts {delay:.3g} periods late, delay is {own.delay}: set delay to '
            f'{delay:.0f}, or lower rate'
        )
