"""The controller as an object: reference, laws and limits, one command per measurement."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

from needle_controller.axis import Axis, Law, SampledLoop, Setpoint
from needle_controller.inverse_dynamics import InverseDynamics, InverseDynamicsGains
from needle_controller.pid import Pid, PidGains
from needle_controller.reference import Reference, ReferenceLimits, REFERENCES
from needle_controller.stability import check_stability
from needle_dynamics import NeedleParameters, ParameterError
from needle_dynamics.parameters import check_constants, constant

#: Control laws by name.
LAWS = ('inverse_dynamics', 'pid')


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
        2e-3, 'm', 'move during a fault after which the target no longer counts', open_low=True
    )

    def __post_init__(self) -> None:
        check_constants(self)
        if self.delay != int(self.delay):
            raise ParameterError(f'delay must be a whole number of periods, got {self.delay!r}')


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

    """

    force: float
    torque: float
    setpoint: Setpoint


class Controller:
    """
    Drives the needle to a target depth with the two forces a robot has (`physical` actuation).

    Parameters
    ----------
    law : str
        Name of the law, one of `LAWS`.
    parameters : NeedleParameters
        Needle and tissue as the controller believes them to be.
    settings : ControllerSettings
        Rate, delay and limits.
    inverse_dynamics, pid : tuple of gains
        Gains of insertion and of rotation for each law.
    reference : str
        Name of the reference, a key of `REFERENCES`.
    limits : ReferenceLimits
        Limits of the reference.

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
        inverse_dynamics: tuple[InverseDynamicsGains, InverseDynamicsGains],
        pid: tuple[PidGains, PidGains],
        reference: str,
        limits: ReferenceLimits,
    ) -> None:
        for name, valid in ((law, LAWS), (reference, tuple(REFERENCES))):
            if name not in valid:
                raise ParameterError(f'unknown {name!r}; valid: {", ".join(valid)}')
        self._name = law
        self._gains = pid if law == 'pid' else inverse_dynamics
        self._limits = limits
        self._reference_kind = REFERENCES[reference]
        self._period = 1.0 / settings.rate
        self._delay = int(settings.delay)
        insertion, rotation = self._laws(parameters)
        self._parameters = parameters
        self._insertion = SampledLoop(insertion, self._delay, settings.force_limit)
        self._rotation = SampledLoop(rotation, self._delay, settings.torque_limit)
        self._target: float | None = None
        self._reference: Reference | None = None
        self._reference_start = 0.0
        self._planned = False

    def _laws(self, parameters: NeedleParameters) -> tuple[Law, Law]:
        """Return the laws of insertion and rotation, or refuse gains that cannot be stable."""
        laws: list[Law] = []
        axes = Axis.insertion(parameters), Axis.rotation(parameters)
        for i, name in enumerate(('insertion', 'rotation')):
            axis, gains = axes[i], self._gains[i]
            if isinstance(gains, PidGains):
                laws.append(Pid(axis=axis, gains=gains, period=self._period))
            else:
                laws.append(InverseDynamics(axis=axis, gains=gains, period=self._period))
            check_stability(laws[-1], self._delay, f'{self._name}.{name} gains')
        return laws[0], laws[1]

    def change(self, parameters: NeedleParameters) -> None:
        """
        Believe other constants from now on; target, reference and memory stay.

        Parameters
        ----------
        parameters : NeedleParameters
            Needle and tissue.

        Raises
        ------
        ParameterError
            If the gains cannot be stable with them; the old ones then stay.

        """
        self._insertion.law, self._rotation.law = self._laws(parameters)
        self._parameters = parameters

    @property
    def target(self) -> float | None:
        """Inserted length to reach [m], None before the first target."""
        return self._target

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
        p = self._parameters
        if not p.minimum_depth <= depth <= p.length:
            raise ParameterError(
                f'target depth must be in [{p.minimum_depth:g}, {p.length:g}] m, got {depth!r}'
            )
        self._target = depth
        self._planned = False

    def forget(self) -> None:
        """Let go and forget the target too."""
        self.release()
        self._target = None

    def release(self) -> None:
        """Let go: forget the motion; the next measurement starts anew from where the needle is."""
        self._reference = None
        self._planned = False
        self._insertion.reset()
        self._rotation.reset()

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
            Zero force while there is no target or the measurement is not finite.

        """
        if not measured.is_finite():
            self.release()
        if self._target is None or not measured.is_finite():
            return Command(force=0.0, torque=0.0, setpoint=Setpoint(measured.depth))
        reference = self._reference
        if reference is None or not self._planned:
            start = Setpoint(measured.depth)
            if reference is not None:
                start = reference.at(measured.time - self._reference_start)
            reference = self._reference_kind(start, self._target, self._limits)
            self._reference, self._reference_start = reference, measured.time
            self._planned = True
        elapsed = measured.time - self._reference_start
        ahead = reference.at(elapsed + self._delay * self._period)
        return Command(
            force=self._insertion.command(measured.depth, measured.speed, ahead, load),
            torque=self._rotation.command(measured.angle, measured.angular_speed, Setpoint(0.0)),
            setpoint=reference.at(elapsed),
        )
