# SPDX-License-Identifier: Apache-2.0
"""Common base of all simulated plants, and their measurements."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Final, NamedTuple, TypeAlias

from needle_dynamics.arrays import FloatArray
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.simulated.base import BaseMotion
from needle_dynamics.simulated.force_sensor import ForceSensor
from needle_dynamics.simulated.integrator import Integrator
from needle_dynamics.simulated.tip_sensor import TipReading
from needle_dynamics.steering.insertion import Insertion
from needle_ros.contract import BASE_WRENCH, GROUND_TRUTH, JOINT_STATES, TIP_DEFLECTION, Topic
from needle_ros.errors import JobError
from needle_ros.status import PlantStatus
from needle_ros.trajectories import JointReference, Points
import numpy as np
from scipy.spatial.transform import Rotation

AT_REST: Final = 1e-6  #: velocity below which taring is permitted [m/s]

#: Measurement for one topic: topic name, sample intervals since the time of the stamp, and values
#: in the order of the message.
Measurement: TypeAlias = tuple[str, int, list[float]]


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
