# SPDX-License-Identifier: Apache-2.0
"""Surfaces of structures: closed, outside outward, near the voxels, and of limited size."""

from __future__ import annotations

from collections import Counter

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_dynamics.arrays import IntArray
from needle_insertion.report.surface import surface, surfaces
from needle_planning import Anatomy, Structure
import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt
from support.anatomies import affine

MANY = 10**9


def edges(triangles: IntArray) -> Counter[tuple[int, int]]:
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
    return Counter(map(tuple, ends.tolist()))


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 10**6), st.booleans())
def test_surface_is_closed_and_near_the_voxels(seed: int, mirrored: bool) -> None:
    rng = np.random.default_rng(seed)
    mask = rng.random(rng.integers(1, 8, 3)) < rng.uniform(0.1, 0.95)
    mask[0, 0, 0] = True
    spacing = rng.uniform(5e-4, 3e-3, 3) * [-1.0 if mirrored else 1.0, 1.0, 1.0]
    matrix = affine(spacing.tolist(), None, rng.normal(0.0, 0.1, 3).tolist())
    found = surface(mask, matrix, np.zeros(3), MANY)
    assert found.cell == 0.0
    # Each edge is passed as often in one direction as in the other: there is no hole.
    passed = edges(found.triangles)
    assert all(count == passed[b, a] for (a, b), count in passed.items())
    corners = found.points[found.triangles]
    volume = np.einsum('ij,ij->', corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    assert volume > 0.0
    # In a cube of voxel centers that differ, and moved by at most half a voxel along each axis.
    index = (found.points - matrix[:3, 3]) / spacing
    solid = np.pad(mask, 2)
    for kind in (solid, ~solid):
        near = distance_transform_edt(~kind)[tuple(np.rint(index + 2.0).astype(int).T)]
        assert near.max() <= np.sqrt(3.0) * 1.5


def test_ball_has_its_volume_and_its_radius() -> None:
    center, radius = np.array([14.0, 15.0, 13.0]), 9.0
    grid = np.indices((30, 30, 30)).transpose(1, 2, 3, 0)
    mask = np.linalg.norm(grid - center, axis=-1) < radius
    found = surface(mask, affine([1e-3] * 3), np.zeros(3), MANY)
    away = np.linalg.norm(1e3 * found.points - center, axis=1)
    # Voxels of 1 mm: within one of the ball.
    assert np.abs(away - radius).max() < 1.0
    corners = found.points[found.triangles]
    volume = np.einsum('ij,ij->', corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    # The corners of the voxels are cut, and smoothing restores its loss to a few percent.
    assert volume == pytest.approx(1e-9 * mask.sum(), rel=0.03)


@pytest.mark.parametrize('most', [12, 100, 1000])
def test_number_of_triangles_is_limited(most: int) -> None:
    grid = np.indices((40, 40, 40)).transpose(1, 2, 3, 0) - 19.5
    mask = np.abs(np.linalg.norm(grid, axis=-1) - 15.0) < 2.0
    found = surface(mask, affine([1e-3] * 3), np.zeros(3), most)
    assert len(found.triangles) <= most
    assert found.triangles.max(initial=0) < max(len(found.points), 1)
    whole = surface(mask, affine([1e-3] * 3), np.zeros(3), MANY)
    # The mean of points in a cell is in the cell.
    apart = np.linalg.norm(found.points[:, np.newaxis] - whole.points, axis=-1).min(axis=1)
    assert apart.max(initial=0.0) <= np.sqrt(3.0) * found.cell


def test_each_structure_has_its_surface_where_it_is() -> None:
    labels = np.zeros((20, 21, 22), np.int16)
    boxes = {3: (slice(2, 6), slice(3, 9), slice(4, 11)), 9: (slice(9, 18),) * 3}
    for label, box in boxes.items():
        labels[box] = label
    named = {k: Structure(name=f'{k}', role='tissue') for k in (3, 5, 9)}
    image = Anatomy(labels=labels, to_patient=affine([2e-3] * 3), structures=named)
    found = {int(one.name): shape for one, shape in surfaces(image, MANY)}
    assert found.keys() == boxes.keys()
    for label, box in boxes.items():
        # Faces of the outer voxels are half a voxel beyond their centers.
        low = [one.start - 0.5 for one in box]
        high = [one.stop - 0.5 for one in box]
        points = found[label].points / 2e-3
        # Smoothing rounds the edges.
        np.testing.assert_allclose(points.min(axis=0), low, atol=0.3)
        np.testing.assert_allclose(points.max(axis=0), high, atol=0.3)
