# SPDX-License-Identifier: Apache-2.0
"""Segmented image in patient coordinates: labels, and what each label means for a needle."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
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

_ALONG: Final = 1e-4  #: Distance of the points outside of an entry point that are examined [m].
#: Largest tissue outside of an entry point at the skin, by the size of the voxels [voxels].
_VOXELS: Final = 1.5

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
    stiffness: float = nan  #: median stiffness of tissue [N/m^2]; nan: as in the needle file
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
    closed: bool = False  #: structures are closed surfaces: none continues outside of the voxels

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


def covered(anatomies: Iterable[Anatomy], entry: FloatArray, direction: FloatArray) -> str:
    """
    Return a warning of structures outside of an entry point, on the line of the needle.

    Parameters
    ----------
    anatomies : iterable of Anatomy
        Images in the same patient coordinates.
    entry : ndarray, shape (3,)
        Entry point in patient coordinates [m].
    direction : ndarray, shape (3,)
        Direction of the insertion, a unit vector.

    Returns
    -------
    str
        Names of the structures, and the length in them; empty for an entry point at the skin, to
        the size of the voxels.

    """
    most, names = 0.0, dict[str, None]()
    for anatomy in anatomies:
        to_index = np.linalg.inv(anatomy.to_patient)
        step = to_index[:3, :3] @ -direction
        first = to_index[:3, :3] @ entry + to_index[:3, 3]
        # No point in the image is further away than all edges together and the first point.
        far = (np.abs(first) + anatomy.labels.shape).sum() / np.linalg.norm(step)
        found = _labels_along(anatomy, entry, -direction, far)
        inside = np.isin(found, list(anatomy.structures))
        length = _ALONG * np.count_nonzero(inside)
        if _is_visible(anatomy, direction, length):
            most = max(most, length)
            names |= dict.fromkeys(anatomy.structures[one].name for one in found[inside].tolist())
    through = ' and '.join(names)
    return (
        f'the needle passes through {through} for {1e3 * most:.1f} mm outside of the entry point'
    ) * bool(names)


def _labels_along(
    anatomy: Anatomy, entry: FloatArray, direction: FloatArray, length: float
) -> NDArray[np.int64]:
    """Return the labels of points from an entry point on, -1 outside of the image."""
    to_index = np.linalg.inv(anatomy.to_patient)
    points = entry + np.outer(np.arange(0.0, length, _ALONG), direction)
    index = np.rint(points @ to_index[:3, :3].T + to_index[:3, 3]).astype(int)
    inside = ((index >= 0) & (index < anatomy.labels.shape)).all(axis=1)
    found = np.full(len(index), -1)
    found[inside] = anatomy.labels[tuple(index[inside].T)]
    return found


def _is_visible(anatomy: Anatomy, direction: FloatArray, length: float) -> bool:
    """Return whether a length [m] is larger than the accuracy of the voxels."""
    step = np.linalg.solve(anatomy.to_patient[:3, :3], direction)
    return bool(length * np.abs(step).max() > _VOXELS)


def before_tissue(
    anatomies: Sequence[Anatomy], target: FloatArray, entry: FloatArray, direction: FloatArray
) -> str:
    """
    Return a warning of a length in no structure after an entry point.

    Parameters
    ----------
    anatomies : sequence of Anatomy
        Images in the same patient coordinates.
    target, entry : ndarray, shape (3,)
        Ends of the needle in patient coordinates [m].
    direction : ndarray, shape (3,)
        Direction of the insertion, a unit vector.

    Returns
    -------
    str
        The length; empty to the size of the voxels, and for images without tissue and entry
        region, which do not state where the patient begins.

    """
    length = float(np.linalg.norm(target - entry))
    every = [one for anatomy in anatomies for one in anatomy.structures.values()]
    if not any(one.role in ('tissue', 'entry') for one in every):
        return ''
    known = np.any(
        [
            np.isin(_labels_along(one, entry, direction, length), list(one.structures))
            for one in anatomies
        ],
        axis=0,
    )
    first = _ALONG * float(np.append(known, True).argmax())
    return (
        f'the needle is in no structure for {1e3 * first:.1f} mm after the entry point, which may '
        'be outside of the patient'
    ) * all(_is_visible(one, direction, first) for one in anatomies)


def outside(
    anatomies: Iterable[Anatomy], target: FloatArray, entry: FloatArray, direction: FloatArray
) -> list[str]:
    """
    Return warnings of lengths outside of each image with obstacles, to the size of its voxels.

    Closed surfaces have no further obstacles. Parameters: see `before_tissue`.
    """
    lines, length = [], float(np.linalg.norm(target - entry))
    for anatomy in anatomies:
        names = [one.name for one in anatomy.structures.values() if one.role == 'obstacle']
        away = _ALONG * np.count_nonzero(_labels_along(anatomy, entry, direction, length) < 0)
        if names and not anatomy.closed and _is_visible(anatomy, direction, away):
            lines.append(
                f'{1e3 * away:.1f} mm of the needle are outside of the image with '
                f'{" and ".join(names)}, where further obstacles are unknown'
            )
    return lines


def plan_warnings(
    anatomies: Sequence[Anatomy], target: FloatArray, entry: FloatArray, direction: FloatArray
) -> list[str]:
    """Return the lines of `beside`, `covered`, `before_tissue` and `outside`."""
    lines = [
        beside(anatomies, target),
        covered(anatomies, entry, direction),
        before_tissue(anatomies, target, entry, direction),
        *outside(anatomies, target, entry, direction),
    ]
    return [one for one in lines if one]
