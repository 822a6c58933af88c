"""Common interface of all simulated plants."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, TypeAlias

from needle_dynamics.arrays import FloatArray
from needle_dynamics.parameters import NeedleParameters
from needle_ros.contract import Topic
from needle_ros.status import PlantStatus
import numpy as np

#: Measurement for one topic: topic name, sample intervals since the time of the stamp, and values
#: in the order of the message.
Measurement: TypeAlias = tuple[str, int, list[float]]


class MeasuredShape(NamedTuple):
    """
    Needle shape for display, in the frame of the entry point.

    Attributes
    ----------
    base : ndarray, shape (3,)
        Needle base [m].
    points : ndarray, shape (k, 3)
        Points from the start of the bending part to the tip [m].
    slopes : ndarray, shape (k, 2)
        Slopes in x and z at the points.
    path : ndarray, shape (m, 3)
        Path cut by the tip [m]; empty for a needle that does not cut.

    """

    base: FloatArray
    points: FloatArray
    slopes: FloatArray
    path: FloatArray

    @property
    def turns(self) -> FloatArray:
        """Shortest rotations from y to the needle axis, quaternions x, y, z, w; shape (k, 4)."""
        # From (0, 1, 0) to (slope_x, 1, slope_z): half the angle about their common normal.
        x, z = self.slopes.T
        length = np.sqrt(1.0 + x * x + z * z)
        cosine = np.sqrt(0.5 * (1.0 + 1.0 / length))
        share = 0.5 / (length * cosine)
        return np.column_stack([share * z, np.zeros_like(share), -share * x, cosine])

    @property
    def tip(self) -> tuple[list[float], list[float]]:
        """Tip position relative to the base [m] and orientation: x, y, z and x, y, z, w."""
        return (self.points[-1] - self.base).tolist(), self.turns[-1].tolist()


class SimulatedPlant(Protocol):
    """A plant that is advanced one sample at a time."""

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Published topics."""

    @property
    def depth(self) -> float:
        """Insertion depth [m]."""

    @property
    def report(self) -> PlantStatus:
        """Status with the state of the simulation only."""

    def follow(
        self,
        joints: Sequence[str],
        times: Sequence[float],
        positions: Sequence[Sequence[float]],
        efforts: Sequence[Sequence[float]],
    ) -> None:
        """Follow a trajectory from now on; units are s, m or rad, and N."""

    def tare(self) -> None:
        """Zero the force sensor, or raise JobError."""

    def change(self, parameters: NeedleParameters) -> None:
        """Change the constants of the needle."""

    def take(self, force: float, torque: float) -> list[Measurement]:
        """Advance by one interval under a force [N] and torque [N m]; `joint_states` is last."""

    def outline(self) -> MeasuredShape | None:
        """Return the needle shape for display; None without a needle."""
