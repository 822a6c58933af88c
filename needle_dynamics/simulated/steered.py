"""Simulated plant with a steered needle, needle guide and sensors."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, Final

from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.simulated.base import BaseMotion, BaseParameters, on_grid
from needle_dynamics.simulated.force_sensor import ForceSensor
from needle_dynamics.simulated.measured import MeasuredShape, Measurement
from needle_dynamics.simulated.plant import AT_REST
from needle_dynamics.simulated.tip_sensor import TipSensor
from needle_dynamics.steering.insertion import Insertion
from needle_ros.contract import (
    BASE_WRENCH,
    GROUND_TRUTH,
    INSERTION,
    JOINT_STATES,
    ROLL,
    steered_states,
    steered_truth,
    STEERING_JOINTS,
    TIP_DEFLECTION,
    Topic,
)
from needle_ros.errors import JobError, ParameterError
from needle_ros.settings import check_constants, constant
from needle_ros.status import PlantStatus
from needle_ros.trajectories import check_times, joint_values
import numpy as np

#: Parts of a sample interval with constant push force, as in `Plant`.
_PUSHES: Final = 4

#: Names of the joints other than `insertion`, in the order of the message.
_JOINTS: Final = tuple(joint.name for joint in STEERING_JOINTS)


@dataclass(frozen=True, slots=True, kw_only=True)
class GuideParameters:
    """Limits of the robot that moves, tilts and rolls the needle guide."""

    position_limit: float = constant(
        0.02, 'm', 'largest position of the guide along x and z, either sign', open_low=True
    )
    tilt_limit: float = constant(0.2, 'rad', 'largest tilt of the guide', open_low=True)
    roll_limit: float = constant(100.0, 'rad', 'largest roll of the needle', open_low=True)
    speed_limit: float = constant(0.02, 'm/s', 'highest speed of the guide', open_low=True)
    tilt_speed_limit: float = constant(0.2, 'rad/s', 'highest rate of the tilt', open_low=True)
    roll_speed_limit: float = constant(10.0, 'rad/s', 'highest rate of the roll', open_low=True)
    rise_time: float = constant(0.1, 's', 'time to accelerate to the highest speed', open_low=True)

    def __post_init__(self) -> None:
        check_constants(self)

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
        return BaseMotion(limits, 0.0, (-reach, reach), what=joint, unit=unit)


class SteeredPlant:
    """
    Steered needle under a commanded force or moved by a robot, with guide and sensors.

    Without a ``base`` (robot along the needle axis) the commanded force acts; ``rate`` is the
    sample rate [Hz].
    """

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
        self.insertion = insertion
        self.base = base
        self.interval = 1.0 / rate
        self.time = 0.0
        self.topics: tuple[Topic, ...] = (
            BASE_WRENCH, TIP_DEFLECTION, steered_truth(commanded=base is None), steered_states(),
        )  # fmt: skip
        self._sensor, self._tip_sensor = sensor, tip
        self._motions = {name: guide.motion(name, robot.position_gain) for name in _JOINTS}
        #: Position and velocity of the joints other than `insertion`.
        self._at = dict.fromkeys(_JOINTS, 0.0)
        self._velocity = dict.fromkeys(_JOINTS, 0.0)
        #: Joints in motion.
        self._moving: set[str] = set()
        self._resolution = robot.encoder_resolution if base is not None else 0.0
        self._felt = np.zeros((sensor.samples, 6))
        # Fraction of each sensor sample within each push interval, shape (pushes, samples).
        begins = np.arange(sensor.samples) * (_PUSHES / sensor.samples)
        pushes, longest = np.arange(_PUSHES)[:, np.newaxis], _PUSHES / sensor.samples
        common = np.minimum(begins + longest, pushes + 1) - np.maximum(begins, pushes)
        self._shares = np.maximum(common, 0.0) / longest
        self._tip = [*insertion.needle.tip.tolist(), insertion.needle.tip_roll]
        #: Load of the guide on the needle, in the order of the guide joints.
        self._load = [0.0] * len(_JOINTS)
        self._count = 0

    @property
    def depth(self) -> float:
        """Insertion depth [m]."""
        return self.insertion.depth

    @property
    def report(self) -> PlantStatus:
        """Status with the state of needle and guide only."""
        x, y, z, roll = self._tip
        return PlantStatus(insertion_depth=y, tip=(x, z), tip_roll=roll, joint=dict(self._at))

    def follow(
        self,
        joints: Sequence[str],
        times: Sequence[float],
        positions: Sequence[Sequence[float]],
        efforts: Sequence[Sequence[float]],
    ) -> None:
        """
        Follow a trajectory of guide, roll and base from now on; omitted joints continue.

        ``times`` are relative to now [s], ``positions`` in m or rad, ``efforts`` of `insertion` in
        N at the end of a push. Without a base, `insertion` is ignored: it is the reference of a
        controller. If a joint is unknown or cannot follow, ParameterError is raised and no joint
        moves.
        """
        known = (INSERTION, *_JOINTS)
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
            self.base.follow(
                self.time,
                self.depth,
                times,
                joint_values(INSERTION, joints, positions),
                joint_values(INSERTION, joints, efforts),
            )
        self._motions |= followed
        self._moving |= {*followed}

    def tare(self) -> None:
        """Zero the sensor on the mean of its latest readings; needle and guide must rest."""
        velocity = self.insertion.velocity
        if abs(velocity) > AT_REST:
            raise JobError(f'the needle moves at {1e3 * velocity:.3g} mm/s; it must rest')
        if self._moving:
            raise JobError(f'{", ".join(sorted(self._moving))} moves; it must rest')
        self._sensor.tare()

    def change(self, parameters: NeedleParameters) -> None:
        """Change the friction constants."""
        self.insertion.change(parameters)

    def advance(self, force: float = 0.0) -> list[float]:
        """
        Advance by one sample interval and return the wrench of the base sensor [N, N m], xyz each.

        The commanded insertion force [N] is ignored when a base moves the needle.
        """
        across = self._move_guide() if self._moving else {}
        felt = self._felt
        if self.base is None:
            self.insertion.push(self.interval, force, **across)
            felt[:, 1] = force
        else:
            self._carry(self.base, across)
        self._count += 1
        self.time = self._count * self.interval
        x, z, about_x, about_y, about_z = self.insertion.wrench.tolist()
        felt[:, 0], felt[:, 2:] = x, (z, about_x, about_y, about_z)
        # A slope in z turns about x; a slope in x turns about z in the opposite direction.
        self._load = [x, z, -about_z, about_x, about_y]
        moving = bool(self._moving) or abs(self.insertion.velocity) > AT_REST
        return list(self._sensor.measure(felt, moving=moving).tolist())

    def _carry(self, base: BaseMotion, across: dict[str, Any]) -> None:
        """Move the needle along its axis with the base, or push it."""
        insertion, interval = self.insertion, self.interval
        part = interval / _PUSHES
        push = base.push(self.time, self.depth, part)
        if push is None:
            velocity = base.velocity(self.time, self.depth, insertion.velocity, interval)
            forces = np.empty(self._sensor.samples)
            insertion.carry(interval, velocity, forces=forces, **across)
            self._felt[:, 1] = forces
            return
        self._felt[:, 1] = 0.0
        for k, shares in enumerate(self._shares):
            if k:
                later = base.push(self.time + k * part, self.depth, part)
                push = push if later is None else later
            self._felt[:, 1] += shares * insertion.push(
                part, push, speed_limit=base.limits.speed_limit, **(across if k == 0 else {})
            )

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
        """
        Advance by one sample interval and return the measurements, `joint_states` last.

        The torque has no effect, because the guide holds the needle.
        """
        wrench = self.advance(force)
        needle, before = self.insertion.needle, self._tip
        self._tip = tip = [*needle.tip.tolist(), needle.tip_roll]
        measured: list[Measurement] = [(BASE_WRENCH.name, 0, wrench)]
        x, depth, z, _ = tip
        seen = self._tip_sensor.measure(depth, z, x)
        if seen is not None:
            measured.append((TIP_DEFLECTION.name, seen.age, seen.point))
        rates = [(b - a) / self.interval for a, b in zip(before, tip, strict=True)]
        velocity = self.insertion.velocity
        outside = needle.needle.length - depth
        truth = [outside, x, z, tip[3], -velocity, rates[0], rates[2], rates[3]]
        if self.base is None:
            # Insertion decreases d; the other coordinates have no command.
            truth += [-force, 0.0, 0.0, 0.0]
        measured.append((GROUND_TRUTH.name, 0, truth))
        joints = [
            on_grid(depth, self._resolution), *self._at.values(),
            velocity, *self._velocity.values(),
            float(self._felt[-1, 1]), *self._load,
        ]  # fmt: skip
        measured.append((JOINT_STATES.name, 0, joints))
        return measured

    def outline(self) -> MeasuredShape:
        """Return needle (base, guide, tip) and path for display."""
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
