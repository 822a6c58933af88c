# SPDX-License-Identifier: Apache-2.0
"""Simulated plants: their common base, and needle, base and force sensor in steps of a sample."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from statistics import fmean
from typing import Any, Final, NamedTuple, TypeAlias

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.step import Interval
from needle_dynamics.friction import Friction
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.simulated.base import BaseMotion, on_grid, PUSHES
from needle_dynamics.simulated.force_sensor import ForceSensor
from needle_dynamics.simulated.integrator import Integrator
from needle_dynamics.simulated.tip_sensor import TipParameters, TipReading, TipSensor
from needle_dynamics.steering.insertion import Insertion
from needle_ros.contract import (
    BASE_WRENCH,
    GROUND_TRUTH,
    ground_truth,
    INSERTION,
    JOINT_STATES,
    TIP_DEFLECTION,
    Topic,
)
from needle_ros.errors import JobError, ParameterError
from needle_ros.status import PlantStatus
from needle_ros.trajectories import joint_values, JointReference, Points
import numpy as np
from scipy.spatial.transform import Rotation

AT_REST: Final = 1e-6  #: velocity below which taring is permitted [m/s]

#: Measurement for one topic: topic name, sample intervals since the time of the stamp, and values
#: in the order of the message.
Measurement: TypeAlias = tuple[str, int, list[float]]

_POINTS: Final = 21  #: number of points of an outline


class MeasuredShape(NamedTuple):
    """Needle shape for display, in the frame of the entry point."""

    base: FloatArray  #: needle base [m], shape (3,)
    points: FloatArray  #: points from the start of the bending part to the tip [m], shape (k, 3)
    slopes: FloatArray  #: slopes in x and z at the points, shape (k, 2)
    #: Path cut by the tip [m]; empty for a needle that does not cut, shape (m, 3).
    path: FloatArray

    @property
    def turns(self) -> FloatArray:
        """Shortest rotations from y to the needle axis, quaternions x, y, z, w; shape (k, 4)."""
        # From (0, 1, 0) to (slope_x, 1, slope_z): their cross product, and a scalar part.
        x, z = self.slopes.T
        scalar = 1.0 + np.sqrt(1.0 + x * x + z * z)
        turns = Rotation.from_quat(np.column_stack([z, np.zeros_like(z), -x, scalar]))
        return np.asarray(turns.as_quat())

    @property
    def tip(self) -> tuple[list[float], list[float]]:
        """Tip position relative to the base [m] and orientation: x, y, z and x, y, z, w."""
        return (self.points[-1] - self.base).tolist(), self.turns[-1].tolist()


class SimulatedPlant(ABC):
    """A plant that is advanced one sample at a time, with a force sensor; ``rate`` is in Hz."""

    topics: tuple[Topic, ...]  #: published topics

    def __init__(self, sensor: ForceSensor, rate: float) -> None:
        self.interval = 1.0 / rate
        self._sensor = sensor
        self._count = 0

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._count * self.interval

    @property
    @abstractmethod
    def depth(self) -> float:
        """Insertion depth [m]; 0 without a needle."""

    @property
    @abstractmethod
    def report(self) -> PlantStatus:
        """Status with the state of the simulation only."""

    @abstractmethod
    def follow(
        self, joints: Sequence[str], times: Sequence[float], positions: Points, efforts: Points
    ) -> None:
        """Follow a trajectory, linear between its points at times from now on [s]."""
        # Positions [m or rad], or forces at the end of a push [N], are by point and joint.
        # ParameterError if a joint is unknown or cannot follow; then no joint moves.

    @abstractmethod
    def references(self) -> dict[str, JointReference]:
        """Return the reference at the newest sample by joint; empty without trajectories."""

    def tare(self) -> None:
        """Zero the force sensor on the mean of its latest readings; JobError unless it rests."""
        motion = self._motion()
        if motion:
            raise JobError(f'{motion}; it must rest')
        self._sensor.tare()

    @abstractmethod
    def _motion(self) -> str:
        """Describe the motion that prevents a tare, '' at rest."""

    @abstractmethod
    def change(self, parameters: NeedleParameters) -> None:
        """Change the constants of the needle, if any; keep the old ones if they fit no longer."""

    @abstractmethod
    def take(self, force: float, torque: float) -> list[Measurement]:
        """Advance an interval under force [N] and torque [N m]; return a measurement per topic."""
        # `joint_states` is last, so that a responding node has all of them. InsertionDepthError if
        # the needle left the tissue.

    @abstractmethod
    def outline(self) -> MeasuredShape | None:
        """Return the needle shape for display; None without a needle."""


class NeedlePlant(SimulatedPlant):
    """A plant with a needle, under a commanded force or moved along its axis by a ``base``."""

    def __init__(
        self,
        needle: Integrator | Insertion,
        sensor: ForceSensor,
        rate: float,
        base: BaseMotion | None,
    ) -> None:
        super().__init__(sensor, rate)
        self._axis, self.base = needle, base
        self._wrenches = np.zeros((sensor.samples, 6))

    @property
    def depth(self) -> float:
        return self._axis.depth

    def change(self, parameters: NeedleParameters) -> None:
        self._axis.change(parameters)

    def _motion(self) -> str:
        velocity = self._axis.velocity
        return '' if abs(velocity) <= AT_REST else f'the needle moves at {1e3 * velocity:.3g} mm/s'

    @staticmethod
    def _measurements(
        wrench: list[float], tip: TipReading | None, truth: list[float], joints: list[float]
    ) -> list[Measurement]:
        """Return a measurement for each topic; ``tip`` is None without a reading."""
        reading = [] if tip is None else [(TIP_DEFLECTION.name, tip.age, tip.point)]
        return [
            (BASE_WRENCH.name, 0, wrench),
            *reading,
            (GROUND_TRUTH.name, 0, truth),
            (JOINT_STATES.name, 0, joints),
        ]


def _friction_gained(friction: Friction, before: float, after: float) -> float:
    """Return the friction at the end of an interval minus that in its middle [N]."""
    # The mean friction would be delayed by half an interval.
    if after == 0.0:
        return 0.0
    return friction.force(after, 0.0) - friction.force(0.5 * (before + after), 0.0)


class PlantSample(NamedTuple):
    """Measurements at the end of one sample interval."""

    state: FloatArray  #: complete state, shape (8,)
    #: Insertion depth [m] and insertion velocity [m/s].
    depth: float
    velocity: float
    joint_position: float  #: insertion depth measured by the encoder [m]
    force: float  #: true axial force of the base on the needle [N], positive into the tissue
    #: Reading of the base sensor: force x y z [N], torque x y z [N m], shape (6,).
    wrench: FloatArray
    tip_deflection: float  #: mean tip deflection over the interval [m]
    tip: TipReading | None  #: present output of the tip sensor


class Plant(NeedlePlant):
    """The needle under a commanded wrench, or moved by a base with the joint `insertion`."""

    def __init__(
        self,
        integrator: Integrator,
        sensor: ForceSensor,
        rate: float,
        base: BaseMotion | None = None,
        tip: TipSensor | None = None,
    ) -> None:
        super().__init__(integrator, sensor, rate, base)
        self.integrator = integrator
        # Without a sensor, the tip deflection is exact.
        self._tip = tip or TipSensor(TipParameters(noise=0.0), rate, 0)
        self._loads = np.empty((sensor.samples, 3))
        modes = integrator.model.parameters.modes
        #: Generalized forces on q1..qn, which have no command.
        self._free = [0.0] * modes
        self.topics = (
            BASE_WRENCH, TIP_DEFLECTION, ground_truth(modes, commanded=base is None), JOINT_STATES,
        )  # fmt: skip

    @property
    def report(self) -> PlantStatus:
        return PlantStatus(insertion_depth=self.depth)

    def follow(
        self, joints: Sequence[str], times: Sequence[float], positions: Points, efforts: Points
    ) -> None:
        if self.base is None:
            raise ParameterError('is followed in the modes robot and indenter only')
        columns = (joint_values(INSERTION, joints, values) for values in (positions, efforts))
        self.base.follow(self.time, self.depth, times, *columns)

    def references(self) -> dict[str, JointReference]:
        return {} if self.base is None else {INSERTION: self.base.reference(self.time)}

    def take(self, force: float, torque: float) -> list[Measurement]:
        sample = self.advance(force, torque)
        state = sample.state.tolist()
        middle = len(state) // 2
        joints = [
            sample.joint_position, state[1], sample.velocity, state[middle + 1],
            sample.force, torque,
        ]  # fmt: skip
        if self.base is None:
            # Insertion decreases d.
            state += [-force, torque, *self._free]
        return self._measurements(sample.wrench.tolist(), sample.tip, state, joints)

    def outline(self) -> MeasuredShape:
        model = self.integrator.model
        along = model.shape(self.integrator.state, _POINTS)
        slopes = np.zeros((_POINTS, 2))
        slopes[:, 1] = np.gradient(along[:, 1], along[:, 0])
        return MeasuredShape(
            base=np.array([0.0, self.depth - model.parameters.length, 0.0]),
            points=np.insert(along, 0, 0.0, axis=1),
            slopes=slopes,
            path=np.empty((0, 3)),
        )

    def advance(self, force: float = 0.0, torque: float = 0.0) -> PlantSample:
        """Advance by one interval; force [N] and torque [N m] are ignored with a base."""
        needle, base, interval = self.integrator, self.base, self.interval
        resolution = late = 0.0
        if base is None:
            means = needle.advance(interval, force, torque, self._loads)
        else:
            resolution = base.limits.encoder_resolution
            part, limit = interval / PUSHES, base.limits.speed_limit
            pushes = base.pushes(self.time, interval, lambda: needle.depth)
            pushed = [needle.advance_pushed(part, push, limit) for push in pushes]
            if pushed:
                means, late = _joined(pushed)
            else:
                before = needle.velocity
                velocity = base.velocity(self.time, needle.depth, before, interval)
                means = needle.advance_moved(interval, velocity)
                late = _friction_gained(needle.model.friction, before, needle.velocity)
        self._count += 1
        axial = means.axial_force + late
        start = None
        if base is None:
            wrench = self._wrenches
            wrench[:, 1:4] = self._loads
        else:
            # Force and velocity that are recorded together must refer to one instant.
            wrench, start = np.zeros((2, 6))
            wrench[1:4] = start[1:4] = axial, means.lateral_force, means.moment
            start[1] -= 2.0 * late
        state, deflection = needle.state, means.tip_deflection
        depth, velocity = needle.depth, needle.velocity
        reading = self._sensor.measure(wrench, start=start, moving=abs(velocity) > AT_REST)
        tip = self._tip.measure(depth, deflection)
        joint = on_grid(depth, resolution)
        return PlantSample(state, depth, velocity, joint, axial, reading, deflection, tip)


def _joined(parts: Sequence[Interval]) -> tuple[Interval, float]:
    """Return the mean values of pushes in sequence, and the excess force at their end [N]."""
    rise = (parts[-1].axial_force - parts[0].axial_force) * PUSHES / (PUSHES - 1)
    names = ('tip_deflection', 'axial_force', 'lateral_force', 'moment')
    means: dict[str, Any] = {name: fmean(getattr(part, name) for part in parts) for name in names}
    return parts[-1]._replace(**means), 0.5 * rise
