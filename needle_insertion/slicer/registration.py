"""From the frame of the needle to that of the images, and back."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_ros.errors import ParameterError
from needle_ros.settings import check_constants, constant
import numpy as np
from numpy.typing import ArrayLike

#: Lengths of OpenIGTLink and of 3D Slicer [per m].
MILLIMETERS: Final = 1e3

#: Numbers of a quaternion that was written with three digits are off by this.
_ROUNDED: Final = 2e-3


def rotation_matrix(quaternion: ArrayLike) -> FloatArray:
    """
    Return the rotation of a quaternion.

    Parameters
    ----------
    quaternion : array_like, shape (4,)
        x, y, z, w; it is scaled to norm 1.

    Returns
    -------
    ndarray, shape (3, 3)
        Turns vectors as the quaternion does.

    Raises
    ------
    ParameterError
        If its norm is not 1, but for rounding.

    """
    given = np.array(quaternion, dtype=np.float64)
    norm = sqrt(given @ given) if given.shape == (4,) and np.isfinite(given).all() else 0.0
    if abs(norm - 1.0) > _ROUNDED:
        raise ParameterError(
            f'must be a quaternion x, y, z, w of norm 1, got {given.tolist()} of norm {norm:g}'
        )
    x, y, z, w = given / norm
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Registration:
    r"""
    Where the frame ``needle_entry`` is in the images.

    .. math:: p_{image} = R p_{needle} + t

    By default the axes are parallel, and the entry point is the origin of the images: x to the
    patient's right, y (into the tissue) anterior, z superior.
    """

    rotation: tuple[float, ...] = constant(
        (0.0, 0.0, 0.0, 1.0),
        '1',
        'turns vectors of needle_entry into the frame of the images: quaternion x, y, z, w',
        low=-1.0,
        high=1.0,
    )
    translation: tuple[float, ...] = constant(
        (0.0, 0.0, 0.0),
        'm',
        'where the entry point is in the frame of the images: x, y, z; in m, while Slicer shows '
        'mm',
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
        """
        Convert points of the needle.

        Parameters
        ----------
        points : array_like, shape (..., 3)
            In ``needle_entry`` [m].

        Returns
        -------
        ndarray, shape (..., 3)
            In the frame of the images [mm].

        """
        turned = np.asarray(points, dtype=np.float64) @ rotation_matrix(self.rotation).T
        return np.asarray(MILLIMETERS * (turned + self.translation))

    def to_needle(self, points: ArrayLike) -> FloatArray:
        """
        Convert points of the images.

        Parameters
        ----------
        points : array_like, shape (..., 3)
            In the frame of the images [mm].

        Returns
        -------
        ndarray, shape (..., 3)
            In ``needle_entry`` [m].

        """
        lengths = np.asarray(points, dtype=np.float64) / MILLIMETERS
        return np.asarray((lengths - self.translation) @ rotation_matrix(self.rotation))

    def pose_to_image(self, position: ArrayLike, quaternion: ArrayLike) -> FloatArray:
        """
        Convert a pose of the needle.

        Parameters
        ----------
        position : array_like, shape (3,)
            In ``needle_entry`` [m].
        quaternion : array_like, shape (4,)
            Orientation in ``needle_entry``: x, y, z, w.

        Returns
        -------
        ndarray, shape (4, 4)
            Homogeneous matrix in the frame of the images, lengths in mm.

        Raises
        ------
        ParameterError
            If the norm of the quaternion is not 1.

        """
        pose = np.eye(4)
        pose[:3, :3] = rotation_matrix(self.rotation) @ rotation_matrix(quaternion)
        pose[:3, 3] = self.to_image(position)
        return pose
