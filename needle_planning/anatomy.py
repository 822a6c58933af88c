# SPDX-License-Identifier: Apache-2.0
"""Segmented image in patient coordinates: labels, and what each label means for a needle."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import nan
from typing import Final

from needle_dynamics import FloatArray
from needle_ros.errors import NeedleError
import numpy as np
from numpy.typing import NDArray

#: Roles of a label: never touched; pierced; to reach; where the needle may enter.
ROLES: Final = ('obstacle', 'tissue', 'target', 'entry')

#: Roles in the order in which structures cover each other.
COVERS: Final = ('obstacle', 'target', 'entry', 'tissue')

#: Largest cosine between two axes of the voxels: 0.1 mm in 1 m; orientations in files are rounded.
_PERPENDICULAR: Final = 1e-4


class SegmentationError(NeedleError, ValueError):
    """A segmented image is damaged, of an unknown format, or has no valid orientation."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Structure:
    """Meaning of a label."""

    name: str
    role: str  #: one of `ROLES`
    margin: float = 0.0  #: distance that the needle keeps from an obstacle [m]
    stiffness: float = nan  #: median stiffness of tissue [N/m^2]; nan: that of the needle file
    spread: float = nan  #: standard deviation of its logarithm [1]
    source: str = ''  #: source of the stiffness


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Anatomy:
    """
    Segmented image; patient coordinates are RAS [m]: x to the right, y to the front, z up.

    Voxels without a structure are empty: a needle may pass through them. The axes of the voxels
    are perpendicular to each other.
    """

    labels: NDArray[np.integer]  #: label of each voxel, shape (i, j, k)
    to_patient: FloatArray  #: from voxel indices (center of the voxel) to patient, shape (4, 4)
    structures: Mapping[int, Structure]  #: by label

    def __post_init__(self) -> None:
        if self.labels.ndim != 3 or not self.labels.size or self.labels.dtype.kind not in 'iu':
            raise SegmentationError(
                'labels must be whole numbers of shape (i, j, k), got '
                f'{self.labels.dtype} of shape {self.labels.shape}'
            )
        check_axes(self.to_patient)


@np.errstate(all='ignore')
def check_axes(to_patient: FloatArray) -> None:
    """Raise `SegmentationError` unless a matrix maps voxels on a grid with perpendicular axes."""
    if to_patient.shape != (4, 4) or not np.all(np.isfinite(to_patient)):
        raise SegmentationError(
            f'the orientation must be 4 x 4 finite numbers, got {to_patient.tolist()}'
        )
    spacing = np.linalg.norm(to_patient[:3, :3], axis=0)
    if not (np.array_equal(to_patient[3], (0.0, 0.0, 0.0, 1.0)) and spacing.min() > 1e-7):
        raise SegmentationError(f'the orientation is singular: {to_patient.tolist()}')
    if spacing.max() > 1.0:
        raise SegmentationError(f'voxels of {spacing.max():g} m are not of a patient')
    axes = to_patient[:3, :3] / spacing
    cosines = np.abs(axes.T @ axes - np.eye(3))
    if cosines.max() > _PERPENDICULAR:
        raise SegmentationError(
            f'axes of the voxels have a cosine of {cosines.max():.3g} to each other, at most '
            f'{_PERPENDICULAR:g} is accepted: resample the image on a grid with perpendicular axes'
        )


def beside(anatomies: Iterable[Anatomy], target: FloatArray) -> str:
    """
    Return a line if a target is in no structure with the role ``target``.

    Parameters
    ----------
    anatomies : iterable of Anatomy
        Images in the same patient coordinates.
    target : ndarray, shape (3,)
        Target in patient coordinates [m].

    Returns
    -------
    str
        Names of the structures to reach, and where the target is; empty without such a structure.

    """
    wanted, here = set[str](), set[str]()
    for anatomy in anatomies:
        wanted |= {one.name for one in anatomy.structures.values() if one.role == 'target'}
        index = np.rint(np.linalg.solve(anatomy.to_patient, np.append(target, 1.0))[:3])
        if (index < 0).any() or (index >= anatomy.labels.shape).any():
            continue
        found = anatomy.structures.get(int(anatomy.labels[tuple(index.astype(int))]))
        if found is not None and found.role == 'target':
            return ''
        here |= {found.name} if found is not None else set()
    places = ' and '.join(sorted(here)) or 'no structure'
    return f'the target is not in {" or ".join(sorted(wanted))} (it is in {places})' * bool(wanted)
