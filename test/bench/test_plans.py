# SPDX-License-Identifier: Apache-2.0
"""Planners of `needle bench plan`: arcs, their search, their insertion, and the anatomies."""

from __future__ import annotations

from itertools import pairwise

from benchmarks.anatomies import draw_anatomy
from benchmarks.arcs import (
    Arc,
    arc_clearance,
    best_arc,
    biarc,
    bowed_arc,
    fitted_bevel,
    insert_arcs,
    LOAD,
)
from needle_dynamics import FloatArray
from needle_dynamics.needles import DEFAULT_NEEDLE
from needle_planning.anatomy import Anatomy, Structure
from needle_planning.clearance import Clearance
from needle_planning.search import EntryRegion, voxel_region
import numpy as np
import pytest
from support.anatomies import affine

RADIUS = 6e-4
MOST = LOAD * fitted_bevel(DEFAULT_NEEDLE).curvature
ENTRY, BLOCK = 1, 2


def unit(values: FloatArray) -> FloatArray:
    return np.asarray(values / np.linalg.norm(values))


def problem(*, wide: bool = True) -> tuple[Clearance, EntryRegion, FloatArray]:
    """Return 3 x 3 entry voxels, a target 80 mm below, and a block that straight lines graze."""
    labels = np.zeros((20, 20, 50), dtype=np.int16)
    labels[9:12, 9:12, 45] = ENTRY
    labels[: 10 if wide else 14, :, 22:26] = BLOCK
    structures = {
        ENTRY: Structure(name='skin', role='entry'),
        BLOCK: Structure(name='vessel', role='obstacle', margin=1e-3),
    }
    anatomy = Anatomy(labels=labels, to_patient=affine([2e-3] * 3), structures=structures)
    target = np.array([0.02, 0.02, 0.01])
    region = voxel_region(anatomy, [ENTRY], target)
    assert region is not None
    points = np.vstack([region.centers, target])
    return Clearance([anatomy], points, radius=RADIUS, beyond=0.01), region, target


def test_two_arcs_connect_two_directions() -> None:
    """They begin and end at the points with the directions, and meet with one direction."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        start, end = np.zeros(3), np.array([0.0, 0.0, 0.05]) + rng.normal(0.0, 5e-3, 3)
        t, u = (unit(np.array([0.0, 0.0, 1.0]) + rng.normal(0.0, 0.1, 3)) for _ in range(2))
        one, other = biarc(start, t, end, u)
        # Rounding: 2e-17 m in positions of 0.05 m, and up to 2e-15 in directions, which are
        # differences of points over their distance.
        assert one.end == pytest.approx(other.start, abs=1e-15)
        assert one.axes_at_end()[0] == pytest.approx(other.tangent, abs=1e-13)
        assert other.end == pytest.approx(end, abs=1e-15)
        assert other.axes_at_end()[0] == pytest.approx(u, abs=1e-13)


@pytest.mark.parametrize('curvature', [0.0, 0.7, 5.0])
def test_arc_between_two_points_has_its_curvature(curvature: float) -> None:
    """
    The angle between its ends is curvature times length; reversed twice it is the same.

    Up to rounding. Points of a straight arc are on a radius of 1000 km, 4 nm beside the line at
    its end, and twice as far after two of them.
    """
    apart = 1e-8 if curvature == 0.0 else 1e-15
    entry, target = np.array([0.01, 0.0, 0.09]), np.array([0.0, 0.02, 0.0])
    arc = bowed_arc(entry, target, curvature * np.array([0.6, -0.8]))
    # A rounding of 1e-17 m across a chord of 0.1 m is a curvature of 1e-15 /m.
    assert arc.curvature == pytest.approx(curvature, abs=1e-13)
    assert arc.end == pytest.approx(target, abs=apart)
    angle = np.arccos(min(1.0, float(arc.tangent @ arc.axes_at_end()[0])))
    # The arc cosine of an angle of 0.06 multiplies rounding by 16.
    assert angle == pytest.approx(curvature * arc.length, abs=1e-13)
    again = arc.reverse().reverse()
    assert again.start == pytest.approx(entry, abs=apart)
    assert again.tangent == pytest.approx(arc.tangent, abs=1e-15)
    steps = np.linspace(0.0, arc.length, 9)
    assert arc.reverse().points(steps) == pytest.approx(arc.points(steps)[::-1], abs=apart)


def test_no_arc_of_a_dense_grid_is_better() -> None:
    """Brute force over entries and curvatures: points 1 mm apart change a clearance by 20 um."""
    clearance, region, target = problem()
    [best] = best_arc(clearance, region, target, MOST)
    found = arc_clearance(clearance, [best])
    rng = np.random.default_rng(1)
    turns, sizes = rng.uniform(0.0, 2.0 * np.pi, 40), MOST * rng.uniform(0.0, 1.0, 40) ** 0.5
    for entry in region.centers:
        for turn, size in zip(turns, sizes, strict=True):
            arc = bowed_arc(entry, target, size * np.array([np.cos(turn), np.sin(turn)]))
            assert arc_clearance(clearance, [arc]) <= found + 2e-5
    straight = max(
        arc_clearance(clearance, [bowed_arc(one, target, np.zeros(2))]) for one in region.centers
    )
    assert found > straight
    assert best.curvature <= MOST * (1.0 + 1e-9)
    assert best_arc(*problem(wide=False), MOST) == []


def test_inserted_arc_is_near_its_plan() -> None:
    """
    A straight arc is the straight needle; a curved one ends where the fit of its bevel does.

    The path of the bevel deviates from the fitted arc by less than 0.5 mm at its load.
    """
    clearance, region, target = problem()
    straight = bowed_arc(region.centers[4], target, np.zeros(2))
    found = insert_arcs(clearance, DEFAULT_NEEDLE, [straight], target)
    assert found.miss < 1e-6
    # Points 1 mm and 0.1 mm apart.
    assert found.clearance == pytest.approx(arc_clearance(clearance, [straight]), abs=2e-5)
    curved = bowed_arc(region.centers[4], target, np.array([MOST, 0.0]))
    found = insert_arcs(clearance, DEFAULT_NEEDLE, [curved], target)
    assert found.miss < 5e-4
    assert abs(found.final - arc_clearance(clearance, [curved])) < 5e-4
    assert found.clearance <= found.final


def test_anatomies_depend_on_their_seed_only() -> None:
    one, target = draw_anatomy(3, RADIUS)
    again, same = draw_anatomy(3, RADIUS)
    assert np.array_equal(one.labels, again.labels)
    assert np.array_equal(target, same)
    assert set(np.unique(one.labels)) == {0, *one.structures}
    assert Clearance([one], target, radius=RADIUS).at(target[np.newaxis])[0] > 1e-3
    other, _ = draw_anatomy(4, RADIUS)
    assert not np.array_equal(one.labels, other.labels)


def test_path_of_ompl_is_a_sequence_of_arcs_to_the_target() -> None:
    """It begins at the entry, is smooth, within the curvature, and ends at the target."""
    pytest.importorskip('ompl')
    from benchmarks.rrt import best_path

    clearance, region, target = problem()
    arcs: list[Arc] = best_path(clearance, region, target, MOST, seconds=1.0, seed=1)
    assert arcs
    away = region.frame.of_patient(arcs[0].start) - region.frame.of_patient(region.centers)
    assert np.abs(away).max(axis=1).min() <= 1e-3 * (1.0 + 1e-5)
    assert arcs[-1].end == pytest.approx(target, abs=1e-8)
    for one, other in pairwise(arcs):
        assert one.end == pytest.approx(other.start, abs=1e-8)
        assert one.axes_at_end()[0] == pytest.approx(other.tangent, abs=1e-6)
    assert max(one.curvature for one in arcs) <= MOST * (1.0 + 1e-6)
    assert arc_clearance(clearance, arcs) > 0.0
