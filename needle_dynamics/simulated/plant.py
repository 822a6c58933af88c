# SPDX-License-Identifier: Apache-2.0
"""Simulated plant: needle, base and force sensor, advanced one sample at a time."""

from collections.abc import Sequence
from statistics import fmean
from typing import Any, Final, NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.step import Interval
from needle_dynamics.friction import Friction
from needle_dynamics.simulated.base import BaseMotion, on_grid, PUSHES
from needle_dynamics.simulated.force_sensor import ForceSensor
from needle_dynamics.simulated.integrator import Integrator
from needle_dynamics.simulated.measured import AT_REST, MeasuredShape, Measurement, NeedlePlant
from needle_dynamics.simulated.tip_sensor import TipParameters, TipReading, TipSensor
from needle_ros.contract import BASE_WRENCH, ground_truth, INSERTION, JOINT_STATES, TIP_DEFLECTION
from needle_ros.errors import ParameterError
from needle_ros.status import PlantStatus
from needle_ros.trajectories import joint_values, JointReference, Points
import numpy as np

_POINTS: Final = 21  #: number of points of an outline


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
