"""The controller as an object: reference, laws and limits, one command per measurement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Final, TypeAlias

from needle_controller.laws.axis import Axis, Law, SampledLoop, Setpoint
from needle_controller.laws.inverse_dynamics import InverseDynamics, InverseDynamicsGains
from needle_controller.laws.pid import Pid, PidGains
from needle_controller.reference.reference import Guide, ReferenceLimits
from needle_controller.stability import check_stability, Limit, MARGIN
from needle_dynamics import NeedleParameters
from needle_ros.errors import (
    ParameterError,
)
from needle_ros.settings import check_constants, constant

#: Control laws by name.
LAWS: Final = ('inverse_dynamics', 'pid')

#: What is driven.
AXES: Final = ('insertion', 'rotation')

Gains: TypeAlias = InverseDynamicsGains | PidGains


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerSettings:
    """What controller and reference need beside the gains."""

    rate: float = constant(1000.0, 'Hz', 'rate of joint_states', low=1.0, high=10_000.0)
    delay: float = constant(1.0, 'periods', 'whole periods from measurement to effect', high=20.0)
    force_limit: float = constant(15.0, 'N', 'largest insertion force', open_low=True)
    torque_limit: float = constant(0.01, 'N m', 'largest torque', open_low=True)
    measurement_timeout: float = constant(
        0.1, 's', 'age at which a measurement no longer counts', open_low=True
    )
    jump: float = constant(
        2e-3, 'm', 'move that the speed does not explain, which is a fault; after a move of that '
        'size during a fault the target no longer counts', open_low=True,
    )  # fmt: skip
    stability_margin: float = constant(
        MARGIN, '1', 'part by which every error has to shrink in a period', high=0.5
    )
    lowest_depth: float = constant(
        0.0, 'm', 'least inserted length to control; no less than minimum_depth'
    )
    highest_depth: float = constant(
        10.0, 'm', 'largest inserted length to control; no more than the needle', open_low=True
    )

    def __post_init__(self) -> None:
        check_constants(self)
        if self.delay != int(self.delay):
            raise ParameterError(f'delay must be a whole number of periods, got {self.delay!r}')

    def depths(self, parameters: NeedleParameters) -> tuple[float, float]:
        """
        Return the range of inserted lengths to control a needle in [m].

        Raises
        ------
        ParameterError
            If nothing is left of it.

        """
        low = max(self.lowest_depth, parameters.minimum_depth)
        high = min(self.highest_depth, parameters.length)
        if not low < high:
            raise ParameterError(
                f'lowest_depth and highest_depth must leave some of '
                f'[{parameters.minimum_depth:g}, {parameters.length:g}] m, got '
                f'{self.lowest_depth:g} and {self.highest_depth:g} m'
            )
        return low, high


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """
    What the encoders say, SI units.

    Attributes
    ----------
    time : float
        Time of the sample [s].
    depth, speed : float
        Inserted length [m] and insertion speed [m/s].
    angle, angular_speed : float
        Rotation of the base about x [rad], [rad/s].

    """

    time: float
    depth: float
    speed: float
    angle: float = 0.0
    angular_speed: float = 0.0

    def is_finite(self) -> bool:
        """Return whether every number is finite."""
        return all(map(isfinite, (self.depth, self.speed, self.angle, self.angular_speed)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """
    What the controller answers to a measurement.

    Attributes
    ----------
    force, torque : float
        f_y [N], positive into the tissue, and tau [N m].
    setpoint : Setpoint
        Reference of the inserted length at the time of the measurement.
    fault : str or None
        Why no force is commanded.
    notice : str or None
        What people should know.

    """

    force: float
    torque: float
    setpoint: Setpoint
    fault: str | None = None
    notice: str | None = None

    def is_finite(self) -> bool:
        """Return whether every force is finite."""
        return isfinite(self.force) and isfinite(self.torque)


class Controller:
    """
    Drives the needle to a target depth or along a path.

    Parameters
    ----------
    law : str
        Name of the law, one of `LAWS`.
    parameters : NeedleParameters
        Needle and tissue as the controller believes them to be.
    settings : ControllerSettings
        Rate, delay and limits.
    inverse_dynamics, pid : tuple of gains
        Gains of insertion and rotation for each law.
    reference : str
        Name of the reference, a key of `REFERENCES`.
    limits : ReferenceLimits
        Limits of the reference.

    Attributes
    ----------
    law : str
        Name of the law.
    guide : Guide
        What it aims at: paths, pauses.
    limits : dict of str to Limit
        What limits the stability of each axis.

    Raises
    ------
    ParameterError
        If a name is unknown or the gains cannot be stable at this rate and delay.

    """

    def __init__(
        self,
        law: str,
        parameters: NeedleParameters,
        settings: ControllerSettings,
        *,
        inverse_dynamics: tuple[InverseDynamicsGains, ...],
        pid: tuple[PidGains, ...],
        reference: str,
        limits: ReferenceLimits,
    ) -> None:
        self._settings = settings
        self._period = 1.0 / settings.rate
        self._delay = int(settings.delay)
        self._depths = settings.depths(parameters)
        self.guide = Guide(reference, limits, self._depths)
        self.law = ''
        self.limits: dict[str, Limit] = {}
        self._gains: dict[str, tuple[Gains, ...]] = {}
        self._parameters = parameters
        gains: dict[str, tuple[Gains, ...]] = {'inverse_dynamics': inverse_dynamics, 'pid': pid}
        (insertion, rotation), self.limits = self._checked(law, parameters, gains)
        self.law, self._gains = law, gains
        self._insertion = SampledLoop(insertion, self._delay, settings.force_limit)
        self._rotation = SampledLoop(rotation, self._delay, settings.torque_limit)
        self.forget()

    def _checked(
        self, name: str, parameters: NeedleParameters, gains: Mapping[str, tuple[Gains, ...]]
    ) -> tuple[tuple[Law, Law], dict[str, Limit]]:
        """Return the laws and what limits them, or refuse gains that cannot be stable."""
        if name not in LAWS:
            raise ParameterError(f'unknown {name!r}; valid: {", ".join(LAWS)}')
        if len(gains[name]) != len(AXES):
            raise ParameterError(
                f'{name} needs gains of {", ".join(AXES)}, got {len(gains[name])}'
            )
        axes = Axis.insertion(parameters), Axis.rotation(parameters)
        insertion, rotation = (
            self._make(axis, chosen) for axis, chosen in zip(axes, gains[name], strict=True)
        )
        margin = self._settings.stability_margin
        limits = {
            axis: check_stability(law, self._delay, f'{name}.{axis} gains', margin=margin)
            for axis, law in zip(AXES, (insertion, rotation), strict=True)
        }
        return (insertion, rotation), limits

    def _make(self, axis: Axis, gains: Gains) -> Law:
        if isinstance(gains, PidGains):
            return Pid(axis=axis, gains=gains, period=self._period)
        return InverseDynamics(axis=axis, gains=gains, period=self._period)

    def change(
        self,
        parameters: NeedleParameters | None = None,
        *,
        law: str | None = None,
        inverse_dynamics: tuple[InverseDynamicsGains, ...] | None = None,
        pid: tuple[PidGains, ...] | None = None,
    ) -> None:
        """
        Go on with other constants, gains or another law; target, reference and memory stay.

        With other gains or another law the first forces in a motion are the last ones again.

        Parameters
        ----------
        parameters : NeedleParameters, optional
            Needle and tissue.
        law : str, optional
            Name of the law.
        inverse_dynamics, pid : tuple of gains, optional
            Gains.

        Raises
        ------
        ParameterError
            If the gains cannot be stable with them; the old ones then stay.

        """
        parameters = parameters or self._parameters
        name = law or self.law
        gains: dict[str, tuple[Gains, ...]] = {
            'inverse_dynamics': inverse_dynamics or self._gains['inverse_dynamics'],
            'pid': pid or self._gains['pid'],
        }
        (insertion, rotation), self.limits = self._checked(name, parameters, gains)
        steady = (name, gains[name]) == (self.law, self._gains[self.law])
        self._parameters, self.law, self._gains = parameters, name, gains
        if steady or not self.guide.moves:
            self._insertion.law, self._rotation.law = insertion, rotation
        else:
            self._insertion.switch(insertion)
            self._rotation.switch(rotation)

    @property
    def target(self) -> float | None:
        """Inserted length to reach [m], None before the first target."""
        return self.guide.target

    def set_target(self, depth: float) -> None:
        """
        Aim at an inserted length, from wherever the reference is now.

        Parameters
        ----------
        depth : float
            Inserted length [m].

        Raises
        ------
        ParameterError
            If it is not finite or the needle cannot be there.

        """
        self.guide.aim(depth)

    def follow(
        self,
        times: Sequence[float],
        positions: Sequence[float],
        speeds: Sequence[float] | None = None,
    ) -> None:
        """
        Follow a path of inserted lengths from now on; see `Path` and `Joined`.

        Parameters
        ----------
        times, positions, speeds : sequence of float
            Times from now [s], inserted lengths [m] and insertion speeds [m/s].

        Raises
        ------
        ParameterError
            If it is not a valid path.

        """
        self.guide.follow(times, positions, speeds)

    def forget(self) -> None:
        """Let go and forget the target too, and all that is remembered."""
        self.guide.forget()
        for loop in (self._insertion, self._rotation):
            loop.reset()
        self._seen: Measurement | None = None
        self._last_depth: float | None = None
        self._stopped = False

    def release(self) -> None:
        """
        Let go: forget the motion; the next measurement starts anew from where the needle is.

        Integrals stay as they are while nothing is commanded.
        """
        self.guide.release()
        for loop in (self._insertion, self._rotation):
            loop.stop()
        self._stopped = True

    def _gap(self, before: Measurement | None, measured: Measurement) -> float:
        """Return the time between measurements [s] if it is too long, or negative; else zero."""
        elapsed = measured.time - before.time if before is not None else 0.0
        most = self._settings.measurement_timeout + self._period
        return 0.0 if 0.0 <= elapsed <= most else elapsed

    def _fault(self, measured: Measurement) -> str | None:
        """Return why a measurement cannot be answered."""
        if not measured.is_finite():
            return f'joint_states must be finite, got {measured}'
        before, self._seen = self._seen, measured
        if before is not None and not self._gap(before, measured):
            elapsed = measured.time - before.time
            moved = measured.depth - before.depth
            explained = 0.5 * (before.speed + measured.speed) * elapsed
            if not abs(moved - explained) <= self._settings.jump:
                return (
                    f'insertion moved by {moved:.6g} m in {elapsed:.6g} s at speeds of '
                    f'{before.speed:.6g} and {measured.speed:.6g} m/s'
                )
        return None

    def command(self, measured: Measurement, load: float = 0.0) -> Command:
        """
        Return the command that answers a measurement.

        Parameters
        ----------
        measured : Measurement
            Encoders.
        load : float
            Force of the bent needle against insertion [N], if it is known.

        Returns
        -------
        Command
            Zero force while there is no target, or with the fault that a measurement has: it is
            not finite, has moved by more than its speed explains, or is out of range. After a
            gap, or a step back in time, the motion starts anew from where the needle is.

        """
        gap = self._gap(self._seen, measured)
        notice = None
        if gap:
            if self.guide.moves:
                notice = f'measurements went on after {gap:.3f} s; the motion starts anew'
            self.release()
        fault = self._fault(measured)
        if fault is not None:
            self.release()
        else:
            last, self._last_depth = self._last_depth, measured.depth
            moved = abs(measured.depth - last) if last is not None else 0.0
            if self._stopped and moved > self._settings.jump and self.guide.aims:
                seen = self._seen
                self.forget()
                self._seen, self._last_depth = seen, measured.depth
                notice = (
                    f'the needle is {moved:.6f} m from where it was before the fault; the target '
                    'is forgotten'
                )
            self._stopped = False
        if fault is not None or not self.guide.aims:
            here = Setpoint(measured.depth)
            return Command(force=0.0, torque=0.0, setpoint=here, fault=fault, notice=notice)
        now = self.guide.at(measured.time, measured.depth)
        later = measured.time + self._delay * self._period
        ahead = self.guide.ahead(later)
        return Command(
            force=self._insertion.command(measured.depth, measured.speed, ahead, load),
            torque=self._rotation.command(measured.angle, measured.angular_speed, Setpoint(0.0)),
            setpoint=now,
            notice=notice,
        )
