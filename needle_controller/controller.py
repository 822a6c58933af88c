"""The controller as an object: reference, laws and limits, one command per measurement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite, sqrt
from typing import Final, TypeAlias

from needle_controller.laws.axis import Axis, Law, SampledLoop, Setpoint
from needle_controller.laws.continuous import ACTUATIONS
from needle_controller.laws.inverse_dynamics import InverseDynamics, InverseDynamicsGains
from needle_controller.laws.modal import DeflectionLaw, ModalLoop
from needle_controller.laws.pid import Pid, PidGains
from needle_controller.reference.reference import Guide, Quintic, ReferenceLimits
from needle_controller.stability import check_stability, Limit, MARGIN
from needle_dynamics import (
    FloatArray,
    NeedleModel,
    NeedleParameters,
)
from needle_ros.errors import (
    ParameterError,
)
from needle_ros.settings import check_constants, constant
import numpy as np

#: Control laws by name.
LAWS: Final = ('inverse_dynamics', 'pid')

#: What is driven: the base; with `modal` actuation the deflections too.
AXES: Final = ('insertion', 'rotation', 'deflection')

Gains: TypeAlias = InverseDynamicsGains | PidGains

#: Largest tip deflection that can be asked for [m].
_MOST_DEFLECTION: Final = 0.1


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
    modal : ndarray, shape (n,), or None
        Generalized forces on q1..qn [N m^-1/2]; None with `physical` actuation.
    fault : str or None
        Why no force is commanded.
    notice : str or None
        What people should know.

    """

    force: float
    torque: float
    setpoint: Setpoint
    modal: FloatArray | None = None
    fault: str | None = None
    notice: str | None = None

    def is_finite(self) -> bool:
        """Return whether every force is finite."""
        modal = self.modal is None or bool(np.isfinite(self.modal).all())
        return modal and isfinite(self.force) and isfinite(self.torque)


def _felt(axis: str, parameters: NeedleParameters) -> NeedleParameters:
    """Return the constants without those that do not matter to the poles of an axis."""
    if axis != 'deflection':
        return parameters
    return replace(parameters, carriage_mass=0.0, coulomb_friction=0.0, viscous_friction=0.0)


class Controller:
    """
    Drives the needle to a target depth or along a path.

    With `physical` actuation it commands the two forces that a robot has; with `modal` actuation
    a generalized force on every coordinate, and the deflections have targets too.

    Parameters
    ----------
    law : str
        Name of the law, one of `LAWS`.
    parameters : NeedleParameters
        Needle and tissue as the controller believes them to be.
    settings : ControllerSettings
        Rate, delay and limits.
    inverse_dynamics, pid : tuple of gains
        Gains of insertion and rotation for each law, and with `modal` actuation of deflection.
    reference : str
        Name of the reference, a key of `REFERENCES`.
    limits : ReferenceLimits
        Limits of the reference; with `modal` actuation those of the tip deflection too.
    actuation : str
        One of `ACTUATIONS`.

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
        actuation: str = 'physical',
    ) -> None:
        if actuation not in ACTUATIONS:
            raise ParameterError(f'unknown {actuation!r}; valid: {", ".join(ACTUATIONS)}')
        self._axes = AXES if actuation == 'modal' else AXES[:2]
        self._settings = settings
        self._period = 1.0 / settings.rate
        self._delay = int(settings.delay)
        self._depths = settings.depths(parameters)
        self.guide = Guide(reference, limits, self._depths)
        self.law = ''
        self.limits: dict[str, Limit] = {}
        self._gains: dict[str, tuple[Gains, ...]] = {}
        self._parameters = parameters
        self._laws: list[Law | DeflectionLaw] = []
        gains: dict[str, tuple[Gains, ...]] = {'inverse_dynamics': inverse_dynamics, 'pid': pid}
        self._laws, self.limits = self._checked(law, parameters, gains)
        self.law, self._gains = law, gains
        insertion, rotation, deflection = self._split()
        forces = {'force_limit': settings.force_limit, 'torque_limit': settings.torque_limit}
        self._modal: ModalLoop | None = None
        if deflection is not None:
            self._modal = ModalLoop(insertion, rotation, deflection, self._delay, **forces)
            self._insertion, self._rotation = self._modal.insertion, self._modal.rotation
        else:
            self._insertion = SampledLoop(insertion, self._delay, settings.force_limit)
            self._rotation = SampledLoop(rotation, self._delay, settings.torque_limit)
        self._deflection = 0.0
        self.forget()

    def _split(self) -> tuple[Law, Law, DeflectionLaw | None]:
        """Return the laws by their kind."""
        insertion, rotation, *others = self._laws
        if isinstance(insertion, DeflectionLaw) or isinstance(rotation, DeflectionLaw):
            raise TypeError(self._laws)
        deflection = others[0] if others else None
        return insertion, rotation, deflection if isinstance(deflection, DeflectionLaw) else None

    def _checked(
        self, name: str, parameters: NeedleParameters, gains: Mapping[str, tuple[Gains, ...]]
    ) -> tuple[list[Law | DeflectionLaw], dict[str, Limit]]:
        """Return the laws and what limits them, or refuse gains that cannot be stable."""
        if name not in LAWS:
            raise ParameterError(f'unknown {name!r}; valid: {", ".join(LAWS)}')
        if len(gains[name]) < len(self._axes):
            raise ParameterError(
                f'{name} needs gains of {", ".join(self._axes)}, got {len(gains[name])}'
            )
        laws: list[Law | DeflectionLaw] = []
        limits: dict[str, Limit] = {}
        for i, axis in enumerate(self._axes):
            chosen = gains[name][i]
            law = self._make(axis, parameters, chosen)
            laws.append(law)
            if self._laws and (name, chosen, _felt(axis, parameters)) == (
                self.law, self._gains[name][i], _felt(axis, self._parameters)
            ):  # fmt: skip
                # The search for what limits the deflections takes a while.
                limits[axis] = self.limits[axis]
                continue
            limits[axis] = check_stability(
                law,
                self._delay,
                f'{name}.{axis} gains',
                margin=self._settings.stability_margin,
                depths=self._depths if isinstance(law, DeflectionLaw) else None,
            )
        return laws, limits

    def _make(self, name: str, parameters: NeedleParameters, gains: Gains) -> Law | DeflectionLaw:
        if name == 'deflection':
            return DeflectionLaw(model=NeedleModel(parameters), gains=gains, period=self._period)
        axis = getattr(Axis, name)(parameters)
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
        laws, limits = self._checked(name, parameters, gains)
        steady = (name, gains[name]) == (self.law, self._gains[self.law])
        self._laws, self.limits = laws, limits
        self._parameters, self.law, self._gains = parameters, name, gains
        insertion, rotation, deflection = self._split()
        if steady or not self.guide.moves:
            self._insertion.law, self._rotation.law = insertion, rotation
            if self._modal is not None and deflection is not None:
                self._modal.deflection.law = deflection
        elif self._modal is not None and deflection is not None:
            self._modal.switch(insertion, rotation, deflection)
        else:
            self._insertion.switch(insertion)
            self._rotation.switch(rotation)

    @property
    def target(self) -> float | None:
        """Inserted length to reach [m], None before the first target."""
        return self.guide.target

    def set_target(self, depth: float, deflection: float = 0.0) -> None:
        """
        Aim at an inserted length, from wherever the reference is now.

        Parameters
        ----------
        depth : float
            Inserted length [m].
        deflection : float
            Deflection of the tip there [m]; counts with `modal` actuation only.

        Raises
        ------
        ParameterError
            If it is not finite or the needle cannot be there.

        """
        # Written so that NaN is refused too.
        if not abs(deflection) <= _MOST_DEFLECTION:
            raise ParameterError(
                f'target deflection must be within {_MOST_DEFLECTION:g} m, got {deflection!r}'
            )
        self.guide.aim(depth)
        self._deflection = deflection
        self._bending_due = True

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
        for loop in (self._insertion, self._rotation, self._modal):
            if loop is not None:
                loop.reset()
        self._seen: Measurement | None = None
        self._last_depth: float | None = None
        self._stopped = False
        self._bending: list[Quintic] | None = None
        self._bending_start, self._bending_due = 0.0, True

    def release(self) -> None:
        """
        Let go: forget the motion; the next measurement starts anew from where the needle is.

        Integrals stay as they are while nothing is commanded.
        """
        self.guide.release()
        for loop in (self._insertion, self._rotation, self._modal):
            if loop is not None:
                loop.stop()
        self._stopped = True
        self._bending, self._bending_due = None, True

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
        low, high = self._depths
        if self._modal is not None and not low <= measured.depth <= high:
            return (
                f'inserted length {measured.depth:.6g} m is outside [{low:g}, {high:g}] m, where '
                'the deflections are controlled'
            )
        return None

    def command(
        self,
        measured: Measurement,
        load: float = 0.0,
        bend: tuple[FloatArray, FloatArray] | None = None,
    ) -> Command:
        """
        Return the command that answers a measurement.

        Parameters
        ----------
        measured : Measurement
            Encoders.
        load : float
            Force of the bent needle against insertion [N], if it is known; with `modal`
            actuation it comes from the deflections.
        bend : tuple of ndarray, shape (n,) each, optional
            Deflections q1..qn and their rates; needed with `modal` actuation.

        Returns
        -------
        Command
            Zero force while there is no target, or with the fault that a measurement has: it is
            not finite, has moved by more than its speed explains, or is out of range. After a
            gap, or a step back in time, the motion starts anew from where the needle is.

        """
        at_rest = np.zeros(len(bend[0])) if self._modal is not None and bend else None
        gap = self._gap(self._seen, measured)
        notice = None
        if gap:
            if self.guide.moves:
                notice = f'measurements went on after {gap:.3f} s; the motion starts anew'
            self.release()
        fault = self._fault(measured)
        if fault is None and self._modal is not None and bend is None:
            fault = 'deflections are not known'
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
            return Command(
                force=0.0, torque=0.0, setpoint=here, modal=at_rest, fault=fault, notice=notice
            )
        now = self.guide.at(measured.time, measured.depth)
        later = measured.time + self._delay * self._period
        ahead = self.guide.ahead(later)
        if self._modal is not None and bend is not None:
            wanted = self._wanted(measured.time, later, bend[0])
            p = self._parameters
            state = np.concatenate(
                [
                    [p.length - measured.depth, measured.angle],
                    bend[0],
                    [-measured.speed, measured.angular_speed],
                    bend[1],
                ]
            )
            forces = self._modal.command(state, ahead, Setpoint(0.0), wanted)
            return Command(
                force=float(forces[0]),
                torque=float(forces[1]),
                setpoint=now,
                modal=forces[2:],
                notice=notice,
            )
        return Command(
            force=self._insertion.command(measured.depth, measured.speed, ahead, load),
            torque=self._rotation.command(measured.angle, measured.angular_speed, Setpoint(0.0)),
            setpoint=now,
            notice=notice,
        )

    def _wanted(self, time: float, later: float, now: FloatArray) -> FloatArray:
        """Return the deflections to have, with rates and accelerations, shape (3, n)."""
        if self._bending_due and self.guide.target is not None:
            self._bending_due = False
            model, limits = NeedleModel(self._parameters), self.guide.limits
            m, target = model.coordinates, self.guide.target
            goal = model.state_at(target, self._deflection)[2:m]
            starts = [Setpoint(float(q)) for q in now]
            if self._bending is not None:
                starts = [motion.at(time - self._bending_start) for motion in self._bending]
            straight = model.state_at(target)
            straight[2:m] = [start.position for start in starts]
            change = abs(self._deflection - model.tip_deflection(straight))
            # Rest to rest within the limits, and no earlier than the insertion.
            duration = max(
                self.guide.left(time),
                1.875 * change / limits.speed,
                sqrt(10.0 / sqrt(3.0) * change / limits.acceleration),
                100.0 * self._period,
            )
            self._bending_start = time
            self._bending = [
                Quintic(start, Setpoint(float(end)), duration)
                for start, end in zip(starts, goal, strict=True)
            ]
        points = [motion.at(later - self._bending_start) for motion in self._bending or ()]
        return np.array([[p.position, p.speed, p.acceleration] for p in points]).T.copy()
