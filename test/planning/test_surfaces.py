# SPDX-License-Identifier: Apache-2.0
"""Voxels inside of closed surfaces in STL files."""

from __future__ import annotations

from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_planning import read_anatomy, SegmentationError
from needle_planning.surfaces import voxels_inside
import numpy as np
import pytest
from scipy.spatial import ConvexHull
from support.segmentations import assert_same_positions, positions_of, ROLES, write_labels
import trimesh

SHAPE = (9, 8, 7)
BOX = trimesh.creation.box()
CENTERS = np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing='ij'), -1)


def box(low: tuple[float, ...], high: tuple[float, ...]) -> np.ndarray:
    """Return the triangles of a box, shape (12, 3, 3)."""
    return np.asarray(trimesh.creation.box(bounds=[low, high]).triangles)


def assert_inside_half_spaces(points: np.ndarray, random: np.random.Generator) -> None:
    """Compare the voxels inside of a convex hull with its half spaces."""
    hull = ConvexHull(points)
    # Both triangles of an edge have it in any direction.
    triangles = random.permuted(hull.simplices, axis=1)
    inside = voxels_inside(points[triangles], SHAPE)
    distance = np.max(CENTERS @ hull.equations[:, :3].T + hull.equations[:, 3], -1)
    # Rounding of coordinates of 10.
    clear = np.abs(distance) > 1e-9
    np.testing.assert_array_equal(inside[clear], distance[clear] < 0.0)


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(4, 30))
def test_voxels_inside_of_a_convex_surface_satisfy_its_half_spaces(seed: int, count: int) -> None:
    """The hull of random points; it may reach beyond the grid on every side."""
    random = np.random.default_rng(seed)
    assert_inside_half_spaces(random.uniform(-3.0, 11.0, (count, 3)), random)


def test_edge_through_a_column_is_crossed_once() -> None:
    """Rounding puts the edge on either side of the column, for both of its triangles on one."""
    random = np.random.default_rng(1)
    for _ in range(1000):
        along = random.normal(size=3)
        ends = np.array([4.0, 4.0, 3.3]) + np.outer(random.uniform(0.5, 2.0, 2) * [-1, 1], along)
        others = random.uniform(-3.0, 11.0, (2, 3))
        assert_inside_half_spaces(np.concatenate([ends, others]), random)


@given(
    corners=st.lists(st.integers(-2, 10), min_size=6, max_size=6),
    cut=st.integers(0, 2),
    order=st.permutations(range(24)),
)
def test_solids_with_a_common_face_share_no_voxel(
    corners: list[int], cut: int, order: list[int]
) -> None:
    """Faces through centers of voxels: each voxel is in exactly one of two parts of a box."""
    ends = np.sort(np.reshape(corners, (2, 3)), axis=0)
    if not np.all(ends[1] - ends[0] >= 2):
        return
    middle = ends.copy()
    middle[:, cut] = ends[0, cut] + 1
    parts = [box(ends[0], np.where(np.arange(3) == cut, middle[1], ends[1])),
             box(np.where(np.arange(3) == cut, middle[0], ends[0]), ends[1])]  # fmt: skip
    whole = voxels_inside(box(*ends), SHAPE)
    first, second = (voxels_inside(part, SHAPE) for part in parts)
    assert not np.any(first & second)
    np.testing.assert_array_equal(first | second, whole)
    clipped = np.clip(ends, 0, np.array(SHAPE))
    assert np.sum(whole) == np.prod(clipped[1] - clipped[0])
    both = np.concatenate(parts)[np.array(order)]
    np.testing.assert_array_equal(voxels_inside(both, SHAPE), whole)


def test_cavity_of_a_surface_is_outside() -> None:
    shell = np.concatenate([box((0.5,) * 3, (5.5,) * 3), box((2.5,) * 3, (3.5,) * 3)])
    inside = voxels_inside(shell, SHAPE)
    assert not inside[3, 3, 3]
    assert np.sum(inside) == 5**3 - 1


@pytest.mark.parametrize('text', [False, True])
def test_folder_of_surfaces_is_one_anatomy(text: bool, tmp_path: Path) -> None:
    """Each file is a structure; a position in LPS [mm] becomes RAS [m]."""
    folder = tmp_path / 'parts'
    folder.mkdir()
    for name, center, radius in (('vessel', (30, 20, -10), 6.0), ('liver', (35, 20, -10), 20.0)):
        mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
        mesh.apply_translation(center)
        mesh.export(folder / f'{name}.stl', file_type='stl_ascii' if text else 'stl')
    labels = write_labels(
        tmp_path / 'labels.yaml', {'vessel': ROLES[1], 'liver': ROLES[2]},
        space='LPS', spacing='0.8mm',
    )  # fmt: skip
    (anatomy,) = read_anatomy(folder, labels)
    vessel, liver = (positions_of(anatomy, name) for name in ('vessel', 'liver'))
    volumes = np.array([len(vessel), len(liver) + len(vessel)]) * 0.8**3
    # A polyhedron of 5120 triangles has 0.3 % less than its sphere; the rest is of voxels.
    assert volumes == pytest.approx(4 / 3 * np.pi * np.array([6.0, 20.0]) ** 3, rel=0.02)
    np.testing.assert_allclose(vessel.mean(0), [-0.030, -0.020, -0.010], atol=1e-4)
    assert np.max(np.linalg.norm(vessel - [-0.030, -0.020, -0.010], axis=1)) < 6e-3


def test_same_numbers_in_the_other_space_are_the_mirrored_anatomy(tmp_path: Path) -> None:
    """Positions of the voxels, too, for a surface that does not fit their spacing."""
    mesh = trimesh.creation.icosphere(radius=7.3)
    mesh.apply_translation([20.13, 9.4, -31.7])
    mesh.export(tmp_path / 'a.stl')
    found = []
    for space in ('RAS', 'LPS'):
        labels = write_labels(tmp_path / 'labels.yaml', {'a': ROLES[1]}, space=space)
        (anatomy,) = read_anatomy(tmp_path / 'a.stl', labels)
        found.append(positions_of(anatomy, 'a'))
    assert_same_positions(found[0] * [-1.0, -1.0, 1.0], found[1])


def test_triangles_without_area_do_not_open_a_surface(tmp_path: Path) -> None:
    """Some programs write them."""
    corners = BOX.triangles * 10.0
    flat = corners[0][[0, 0, 1]]
    trimesh.Trimesh(**trimesh.triangles.to_kwargs([*corners, flat])).export(tmp_path / 'a.stl')
    labels = write_labels(tmp_path / 'labels.yaml', {'a': ROLES[1]}, space='RAS')
    (anatomy,) = read_anatomy(tmp_path / 'a.stl', labels)
    assert len(positions_of(anatomy, 'a')) == 1000


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_mirrored_surface_is_the_mirrored_anatomy(seed: int) -> None:
    """Voxels are at odd multiples of half the spacing: mirror images have mirrored voxels."""
    points = np.random.default_rng(seed).uniform(-3.3, 3.3, (12, 3))
    hull = points[ConvexHull(points).simplices]
    grid = (8, 8, 8)
    one = voxels_inside(hull + 3.5, grid)
    other = voxels_inside(hull * [-1, 1, 1] + 3.5, grid)
    np.testing.assert_array_equal(one, other[::-1])


def test_space_in_the_header_of_slicer_is_used(tmp_path: Path) -> None:
    """Its binary files begin with the space."""
    mesh = trimesh.creation.box(bounds=[(10, 10, 10), (20, 20, 20)])
    content = bytearray(mesh.export(file_type='stl'))
    for space, sign in (('LPS', -1.0), ('RAS', 1.0)):
        content[:80] = f'3D Slicer output. SPACE={space}'.encode().ljust(80)
        (tmp_path / 'box.stl').write_bytes(content)
        labels = write_labels(tmp_path / 'labels.yaml', {'box': ROLES[1]})
        (anatomy,) = read_anatomy(tmp_path / 'box.stl', labels)
        center = positions_of(anatomy, 'box').mean(0)
        assert center == pytest.approx([0.015 * sign, 0.015 * sign, 0.015])


@pytest.mark.parametrize(
    ('content', 'reason'),
    [
        (b'', 'is not an STL file'),
        (b'solid a\nendsolid a\n', 'is not an STL file'),
        (b'x' * 200, 'is not an STL file'),
        (BOX.export(file_type='stl')[:-60], 'is not an STL file'),
        (trimesh.Trimesh(BOX.vertices, BOX.faces[1:]).export(file_type='stl'),
         'is not a closed surface'),
        (trimesh.creation.box(extents=[0.1] * 3).export(file_type='stl'), 'encloses no voxel'),
        (trimesh.creation.box(extents=[0.02, 0.08, 0.02]).export(file_type='stl'),
         'voxel of 1 mm: its extent is 0.08 mm, read in mm as all STL files; reduce spacing'),
        (trimesh.creation.box(extents=[1e5] * 3).export(file_type='stl'), 'voxels, at most'),
        (trimesh.creation.box(extents=[1e8] * 3).export(file_type='stl'), 'corners beyond 1 km'),
    ],
)  # fmt: skip
def test_invalid_surface_is_rejected(content: bytes, reason: str, tmp_path: Path) -> None:
    (tmp_path / 'a.stl').write_bytes(content)
    labels = write_labels(tmp_path / 'labels.yaml', {'a': ROLES[1]}, space='RAS')
    with pytest.raises(SegmentationError, match=reason) as error:
        read_anatomy(tmp_path / 'a.stl', labels)
    assert str(tmp_path) in str(error.value)
