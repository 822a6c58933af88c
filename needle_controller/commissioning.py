# SPDX-License-Identifier: Apache-2.0
"""Commissioning: compare a robot and its first motion with its configuration."""

from collections import deque
from collections.abc import Generator
from dataclasses import dataclass
from math import isnan, nan

from needle_controller.controller import Controller, ControllerOutput, Measurement
from needle_controller.hardware import POSITION, Robot
from needle_controller.laws.law import Axis
from needle_controller.reference.setpoint import Setpoint
from needle_controller.safety.input_monitor import MEMORY
from needle_controller.safety.safety import SafetyLimits
from needle_controller.safety.timing_monitor import RateMonitor
from needle_dynamics import FloatArray
from needle_ros.errors import JobError, ParameterError
from needle_ros.quantities import AXES
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
#: Standard errors of a mean force, or of an integrated velocity, that are no noise.
_CERTAIN = 5.0
#: Time in which a robot rests at the end of its first motion [s].
_REST = 0.2
#: Least and largest tolerated contradiction of a velocity, as a fraction of the displacement.
_EXACT, _COARSE = 0.1, 0.5


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
    speed: float = constant(1e-3, 'm/s', 'its largest speed', low=1e-4, high=5e-3)
    #: A robot that has not moved 1 s after its command is blocked, see `ResponseMonitor`.
    lag: float = constant(0.08, 's', 'largest delay of a robot that follows positions', high=0.8)

    def __post_init__(self) -> None:
        check_constants(self)
        counts = {len(self.positions), len(self.depths)}
        apart = counts == {2} and len({*self.positions}) == 2 and np.ptp(self.depths) >= _APART
        if counts != {0} and not apart:
            raise ParameterError(
                f'positions and depths must be two each, {_APART:g} m apart or more, got '
                f'{[*self.positions]} and {[*self.depths]}'
            )


@dataclass
class Commissioning:
    """
    Compare the configuration with measured depths, and the first motion with the configuration.

    The first motion is small, slow, and out of the tissue. Before, no force acts and no position
    is commanded.
    """

    settings: CommissioningSettings
    robot: Robot
    controller: Controller
    limits: SafetyLimits
    phase: CommissioningPhase = CommissioningPhase.SKIPPED
    result: str = ''

    def __post_init__(self) -> None:
        self._time = self._depth = self._settled = nan
        self._pulled = 0.0, 0.0  #: Times between which the motion needs a force [s].
        self._steps: Generator[float, Measurement, None] | None = None
        if self.settings.enabled:
            self._check_configuration()
            self._restart(CommissioningPhase.WAITING)

    def _check_configuration(self) -> None:
        """Reject a sign, scale, zero, lead or speed that contradicts the measured depths."""
        own, limits, tolerance = self.robot.settings, self.limits, self.settings.tolerance
        if not self.settings.positions:
            return
        (p, q), (a, b) = self.settings.positions, self.settings.depths
        gain = (b - a) / (q - p)
        zero, ratio = p - a / gain, abs(gain) / own.scale
        low, high = self.controller.settings.depths(self.controller.parameters)
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
        own = self.controller.settings
        # An interrupted motion settles before the next measurement at rest.
        if self._steps is not None:
            self._steps, self._settled = None, self._time + _SETTLING
        #: Time, depth, velocity and force at rest, and changes since.
        self._rest: deque[tuple[float, ...]] = deque(maxlen=_AT_REST)
        self._rows = [np.zeros(6)]
        self._rate = RateMonitor(own.rate, own.measurement_timeout)
        self._felt = self._feels()
        self.robot.probe, self.phase, self.result = nan, phase, result

    def command(self, measured: Measurement, moves: bool) -> ControllerOutput | None:
        """Answer a measurement; `moves` is a requested motion. Return None when it is passed."""
        if self.phase in (CommissioningPhase.SKIPPED, CommissioningPhase.PASSED):
            return None
        longest = self.controller.settings.longest_gap
        elapsed, self._time = measured.time - self._time, measured.time
        interrupted = self._steps is not None and not moves
        # The first force begins a new measurement at rest.
        if not 0.0 < elapsed <= longest or interrupted or self._felt != self._feels():
            self._restart(CommissioningPhase.WAITING)
        force = 0.0
        try:
            if self._steps is not None:
                force = self._steps.send(measured)
            else:
                self._depth = measured.depth
                if not 0.0 < self._settled - self._time <= _SETTLING:
                    self._rest.append(self._row(measured))
                if 0.0 < elapsed <= longest:
                    self._rate.add(round(NANOSECONDS * self._time), round(NANOSECONDS * elapsed))
                if moves and len(self._rest) == _AT_REST:
                    self._steps = self._first_motion()
                    next(self._steps)
                    self.phase = CommissioningPhase.MOVING
        except StopIteration:
            self.robot.probe = None
            return None
        except JobError as error:
            self._restart(CommissioningPhase.REFUSED, str(error))
        refusal = f'first motion refused: {self.result}' if self.result else None
        return ControllerOutput(force=force, setpoint=Setpoint(self._depth), refusal=refusal)

    def _row(self, measured: Measurement) -> tuple[float, ...]:
        force = np.nan_to_num(self.robot.reaction)
        return measured.time, measured.depth, measured.velocity, *force

    def _feels(self) -> bool:
        return not isnan(self.robot.reaction[1])

    def _add(self, measured: Measurement) -> None:
        """Add a measurement; the joint must not move against or beyond the command."""
        self._rows.append(self._row(measured) - self._zero)
        most = self.settings.distance
        beyond = abs(self._rows[-1][1] + 0.5 * most) - (0.5 + _TOLERANCE) * most
        self._require_response(beyond <= self._noise[1], f'at most {-1e3 * most:.3g} mm')

    def _require_response(self, condition: bool, command: str) -> None:
        most = self.settings.distance
        if not condition:
            raise JobError(
                f'the joint {self.robot.settings.joint!r} moved '
                f'{round(1e3 * self._rows[-1][1], 6) + 0.0:+.3g} mm on a command of {command}: '
                'hardware.joint, sign, scale, command, command_topic or command_joints, delay, '
                f'the driver, or an encoder with steps above {1e3 * _TOLERANCE * most:.3g} mm, a '
                'fifth of hardware.commissioning.distance'
            )

    def _check_at_rest(self) -> None:
        """Check that the facts are stated, and depth, rate and noise at rest."""
        settings, depth, noise = self.settings, self._zero[1], self._noise[1]
        if not settings.positions or settings.start_depth == _UNSTATED:
            raise JobError(
                'hardware.commissioning.positions, depths and start_depth are not stated: measure '
                'the robot once (hardware.commissioning.enabled false skips this check)'
            )
        if abs(depth - settings.start_depth) > settings.tolerance:
            raise JobError(
                f'the insertion depth is {depth:.6g} m, measured {settings.start_depth:g} m '
                '(hardware.commissioning.start_depth): hardware.joint or hardware.zero'
            )
        if self.robot.settings.stamped and (line := self._rate.warning()):
            raise JobError(line)
        if noise > settings.distance:
            raise JobError(
                f'the insertion depth at rest varies by {noise:.3g} m, more than '
                f'hardware.commissioning.distance {settings.distance:g} m'
            )

    def _first_motion(self) -> Generator[float, Measurement, None]:
        """Receive measurements and yield forces; check velocity and force of the motion."""
        own = self.robot.settings
        self._zero = np.array([self._time, *np.mean(self._rest, axis=0)[1:]])
        self._noise = _SIGMAS * np.std(self._rest, axis=0)
        self._check_at_rest()
        lag = yield from self._by_position() if own.command == POSITION else self._by_force()
        rows = np.array(self._rows)
        self._check_velocity(rows)
        reaction = self._check_force(rows)
        self.phase = CommissioningPhase.PASSED
        self.result = f'moved {1e3 * rows[-1, 1]:+.2f} mm, {1e3 * lag:.0f} ms late, {reaction}'

    def _check_velocity(self, rows: FloatArray) -> None:
        """Compare the integral of the velocity with the displacement."""
        if self.robot.estimates:
            return
        own, steps = self.controller.settings, np.diff(rows[:, 0])
        moved, by_velocity = rows[-1, 1], steps @ rows[1:, 2]
        speed, allowed, remedy = self.controller.guide.limits.speed, _COARSE, ''
        if self.robot.settings.command == POSITION:
            # A longer motion with the speed of the reference would be interrupted.
            allowed = min(max(own.jump / (MEMORY * speed), _EXACT), _COARSE)
            remedy = '; leave the velocity out, it is then estimated'
            if abs(by_velocity - moved) < _COARSE * abs(moved):
                remedy += ', or lower reference.speed'
        changes = np.abs(np.diff(rows[:, 1]))
        resolution = np.min(changes[changes > 1e-9], initial=self.settings.distance)
        noise = _CERTAIN / _SIGMAS * self._noise[2] * np.linalg.norm(steps)
        tolerance = allowed * abs(moved) + self._noise[1] + resolution + noise
        if abs(by_velocity - moved) > tolerance:
            raise JobError(
                f'the position moved {1e3 * moved:.3g} mm, and {1e3 * by_velocity:.3g} mm by its '
                f'velocity: unit of the velocity, or hardware.stamps{remedy}'
            )

    def _check_force(self, rows: FloatArray) -> str:
        """Check the direction of the mean force in the motion; return it as text."""
        if not self._feels():
            return 'no force measured'
        own, (begin, end) = self.robot.settings, self._pulled
        rest, pull = np.array(self._rest)[:, 3:], rows[:, 3:]
        pull = pull[(begin < rows[:, 0]) & (rows[:, 0] <= end)]
        half = len(rest) // 2
        drift = np.abs(np.mean(rest[half:], axis=0) - np.mean(rest[:half], axis=0))
        error = np.sqrt(1.0 / _readings(rest) + 1.0 / _readings(pull)) * np.std(rest, axis=0)
        least = np.maximum(_CERTAIN * error + 2.0 * drift, _FELT)
        change = np.mean(pull, axis=0)
        axis = int(np.argmax(np.abs(change)))
        value = change[axis]
        if abs(value) <= least[axis]:
            return (
                f'no force above the noise of {least[axis]:.2g} N measured: hardware.force_axis '
                'and reaction are not checked'
            )
        if axis != 1 or value > 0.0:
            index, sign = own.axes()[axis]
            wanted = ('-' if sign * value > 0.0 else '') + AXES[index]
            other = f', or hardware.reaction to {not own.reaction}'.lower()
            raise JobError(
                f'the force on the needle changed by {value:+.2f} N along {AXES[axis]} of '
                f'needle_base, not -y: set hardware.force_axis to {wanted}'
                + (other if axis == 1 else '')
            )
        return f'force {value:+.2f} N'

    def _by_position(self) -> Generator[float, Measurement, float]:
        """Command a ramp; return the delay of the robot [s]."""
        settings, behind = self.settings, list[float]()
        length, period = settings.distance, self.controller.period
        # Long enough to measure the delay.
        duration = max(length / settings.speed, 4.0 * settings.lag + 8.0 * period)
        time = moved = command = 0.0
        self._pulled = 0.5 * duration, duration
        while time < duration + _REST or moved - command > _TOLERANCE * length:
            self._require_response(time < duration + _SETTLING, f'{1e3 * command:.3g} mm')
            self.robot.probe = float(self._zero[1]) + command
            self._add((yield 0.0))
            time, moved, *_ = self._rows[-1]
            command = -length * min(time / duration, 1.0)
            if 0.5 * duration < time < duration:
                behind.append(moved - command)
        lag = float(np.mean(behind)) * duration / length
        if lag > settings.lag + period:
            raise JobError(
                f'the robot follows {lag:.3g} s late, hardware.commissioning.lag is '
                f'{settings.lag:g} s: lower this delay, or allow it'
            )
        return lag

    def _by_force(self) -> Generator[float, Measurement, float]:
        """Pull with a growing force until the needle moves; return the delay of its end [s]."""
        settings, own = self.settings, self.controller
        axis = Axis.insertion(own.parameters)
        dry = axis.coulomb * axis.breakaway * max(axis.withdrawal, 1.0)
        friction = dry + settings.speed * (axis.viscous + axis.inertia / _DOUBLING)
        most = min(_STRONGER * friction, own.settings.force_limit)
        first = _FIRST
        # A busy machine may be late.
        for _ in range(_TRIES):
            begin, origin, *_ = time, moved, velocity = self._rows[-1][:3]
            pull = grown = 0.0
            while origin - moved <= _TOLERANCE * settings.distance + self._noise[1]:
                self._require_response(grown < 2.0, f'{-pull:.3g} N, or model.*')
                grown = first * 2.0 ** ((time - begin) / _DOUBLING)
                pull = most * min(grown, 1.0)
                self._add((yield -pull))
                time, moved, velocity = self._rows[-1][:3]
            if pull < _WEAKER * friction:
                raise JobError(
                    f'the needle moves at {pull:.3g} N, the nominal friction is {friction:.3g} N: '
                    'unit of the driver, hardware.scale, hardware.command or model.*, or the '
                    'needle is not in the tissue'
                )
            first, end, fastest = 0.1 * grown, time, abs(velocity)
            self._pulled = end - _DOUBLING, end
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


def _readings(values: FloatArray) -> int:
    """Return the number of different readings; a slow sensor repeats its readings."""
    return 1 + int(np.count_nonzero(np.any(np.diff(values, axis=0), axis=1)))
