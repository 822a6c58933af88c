# SPDX-License-Identifier: Apache-2.0
"""Synthetic anatomies with a seed: skin, bone as plates, organs, vessels as bent tubes, target."""

from __future__ import annotations

from typing import Final

from needle_dynamics import FloatArray
from needle_planning.anatomy import Anatomy, Structure
from needle_planning.clearance import Clearance
import numpy as np
from scipy.spatial import cKDTree

#: Voxels along each axis, and their size [m]: a cube of 12 cm.
VOXELS, SPACING = 96, 1.25e-3

_ENTRY, _BONE, _VESSEL, _ORGAN, _TISSUE = range(1, 6)

STRUCTURES: Final = {
    _ENTRY: Structure(name='skin', role='entry'),
    _BONE: Structure(name='bone', role='obstacle', margin=1e-3),
    _VESSEL: Structure(name='vessels', role='obstacle', margin=2e-3),
    _ORGAN: Structure(name='organs', role='obstacle', margin=3e-3),
    _TISSUE: Structure(name='tissue', role='tissue'),
}

_TOP: Final = 0.112  #: Largest height of the skin [m].
_CURVED: Final = 0.18  #: Radius of the skin [m].
_ENTRY_RADIUS: Final = 0.015  #: Radius of the entry region [m].
_VESSELS, _ORGANS = 16, 3  #: Numbers of obstacles in an anatomy.
_FREE: Final = 1e-3  #: Least clearance of the target [m].
_TARGETS: Final = 1000  #: Most targets that are drawn.


def draw_anatomy(seed: int, radius: float) -> tuple[Anatomy, FloatArray]:
    """Draw an anatomy, and a target that a needle with a radius [m] can reach without contact."""
    rng = np.random.default_rng(seed)
    x, y, z = (SPACING * one for one in np.ogrid[:VOXELS, :VOXELS, :VOXELS])
    middle = 0.5 * SPACING * (VOXELS - 1)
    beside = (x - middle) ** 2 + (y - middle) ** 2
    below = _TOP - beside / (2.0 * _CURVED) - z
    labels = np.where(below > 0.0, _TISSUE, 0).astype(np.int16)
    for _ in range(_ORGANS):
        center = rng.uniform([0.0, 0.0, 0.02], [0.12, 0.12, 0.085])
        a, b, c = rng.uniform(8e-3, 18e-3, 3)
        away = ((x - center[0]) / a) ** 2 + ((y - center[1]) / b) ** 2
        labels[(away + ((z - center[2]) / c) ** 2 < 1.0) & (below > 5e-3)] = _ORGAN
    for _ in range(_VESSELS):
        _paint_tube(labels, rng, below)
    # Plates below the skin: 12 mm wide, 10 mm apart, 6 mm thick.
    angle, shift = rng.uniform(0.0, np.pi), rng.uniform(0.0, 0.022)
    across = (x * np.cos(angle) + y * np.sin(angle) + shift) % 0.022
    labels[(np.abs(below - 0.011) < 3e-3) & (across < 0.012)] = _BONE
    labels[(below > 0.0) & (below < 2.5e-3) & (beside < _ENTRY_RADIUS**2)] = _ENTRY
    anatomy = Anatomy(
        labels=labels, to_patient=np.diag([SPACING] * 3 + [1.0]), structures=STRUCTURES
    )
    low, high = np.array([0.04, 0.04, 0.02]), np.array([0.08, 0.08, 0.055])
    targets = rng.uniform(low, high, (_TARGETS, 3))
    free = Clearance([anatomy], targets, radius=radius).at(targets) > _FREE
    return anatomy, targets[free.argmax()]


def _paint_tube(labels: np.ndarray, rng: np.random.Generator, below: FloatArray) -> None:
    """Draw a tube with a bent axis, a parabola through random points."""
    ends, bend = rng.uniform([0.0, 0.0, 0.01], [0.12, 0.12, 0.09], (2, 3)), rng.normal(0, 0.02, 3)
    s = np.linspace(0.0, 1.0, 200)[:, np.newaxis]
    axis = ends[0] + s * (ends[1] - ends[0]) + 4.0 * s * (1.0 - s) * bend
    size = rng.uniform(1e-3, 4e-3)
    most = int(size / SPACING) + 1
    ball = np.moveaxis(np.indices([2 * most + 1] * 3), 0, -1).reshape(-1, 3) - most
    centers = np.round(axis / SPACING).astype(int)
    near = (centers[:, np.newaxis] + ball).reshape(-1, 3)
    near = near[((near >= 0) & (near < VOXELS)).all(axis=1)]
    within = np.zeros(labels.shape, dtype=np.bool_)
    within[tuple(near.T)] = True
    index = np.argwhere(within)
    away, _ = cKDTree(axis).query(SPACING * index, distance_upper_bound=size)
    index = index[np.isfinite(away)]
    index = index[below[tuple(index.T)] > 5e-3]
    labels[tuple(index.T)] = _VESSEL
