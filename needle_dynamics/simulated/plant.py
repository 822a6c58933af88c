"""Simulated plant: needle, base and force sensor, advanced one sample at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from statistics import fmean
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_dynamics.friction import Friction
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.simulated.base import BaseMotion, on_grid
from needle_dynamics.simulated.force_sensor import ForceSensor
from needle_dynamics.simulated.integrator import Integrator, Interval
from needle_dynamics.simulated.measured import MeasuredShape, Measurement
from needle_dynamics.simulated.tip_sensor import TipParameters, TipReading, TipSensor
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
from needle_ros.trajectories import joint_values
import numpy as np

#: Parts of a sample interval with constant push force: with friction the velocity follows the
#: force at once, and a present velocity with a mean force would be delayed by half an interval.
_PUSHES: Final = 4

#: Number of points of an outline.
_POINTS: Final = 21

#: Velocity below which taring is permitted [m/s].
AT_REST: Final = 1e-6


def _friction_gained(friction: Friction, before: float, after: float) -> float:
    """
    Return the difference of friction between the end and the middle of an interval [N].

    The velocity changes linearly. The mean friction over the interval would be delayed by half an
    interval with respect to the velocity at its end.
    """
    if after == 0.0:
        return 0.0
    return friction.force(after, 0.0) - friction.force(0.5 * (before + after), 0.0)


class PlantSample(NamedTuple):
    """
    Measurements at the end of one sample interval.

    Attributes
    ----------
    state : ndarray, shape (8,)
        Complete state.
    depth, velocity : float
        Insertion depth [m] and insertion velocity [m/s].
    joint_position : float
        Insertion depth measured by the encoder [m].
    force : float
        True axial force of the base on the needle [N], positive into the tissue.
    wrench : ndarray, shape (6,)
        Reading of the base sensor: force x y z [N], torque x y z [N m].
    tip_deflection : float
        Mean tip deflection over the interval [m].
    tip : TipReading or None
        Present output of the tip sensor.

    """

    state: FloatArray
    depth: float
    velocity: float
    joint_position: float
    force: float
    wrench: FloatArray
    tip_deflection: float
    tip: TipReading | None


class Plant:
    """
    The needle under a commanded wrench, or moved by a motion-controlled base.

    Parameters
    ----------
    integrator : Integrator
        Needle in its tissue.
    sensor : ForceSensor
        Sensor at the needle base.
    rate : float
        Samples per second [Hz].
    base : BaseMotion, optional
        Robot that moves the base; by default the commanded wrench acts.
    tip : TipSensor, optional
        Tip sensor; ideal by default.

    """

    def __init__(
        self,
        integrator: Integrator,
        sensor: ForceSensor,
        rate: float,
        base: BaseMotion | None = None,
        tip: TipSensor | None = None,
    ) -> None:
        self.integrator = integrator
        self.base = base
        self.interval = 1.0 / rate
        self.time = 0.0
        self._sensor = sensor
        self._tip = tip or TipSensor(TipParameters(noise=0.0), rate, 0)
        self._felt = np.zeros((sensor.samples, 6))
        self._count = 0
        modes = integrator.model.parameters.modes
        #: Generalized forces on q1..qn, which have no command.
        self._free = [0.0] * modes
        self.topics: tuple[Topic, ...] = (
            BASE_WRENCH, TIP_DEFLECTION, ground_truth(modes, commanded=base is None), JOINT_STATES,
        )  # fmt: skip

    @property
    def depth(self) -> float:
        """Insertion depth [m]."""
        return self.integrator.depth

    @property
    def report(self) -> PlantStatus:
        """Status with the state of the needle only."""
        return PlantStatus(insertion_depth=self.integrator.depth)

    def follow(
        self,
        joints: Sequence[str],
        times: Sequence[float],
        positions: Sequence[Sequence[float]],
        efforts: Sequence[Sequence[float]],
    ) -> None:
        """
        Follow a trajectory of the joint `insertion` with the base, from now on.

        Parameters
        ----------
        joints : sequence of str
            Names of the joints.
        times : sequence of float
            Time of each point from now [s].
        positions, efforts : sequence of sequence of float
            Insertion depth [m] of each point, or force [N] at the end of a push.

        Raises
        ------
        ParameterError
            If there is no base, or it cannot follow.

        """
        if self.base is None:
            raise ParameterError('is followed in the modes robot and indenter only')
        self.base.follow(
            self.time,
            self.integrator.depth,
            times,
            joint_values(INSERTION, joints, positions),
            joint_values(INSERTION, joints, efforts),
        )

    def tare(self) -> None:
        """
        Zero the sensor on the mean of its latest readings.

        Raises
        ------
        JobError
            If the needle moves, or has not rested long enough.

        """
        velocity = self.integrator.velocity
        if abs(velocity) > AT_REST:
            raise JobError(f'the needle moves at {1e3 * velocity:.3g} mm/s; it must rest')
        self._sensor.tare()

    def change(self, parameters: NeedleParameters) -> None:
        """
        Change the constants and continue from the present state.

        Parameters
        ----------
        parameters : NeedleParameters
            Constants.

        Raises
        ------
        ShapeError, InsertionDepthError
            If the state is invalid for the new constants; the old constants are kept.

        """
        self.integrator.change(parameters)

    def take(self, force: float, torque: float) -> list[Measurement]:
        """
        Advance by one sample interval and return the measurements to publish.

        Parameters
        ----------
        force, torque : float
            Force and torque that act on the needle [N, N m].

        Returns
        -------
        list of Measurement
            One per topic, `joint_states` last, so that a responding node has all of them.

        Raises
        ------
        InsertionDepthError
            If the needle left the tissue.

        """
        sample = self.advance(force, torque)
        measured: list[Measurement] = [(BASE_WRENCH.name, 0, sample.wrench.tolist())]
        tip = sample.tip
        if tip is not None:
            measured.append(
                (TIP_DEFLECTION.name, tip.age, [tip.across, tip.depth, tip.deflection])
            )
        state = sample.state.tolist()
        middle = len(state) // 2
        joints = [
            sample.joint_position, state[1], sample.velocity, state[middle + 1],
            sample.force, torque,
        ]  # fmt: skip
        if self.base is None:
            # Insertion decreases d.
            state += [-force, torque, *self._free]
        measured.append((GROUND_TRUTH.name, 0, state))
        measured.append((JOINT_STATES.name, 0, joints))
        return measured

    def outline(self) -> MeasuredShape:
        """
        Return the outline of the needle for display.

        Returns
        -------
        MeasuredShape
            From the base through the entry point to the tip.

        """
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
        """
        Advance by one sample interval.

        Parameters
        ----------
        force : float
            Commanded insertion force [N]; ignored when a base moves the needle.
        torque : float
            Commanded torque about x [N m]; likewise.

        Returns
        -------
        PlantSample
            Measurements at the end of the interval.

        Raises
        ------
        InsertionDepthError
            If the needle left the tissue.

        """
        needle, base, interval = self.integrator, self.base, self.interval
        resolution = late = 0.0
        if base is None:
            seen = needle.advance(interval, force, torque, parts=self._sensor.samples)
        else:
            resolution = base.limits.encoder_resolution
            push = base.push(self.time, needle.depth, interval / _PUSHES)
            if push is None:
                before = needle.velocity
                velocity = base.velocity(self.time, needle.depth, before, interval)
                seen = needle.advance_moved(interval, velocity)
                late = _friction_gained(needle.model.friction, before, needle.velocity)
            else:
                seen, late = self._pushed(base, push)
        self._count += 1
        self.time = self._count * interval
        axial = seen.axial_force + late
        start = None
        if base is None:
            wrench = self._felt
            wrench[:, 1:4] = seen.loads
        else:
            # Force and velocity that are recorded together must refer to one instant.
            wrench, start = np.zeros((2, 6))
            wrench[1:4] = start[1:4] = axial, seen.lateral_force, seen.moment
            start[1] -= 2.0 * late
        depth, velocity = needle.depth, needle.velocity
        return PlantSample(
            state=needle.state,
            depth=depth,
            velocity=velocity,
            joint_position=on_grid(depth, resolution),
            force=axial,
            wrench=self._sensor.measure(wrench, start=start, moving=abs(velocity) > AT_REST),
            tip_deflection=seen.tip_deflection,
            tip=self._tip.measure(depth, seen.tip_deflection),
        )

    def _pushed(self, base: BaseMotion, force: float) -> tuple[Interval, float]:
        """Push with a changing force; return mean values and the excess force at the end [N]."""
        needle, part = self.integrator, self.interval / _PUSHES
        limit = base.limits.speed_limit
        parts = [needle.advance_pushed(part, force, limit)]
        for k in range(1, _PUSHES):
            push = base.push(self.time + k * part, needle.depth, part)
            force = force if push is None else push
            parts.append(needle.advance_pushed(part, force, limit))
        rise = (parts[-1].axial_force - parts[0].axial_force) * _PUSHES / (_PUSHES - 1)
        means = replace(
            parts[-1],
            tip_deflection=fmean(one.tip_deflection for one in parts),
            axial_force=fmean(one.axial_force for one in parts),
            lateral_force=fmean(one.lateral_force for one in parts),
            moment=fmean(one.moment for one in parts),
        )
        return means, 0.5 * rise
