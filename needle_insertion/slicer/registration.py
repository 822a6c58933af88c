# SPDX-License-Identifier: Apache-2.0
"""Transformation between the frame of the needle and the frame of the images."""

from dataclasses import dataclass
from math import sqrt
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_ros.errors import ParameterError
from needle_ros.settings import check_constants, constant
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

MILLIMETERS: Final = 1e3  #: millimeters per meter: OpenIGTLink and 3D Slicer use mm
_ROUNDED: Final = 2e-3  #: tolerance of the norm of a quaternion that is rounded to three digits


def rotation_matrix(quaternion: ArrayLike) -> FloatArray:
    """Return the rotation matrix of a quaternion xyzw; `ParameterError` if its norm is not 1."""
    given = np.array(quaternion, dtype=np.float64)
    norm = sqrt(given @ given) if given.shape == (4,) and np.isfinite(given).all() else 0.0
    if abs(norm - 1.0) > _ROUNDED:
        raise ParameterError(
            f'must be a quaternion x, y, z, w of norm 1, got {given.tolist()} of norm {norm:g}'
        )
    return np.asarray(Rotation.from_quat(given).as_matrix())


@dataclass(frozen=True, slots=True, kw_only=True)
class Registration:
    """
    Pose of the frame ``needle_entry`` in the images, p_image = R p_needle + t.

    By default the origins are equal, and x is to the patient's right, y anterior, z superior.
    """

    rotation: tuple[float, ...] = constant(
        (0.0, 0.0, 0.0, 1.0),
        '1',
        'rotation from needle_entry to the frame of the images: quaternion x, y, z, w',
        low=-1.0,
        high=1.0,
    )
    translation: tuple[float, ...] = constant(
        (0.0, 0.0, 0.0),
        'm',
        'position of the entry point in the frame of the images: x, y, z; in m (3D Slicer shows '
        'mm)',
        low=-10.0,
        high=10.0,
    )

    def __post_init__(self) -> None:
        for name, count in (('rotation', 4), ('translation', 3)):
            given = getattr(self, name)
            if not isinstance(given, tuple) or len(given) != count:
                raise ParameterError(f'{name} must have {count} numbers, got {given!r}')
        check_constants(self)
        try:
            rotation_matrix(self.rotation)
        except ParameterError as error:
            raise ParameterError(f'rotation {error}') from error

    def to_image(self, points: ArrayLike) -> FloatArray:
        """Transform points (..., 3) from ``needle_entry`` [m] to the frame of the images [mm]."""
        turned = np.asarray(points, dtype=np.float64) @ rotation_matrix(self.rotation).T
        return np.asarray(MILLIMETERS * (turned + self.translation))

    def to_needle(self, points: ArrayLike) -> FloatArray:
        """Transform points (..., 3) from the frame of the images [mm] to ``needle_entry`` [m]."""
        lengths = np.asarray(points, dtype=np.float64) / MILLIMETERS
        return np.asarray((lengths - self.translation) @ rotation_matrix(self.rotation))

    def pose_to_image(self, position: ArrayLike, quaternion: ArrayLike) -> FloatArray:
        """Transform a pose (position in m) to a homogeneous matrix of the images (in mm)."""
        pose = np.eye(4)
        pose[:3, :3] = rotation_matrix(self.rotation) @ rotation_matrix(quaternion)
        pose[:3, 3] = self.to_image(position)
        return pose
