# SPDX-License-Identifier: Apache-2.0
"""Synthetic anatomies: arrays of labels with obstacles, an entry region and a target."""

from __future__ import annotations

from typing import Final

from needle_controller.steering.insertion_plan import Plan
from needle_dynamics import FloatArray
from needle_planning.anatomy import Anatomy, Structure
import numpy as np
from numpy.typing import ArrayLike

SKIN, VESSELS, RIBS, LIVER, BOWEL = 1, 2, 3, 4, 5
ENTRY_LABEL: Final = 9  #: Label of the entry region of `window`.
WINDOW_TARGET: Final = np.array([0.042, 0.041, 0.006])  #: Target in `window` [m].

#: Meaning of the labels of `liver`.
STRUCTURES: Final = {
    SKIN: Structure(name='skin', role='entry'),
    VESSELS: Structure(name='vessels', role='obstacle', margin=2e-3),
    RIBS: Structure(name='ribs', role='obstacle', margin=1e-3),
    LIVER: Structure(name='liver', role='tissue'),
    BOWEL: Structure(name='bowel', role='obstacle', margin=5e-3),
}


def affine(
    spacing: ArrayLike, axes: FloatArray | None = None, origin: ArrayLike = (0.0, 0.0, 0.0)
) -> FloatArray:
    """Return the matrix from indices to patient of voxels with a size [m]."""
    found = np.eye(4)
    found[:3, :3] = (np.eye(3) if axes is None else axes) * np.array(spacing)
    found[:3, 3] = origin
    return found


def plan_of(entry: FloatArray, direction: FloatArray, displaced: float = 0.0) -> Plan:
    """Return a straight plan to a depth of 60 mm in six steps, with its path displaced [m]."""
    depths = np.linspace(0.0, 0.06, 7)
    return Plan(
        needle='bending_35mm', radius=6.4e-4, entry=entry, direction=direction,
        target=entry + 0.06 * direction, roll=0.0, depths=depths, guide=np.zeros((6, 2)),
        path=entry + np.outer(depths, direction) + displaced, clearances=np.full(7, 3e-3),
        clearance=3e-3, structure='bone', place=entry, bow=0.0, resolution=5e-4,
        straight_bound=3.5e-3, bound=5e-3,
    )  # fmt: skip


def window(margin: float = 1e-3, shift: int = 0) -> Anatomy:
    """Return voxels of 2 mm with two slabs, whose gaps are displaced by a number of voxels."""
    labels = np.zeros((40, 40, 60), dtype=np.int16)
    labels[:, :, 44] = labels[:, :, 24] = 1
    labels[12:18, 16:22, 44] = 0
    labels[16 + shift : 21 + shift, 18:23, 24] = 0
    labels[:, :, 58] = ENTRY_LABEL
    return Anatomy(
        labels=labels,
        to_patient=affine([2e-3] * 3),
        structures={
            1: Structure(name='bone', role='obstacle', margin=margin),
            ENTRY_LABEL: Structure(name='skin', role='entry'),
        },
    )


def center(anatomy: Anatomy, index: ArrayLike) -> FloatArray:
    """Return the position of a voxel index [m]."""
    matrix = anatomy.to_patient
    return matrix[:3, :3] @ np.asarray(index, dtype=float) + matrix[:3, 3]


def liver(shape: tuple[int, int, int] = (512, 512, 200), seed: int = 0) -> Anatomy:
    """Return a trunk of 36 cm: skin, ribs, a liver with a tree of vessels, and bowel."""
    size = np.array([0.4, 0.4, 0.3]) / shape
    x, y, z = (
        ((np.arange(n) - 0.5 * (n - 1)) * one).astype(np.float32)
        for n, one in zip(shape, size, strict=True)
    )
    x, y, z = x[:, None, None], y[None, :, None], z[None, None, :]
    labels = np.zeros(shape, dtype=np.int16, order='F')
    trunk = np.sqrt((x / 0.18) ** 2 + (y / 0.12) ** 2) + 0.0 * z
    labels[((x - 0.05) / 0.09) ** 2 + (y / 0.08) ** 2 + (z / 0.09) ** 2 < 1.0] = LIVER
    labels[((x + 0.07) / 0.07) ** 2 + ((y - 0.02) / 0.07) ** 2 + (z / 0.12) ** 2 < 1.0] = BOWEL
    # Ribs: oblique rings of 8 mm at a distance of 25 mm.
    height = np.abs((z + 0.4 * y + 0.0125) % 0.025 - 0.0125)
    labels[(np.abs(trunk - 0.9) < 0.03) & (height < 4e-3) & (y > -0.09)] = RIBS
    rng = np.random.default_rng(seed)
    index = np.indices((7, 7, 7)).reshape(3, -1).T - 3
    for _ in range(60):
        # A vessel is a smooth random line in the liver.
        point, way = rng.normal([0.05, 0.0, 0.0], 0.03), rng.normal(size=3)
        radius = rng.uniform(1e-3, 4e-3)
        for _ in range(120):
            way = way + 0.15 * rng.normal(size=3)
            way /= np.linalg.norm(way)
            point = point + 1e-3 * way
            at = np.round(point / size + 0.5 * (np.array(shape) - 1)).astype(int)
            near = at + index[np.linalg.norm(index * size, axis=1) <= radius]
            near = near[((near >= 0) & (near < shape)).all(axis=1)]
            inside = labels[tuple(near.T)] == LIVER
            labels[tuple(near[inside].T)] = VESSELS
    labels[(trunk > 0.985) & (trunk < 1.0) & (np.abs(z) < 0.1) & (x > 0.0)] = SKIN
    matrix = affine(size, origin=-0.5 * (np.array(shape) - 1) * size)
    return Anatomy(labels=labels, to_patient=matrix, structures=STRUCTURES)
