"""What all simulated plants have: what they take, and what they show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, TypeAlias

from needle_dynamics.arrays import FloatArray
from needle_dynamics.parameters import NeedleParameters
from needle_ros.contract import Topic
import numpy as np

#: What a plant publishes of a sample on one topic: name of the topic, sample intervals since the
#: time of the stamp, and the numbers in the order of the message.
Measurement: TypeAlias = tuple[str, int, list[float]]


class Outline(NamedTuple):
    """
    A needle as people see it, in the frame of the entry point.

    Attributes
    ----------
    base : ndarray, shape (3,)
        Its base [m].
    points : ndarray, shape (k, 3)
        Points from where it bends to the tip [m].
    slopes : ndarray, shape (k, 2)
        Slopes in x and z there.
    path : ndarray, shape (m, 3)
        The path that it cut [m]; none for a needle that does not cut.

    """

    base: FloatArray
    points: FloatArray
    slopes: FloatArray
    path: FloatArray

    @property
    def turns(self) -> FloatArray:
        """Shortest turns that bring y along the needle, quaternions x, y, z, w; shape (k, 4)."""
        # From (0, 1, 0) to (slope_x, 1, slope_z): half the angle about their common normal.
        x, z = self.slopes.T
        length = np.sqrt(1.0 + x * x + z * z)
        cosine = np.sqrt(0.5 * (1.0 + 1.0 / length))
        share = 0.5 / (length * cosine)
        return np.column_stack([share * z, np.zeros_like(share), -share * x, cosine])

    @property
    def tip(self) -> tuple[list[float], list[float]]:
        """Where the tip is from the base [m], and how it is turned: x, y, z and x, y, z, w."""
        return (self.points[-1] - self.base).tolist(), self.turns[-1].tolist()


class SimulatedPlant(Protocol):
    """A plant that is advanced one sample at a time."""

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Topics that it publishes on."""

    @property
    def depth(self) -> float:
        """Inserted length [m]."""

    @property
    def report(self) -> dict[str, object]:
        """Where it is, for people."""

    def follow(
        self,
        joints: Sequence[str],
        times: Sequence[float],
        positions: Sequence[Sequence[float]],
        efforts: Sequence[Sequence[float]],
    ) -> None:
        """
        Follow a trajectory from now.

        Parameters
        ----------
        joints : sequence of str
            Names of the joints.
        times : sequence of float
            Time of each point from now [s].
        positions, efforts : sequence of sequence of float
            Of each point, by joint [m or rad, N].

        Raises
        ------
        ParameterError
            If it cannot.

        """

    def tare(self) -> None:
        """Zero the force sensor, or raise JobError."""

    def change(self, parameters: NeedleParameters) -> None:
        """
        Go on with other constants of the needle.

        Parameters
        ----------
        parameters : NeedleParameters
            Constants.

        Raises
        ------
        NeedleError
            If they do not suit its state.

        """

    def take(self, force: float, torque: float) -> list[Measurement]:
        """
        Advance by one sample interval.

        Parameters
        ----------
        force, torque : float
            What acts [N, N m].

        Returns
        -------
        list of Measurement
            What is published of it, `joint_states` last.

        Raises
        ------
        InsertedLengthError
            If the needle left the tissue.

        """

    def outline(self) -> Outline | None:
        """Return the needle as people see it; None if there is none."""
