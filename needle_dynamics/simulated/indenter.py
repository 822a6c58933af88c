# SPDX-License-Identifier: Apache-2.0
"""Simulated end-effector that indents the tissue in the plane: section 3.2.2.3."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from math import hypot, nan
from typing import NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.simulated.base import on_grid
from needle_dynamics.simulated.force_sensor import ForceSensor
from needle_dynamics.simulated.plant import AT_REST, Measurement, SimulatedPlant
from needle_ros.contract import BASE_WRENCH, END_EFFECTOR_POSE
from needle_ros.errors import ParameterError
from needle_ros.settings import check_constants, constant, positive
from needle_ros.status import PlantStatus
from needle_ros.trajectories import check_times, joint_values, JointReference, Points
import numpy as np

JOINTS = ('x', 'z')  #: joints of the indenter trajectories: the axes of the plane


@dataclass(frozen=True, slots=True, kw_only=True)
class IndenterParameters:
    """Constants of the tissue under the end-effector (default: Table 2) and of the robot."""

    # The stiffness matrix depends on the magnitude of the force: linear between levels, constant
    # outside.

    force_levels: tuple[float, ...] = constant(
        (1.1, 1.2, 1.3, 1.4, 1.5), 'N', 'magnitudes of force at which the stiffness is given'
    )
    stiffness_xx: tuple[float, ...] = constant(
        (1260.0, 820.0, 1100.0, 1030.0, 960.0), 'N/m',
        'force along x per displacement along x, by level',
    )  # fmt: skip
    stiffness_xz: tuple[float, ...] = constant(
        (40.0, 40.0, 10.0, 1.0, -5.0), 'N/m', 'force along x per displacement along z, by level',
        low=-1e6,
    )  # fmt: skip
    stiffness_zx: tuple[float, ...] = constant(
        (-100.0, -100.0, -110.0, -110.0, -110.0), 'N/m',
        'force along z per displacement along x, by level', low=-1e6,
    )  # fmt: skip
    stiffness_zz: tuple[float, ...] = constant(
        (1010.0, 810.0, 690.0, 600.0, 520.0),
        'N/m',
        'force along z per displacement along z, by level',
    )
    off_plane: float = constant(
        1e-4, 'm/N', 'displacement along y per magnitude of the force', low=-1.0, high=1.0
    )
    position_noise: float = constant(1e-5, 'm', 'standard deviation of white position noise')
    encoder_resolution: float = constant(1e-6, 'm', 'length per count of the position')
    force_rate: float = positive(5.0, 'N/s', 'highest rate of the force')

    def __post_init__(self) -> None:
        check_constants(self)
        levels = self.force_levels
        for item in fields(self):
            values = getattr(self, item.name)
            if isinstance(item.default, tuple) and (
                not isinstance(values, tuple) or len(values) != len(levels)
            ):
                raise ParameterError(
                    f'{item.name} must be a list with one value for each of the force_levels, '
                    f'got {values!r}'
                )
        if not levels or any(high <= low for low, high in pairwise(levels)):
            raise ParameterError(f'force_levels must increase, got {list(levels)} N')
        for level, matrix in zip(levels, self.matrices, strict=True):
            # Then this holds at all forces between, and the displacement is unique.
            if np.linalg.eigvalsh(matrix + matrix.T)[0] <= 0.0:
                raise ParameterError(
                    f'stiffness_xx, ..., stiffness_zz must resist a press in every direction, '
                    f'got {matrix.tolist()} N/m at {level:g} N'
                )

    @property
    def matrices(self) -> FloatArray:
        """Stiffness matrix at each level [N/m], shape (levels, 2, 2), over x and z."""
        rows = (self.stiffness_xx, self.stiffness_xz, self.stiffness_zx, self.stiffness_zz)
        return np.array(rows, dtype=np.float64).T.reshape(-1, 2, 2)


class Press(NamedTuple):
    """Measurements at the end of one sample interval."""

    position: FloatArray  #: measured, of the end-effector x y z [m], zero without force, (3,)
    force: FloatArray  #: true force on the tissue along x and z [N], shape (2,)
    wrench: FloatArray  #: reading of the sensor: force on the tissue [N], torque [N m], (6,)


class Indenter(SimulatedPlant):
    """Indent the tissue with a commanded force in the plane, one sample at a time."""

    depth = 0.0  #: insertion depth; there is no needle

    topics = (BASE_WRENCH, END_EFFECTOR_POSE)

    def __init__(
        self,
        parameters: IndenterParameters,
        sensor: ForceSensor,
        rate: float,
        seed: int,
        force_limit: float = np.inf,
    ) -> None:
        super().__init__(sensor, rate)
        self._parameters = parameters
        self._levels = np.array(parameters.force_levels)
        self._entries = parameters.matrices.reshape(-1, 4).T
        # Independent of the random sequence of the force sensor.
        self._rng = np.random.default_rng([seed, 1])
        self._force_limit = force_limit  # of each axis [N]
        self._force = np.zeros(2)
        self._moving = False
        self._times = np.array([0.0])
        self._forces = np.zeros((1, 2))

    @property
    def report(self) -> PlantStatus:
        x, z = self._force
        return PlantStatus(force=(x, z))

    def follow(
        self, joints: Sequence[str], times: Sequence[float], positions: Points, efforts: Points
    ) -> None:
        # Efforts [N] without positions; linear in time from the present force.
        check_times(times)
        if any(len(point) for point in positions):
            raise ParameterError('the indenter takes efforts, not positions')
        forces = [joint_values(joint, joints, efforts) for joint in JOINTS]
        for values in forces:
            # Written so that NaN is rejected too.
            if not all(f is not None and abs(f) <= self._force_limit for f in values):
                raise ParameterError(
                    f'each point needs efforts of x and z within {self._force_limit:g} N, got '
                    f'{[list(point) for point in efforts]}'
                )
        self._times = self.time + np.append(0.0, times)
        self._forces = np.vstack([self._force, np.array(forces, dtype=np.float64).T])

    def references(self) -> dict[str, JointReference]:
        # Clock rounding must not delay the end.
        arrived = bool(self.time >= self._times[-1] - 1e-6 * self.interval)
        efforts = [float(np.interp(self.time, self._times, f)) for f in self._forces.T]
        return {
            joint: JointReference(nan, nan, effort, arrived)
            for joint, effort in zip(JOINTS, efforts, strict=True)
        }

    def _motion(self) -> str:
        return 'the end-effector moves' if self._moving else ''

    def change(self, _parameters: NeedleParameters) -> None:
        # There is no needle.
        return

    def take(self, _force: float, _torque: float) -> list[Measurement]:
        press = self.advance()
        pose = [*press.position.tolist(), 0.0, 0.0, 0.0, 1.0]
        return [(BASE_WRENCH.name, 0, press.wrench.tolist()), (END_EFFECTOR_POSE.name, 0, pose)]

    def outline(self) -> None:
        """Return None: there is no needle to display."""

    def displacement(self, force: FloatArray) -> FloatArray:
        """Return the displacement x y z [m] under a force x, z [N], ``F = K(|F|) d``."""
        x, z = force
        size = hypot(x, z)
        xx, xz, zx, zz = (np.interp(size, self._levels, row) for row in self._entries)
        determinant = xx * zz - xz * zx
        return np.array(
            [
                (zz * x - xz * z) / determinant,
                self._parameters.off_plane * size,
                (xx * z - zx * x) / determinant,
            ]
        )

    def advance(self) -> Press:
        """Advance by one sample interval and return the measurements at its end."""
        p = self._parameters
        self._count += 1
        wanted = np.array([np.interp(self.time, self._times, f) for f in self._forces.T])
        change = wanted - self._force
        size = hypot(*change)
        most = p.force_rate * self.interval
        before = self.displacement(self._force)
        self._force = self._force + change * (most / size) if size > most else wanted
        true = self.displacement(self._force)
        self._moving = bool(abs(true - before).max() > AT_REST * self.interval)
        noisy = true + p.position_noise * self._rng.standard_normal(3)
        x, z = self._force
        return Press(
            position=np.array([on_grid(value, p.encoder_resolution) for value in noisy]),
            force=self._force,
            wrench=self._sensor.measure(np.array([x, 0.0, z, 0.0, 0.0, 0.0]), moving=self._moving),
        )
