# SPDX-License-Identifier: Apache-2.0
"""Simulated plant with a steered needle, needle guide and sensors."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

from needle_dynamics.simulated.base import BaseMotion, BaseParameters, on_grid, PUSHES
from needle_dynamics.simulated.commands import GUIDE_JOINTS
from needle_dynamics.simulated.force_sensor import ForceSensor
from needle_dynamics.simulated.plant import AT_REST, MeasuredShape, Measurement, NeedlePlant
from needle_dynamics.simulated.tip_sensor import TipSensor
from needle_dynamics.steering.insertion import Insertion
from needle_ros.contract import (
    BASE_WRENCH,
    INSERTION,
    ROLL,
    steered_states,
    steered_truth,
    STEERING_JOINTS,
    TIP_DEFLECTION,
)
from needle_ros.errors import ParameterError
from needle_ros.settings import CheckedSettings, positive
from needle_ros.status import PlantStatus
from needle_ros.trajectories import check_times, joint_values, JointReference, Points
import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class GuideParameters(CheckedSettings):
    """Limits of the robot that moves, tilts and rolls the needle guide."""

    position_limit: float = positive(
        0.02, 'm', 'largest position of the guide along x and z, either sign'
    )
    tilt_limit: float = positive(0.2, 'rad', 'largest tilt of the guide')
    roll_limit: float = positive(100.0, 'rad', 'largest roll of the needle')
    speed_limit: float = positive(0.02, 'm/s', 'highest speed of the guide')
    tilt_speed_limit: float = positive(0.2, 'rad/s', 'highest rate of the tilt')
    roll_speed_limit: float = positive(10.0, 'rad/s', 'highest rate of the roll')
    rise_time: float = positive(0.1, 's', 'time to accelerate to the highest speed')

    def motion(self, joint: str, gain: float) -> BaseMotion:
        """Return the motion controller of a guide joint, at rest at zero; ``gain`` is in 1/s."""
        unit = next(one.unit for one in STEERING_JOINTS if one.name == joint)
        if joint == ROLL:
            reach, speed = self.roll_limit, self.roll_speed_limit
        elif unit == 'rad':
            reach, speed = self.tilt_limit, self.tilt_speed_limit
        else:
            reach, speed = self.position_limit, self.speed_limit
        limits = BaseParameters(
            speed_limit=speed, acceleration_limit=speed / self.rise_time, position_gain=gain
        )
        return BaseMotion(limits, 0.0, (-reach, reach), joint=joint, unit=unit)


class SteeredPlant(NeedlePlant):
    """Steered needle with guide and sensors, under a commanded force or moved by a ``base``."""

    def __init__(
        self,
        insertion: Insertion,
        sensor: ForceSensor,
        tip: TipSensor,
        rate: float,
        guide: GuideParameters,
        robot: BaseParameters,
        base: BaseMotion | None = None,
    ) -> None:
        super().__init__(insertion, sensor, rate, base)
        self.insertion = insertion
        self.topics = (
            BASE_WRENCH, TIP_DEFLECTION, steered_truth(commanded=base is None), steered_states(),
        )  # fmt: skip
        self._tip_sensor = tip
        self._motions = {name: guide.motion(name, robot.position_gain) for name in GUIDE_JOINTS}
        #: Position and velocity of the joints other than `insertion`.
        self._at = dict.fromkeys(GUIDE_JOINTS, 0.0)
        self._velocity = dict.fromkeys(GUIDE_JOINTS, 0.0)
        #: Joints in motion.
        self._moving: set[str] = set()
        self._resolution = robot.encoder_resolution if base is not None else 0.0
        # Fraction of each sensor sample within each push interval, shape (pushes, samples).
        begins = np.arange(sensor.samples) * (PUSHES / sensor.samples)
        pushes, longest = np.arange(PUSHES)[:, np.newaxis], PUSHES / sensor.samples
        common = np.minimum(begins + longest, pushes + 1) - np.maximum(begins, pushes)
        self._shares = np.maximum(common, 0.0) / longest
        self._tip = [*insertion.needle.tip.tolist(), insertion.needle.tip_roll]
        #: Load of the guide on the needle, in the order of the guide joints.
        self._load = [0.0] * len(GUIDE_JOINTS)

    @property
    def report(self) -> PlantStatus:
        x, y, z, roll = self._tip
        return PlantStatus(insertion_depth=y, tip=(x, z), tip_roll=roll, joint=dict(self._at))

    def follow(
        self, joints: Sequence[str], times: Sequence[float], positions: Points, efforts: Points
    ) -> None:
        """Follow a trajectory of the given joints; `insertion` is ignored without a base."""
        known = (INSERTION, *GUIDE_JOINTS)
        if not joints or not set(joints) <= {*known} or len({*joints}) < len(joints):
            raise ParameterError(f'takes joints of {", ".join(known)}, got {list(joints)}')
        check_times(times)
        followed = {name: copy(self._motions[name]) for name in joints if name != INSERTION}
        for name, motion in followed.items():
            found = joint_values(name, joints, positions)
            if None in found:
                raise ParameterError(f'each point needs a position of {name}')
            motion.follow(self.time, self._at[name], times, found)
        if self.base is not None and INSERTION in joints:
            columns = (joint_values(INSERTION, joints, values) for values in (positions, efforts))
            self.base.follow(self.time, self.depth, times, *columns)
        self._motions |= followed
        self._moving |= {*followed}

    def references(self) -> dict[str, JointReference]:
        motions = self._motions if self.base is None else {INSERTION: self.base, **self._motions}
        return {name: motion.reference(self.time) for name, motion in motions.items()}

    def _motion(self) -> str:
        joints = ', '.join(sorted(self._moving))
        return super()._motion() or (joints and f'{joints} moves')

    def advance(self, force: float = 0.0) -> list[float]:
        """Advance by one interval, under a force [N] without a base; return the wrench."""
        across = self._move_guide() if self._moving else {}
        wrenches = self._wrenches
        if self.base is None:
            self.insertion.push(self.interval, force, **across)
            wrenches[:, 1] = force
        else:
            self._carry(self.base, across)
        self._count += 1
        x, z, about_x, about_y, about_z = self.insertion.wrench.tolist()
        wrenches[:, 0], wrenches[:, 2:] = x, (z, about_x, about_y, about_z)
        # A slope in z turns about x; a slope in x turns about z in the opposite direction.
        self._load = [x, z, -about_z, about_x, about_y]
        moving = bool(self._moving) or abs(self.insertion.velocity) > AT_REST
        return list(self._sensor.measure(wrenches, moving=moving).tolist())

    def _carry(self, base: BaseMotion, across: dict[str, Any]) -> None:
        """Move the needle along its axis with the base, or push it."""
        insertion, interval = self.insertion, self.interval
        part, limit = interval / PUSHES, base.limits.speed_limit
        forces: list[float] = []
        for push in base.pushes(self.time, interval, lambda: self.depth):
            moved = {} if forces else across
            forces.append(insertion.push(part, push, speed_limit=limit, **moved))
        if forces:
            shared = zip(self._shares, forces, strict=True)
            self._wrenches[:, 1] = sum(shares * force for shares, force in shared)
        else:
            velocity = base.velocity(self.time, self.depth, insertion.velocity, interval)
            means = np.empty(self._sensor.samples)
            insertion.carry(interval, velocity, forces=means, **across)
            self._wrenches[:, 1] = means

    def _move_guide(self) -> dict[str, Any]:
        """Advance guide, tilt and roll by one interval and return their positions."""
        at, velocities = self._at, self._velocity
        for name in sorted(self._moving):
            motion, before = self._motions[name], velocities[name]
            after = motion.velocity(self.time, at[name], before, self.interval)
            at[name] += 0.5 * (before + after) * self.interval
            velocities[name] = after
            if before == after == 0.0 and self.time >= motion.end:
                self._moving.discard(name)
        x, z, tilt_x, tilt_z, roll = at.values()
        return {'guide': (x, z), 'tilt': (tilt_x, tilt_z), 'roll': roll}

    def take(self, force: float, _torque: float) -> list[Measurement]:
        # The torque has no effect, because the guide holds the needle.
        wrench = self.advance(force)
        needle, before = self.insertion.needle, self._tip
        self._tip = tip = [*needle.tip.tolist(), needle.tip_roll]
        x, depth, z, _ = tip
        reading = self._tip_sensor.measure(depth, z, x)
        rates = [(b - a) / self.interval for a, b in zip(before, tip, strict=True)]
        velocity = self.insertion.velocity
        outside = needle.needle.length - depth
        truth = [outside, x, z, tip[3], -velocity, rates[0], rates[2], rates[3]]
        if self.base is None:
            # Insertion decreases d; the other coordinates have no command.
            truth += [-force, 0.0, 0.0, 0.0]
        joints = [
            on_grid(depth, self._resolution), *self._at.values(),
            velocity, *self._velocity.values(),
            float(self._wrenches[-1, 1]), *self._load,
        ]  # fmt: skip
        return self._measurements(wrench, reading, truth, joints)

    def outline(self) -> MeasuredShape:
        needle = self.insertion.needle
        shape, path = needle.shape, needle.path
        points = np.insert(shape.deflections, 1, shape.depths, axis=1)
        # Behind the guide the needle is straight, with the slope at the guide.
        rest = max(0.0, needle.needle.length - needle.depth - needle.steering.free_length)
        slope = np.array([shape.slopes[0, 0], 1.0, shape.slopes[0, 1]])
        return MeasuredShape(
            base=points[0] - rest * slope,
            points=points,
            slopes=shape.slopes,
            path=np.insert(path.deflections, 1, path.depths, axis=1),
        )
