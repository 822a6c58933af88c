# SPDX-License-Identifier: Apache-2.0
"""Plans: no violation, agreement with brute force, symmetry, monotony, files and errors."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path
import pickle
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from needle_controller.steering.free_space import UNITS
from needle_controller.steering.settings import SteeringLimits
from needle_dynamics import find_needle, FloatArray, SteeredNeedle
from needle_dynamics.steering.needle import inserted_shape
from needle_insertion.commands.plan import text_of
from needle_planning import find_plan, NoPathError, Plan
from needle_planning.anatomy import Anatomy, Structure
from needle_planning.clearance import Clearance
from needle_planning.paths import Line, needle_radius
from needle_planning.search import disc_region, voxel_region
from needle_ros.errors import NeedleError, ParameterError
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.anatomies import affine, center, liver, SKIN, window
from support.anatomies import ENTRY_LABEL as ENTRY
from support.anatomies import WINDOW_TARGET as TARGET

RESOLUTION = 5e-4
RADIUS = needle_radius(find_needle('bending_35mm').needle)
FIRST = 1  #: Label of the first obstacle.


class Case:
    """Random obstacles that are boxes of voxels, an entry layer, and a target."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.spacing = rng.uniform(2e-3, 6e-3, 3)
        shape = np.array([12, 11, 14])
        labels = np.zeros(shape, dtype=np.int16)
        #: First voxel, voxel after the last one, and margin [m].
        self.boxes: list[tuple[FloatArray, FloatArray, float]] = []
        for _ in range(rng.integers(2, 8)):
            low = rng.integers([-2, -2, 4], [10, 9, 11])
            high = np.minimum(low + rng.integers([3, 3, 1], [9, 9, 4]), shape)
            place = tuple(map(slice, low.clip(0), high))
            if not labels[place].any():
                labels[place] = FIRST + len(self.boxes)
                self.boxes.append((low.clip(0), high, rng.uniform(0.0, 4e-3)))
        x, y = rng.integers(0, 7, 2)
        labels[x : x + 5, y : y + 4, 13] = ENTRY
        self.entries = np.argwhere(labels == ENTRY)
        axes = Rotation.random(random_state=seed).as_matrix()
        structures = {
            label: Structure(name=f'box {label}', role='obstacle', margin=margin)
            for label, (_, _, margin) in enumerate(self.boxes, FIRST)
        }
        structures[ENTRY] = Structure(name='skin', role='entry')
        self.anatomy = Anatomy(
            labels=labels,
            to_patient=affine(self.spacing, axes, rng.normal(0.0, 0.1, 3)),
            structures=structures,
        )
        self.target = np.array([5.0, 5.0, 1.0])

    def clearances(self, points: FloatArray) -> FloatArray:
        """Return the clearance of points of voxel indices (..., 3) by the distance to each box."""
        found = np.full(points.shape[:-1], 0.03)
        for low, high, margin in self.boxes:
            away = np.maximum(np.maximum(low - 0.5 - points, points - (high - 0.5)), 0.0)
            distance = np.linalg.norm(away * self.spacing, axis=-1)
            found = np.minimum(found, distance - margin - RADIUS)
        return found

    def best(self) -> float:
        """Return the largest clearance of lines from a dense grid of entry points [m]."""
        steps = np.linspace(-0.5, 0.5, 5)
        inside = np.stack(np.meshgrid(steps, steps, [-0.5, 0.0, 0.5]), axis=-1).reshape(-1, 3)
        entries = (self.entries[:, np.newaxis] + inside).reshape(-1, 3)
        s = np.linspace(0.0, 1.0, 60)[:, np.newaxis]
        points = entries[:, np.newaxis] * (1.0 - s) + s * self.target
        return float(self.clearances(points).min(axis=1).max())

    def index(self, points: FloatArray) -> FloatArray:
        matrix = np.linalg.inv(self.anatomy.to_patient)
        return np.asarray(points @ matrix[:3, :3].T + matrix[:3, 3])


def plan_or_error(case: Case, resolution: float = RESOLUTION) -> Plan | NeedleError:
    """Return the straight plan of a case, or the error without a plan."""
    target = center(case.anatomy, case.target)
    try:
        return find_plan(case.anatomy, target, bow=False, resolution=resolution)
    except NeedleError as error:
        return error


def test_search_agrees_with_brute_force_on_200_anatomies() -> None:
    """
    A plan is the best one to the resolution, and without a plan no line is above the resolution.

    Lines of brute force are sampled 1 mm apart, which adds half of this at most to a clearance.
    """
    found = []
    for seed in range(200):
        case = Case(seed)
        best, plan = case.best(), plan_or_error(case)
        found.append(isinstance(plan, Plan))
        if isinstance(plan, NoPathError):
            assert best <= RESOLUTION + 5e-4, seed
            assert plan.bound <= RESOLUTION, seed
        elif isinstance(plan, NeedleError):
            assert 'the target is in box' in str(plan), (seed, plan)
            assert best < 0.0, seed
        else:
            assert plan.clearance > 0.0, seed
            assert best <= plan.clearance + RESOLUTION + 5e-4, seed
            assert plan.clearance <= plan.straight_bound <= plan.clearance + RESOLUTION, seed
            # The plan itself: its entry is in the region, and its line has this clearance.
            entry = case.index(plan.entry)
            assert np.abs(entry - case.entries).max(axis=1).min() <= 0.5 + 1e-9, seed
            s = np.linspace(0.0, 1.0, 2000)[:, np.newaxis]
            line = case.clearances(entry * (1.0 - s) + s * case.target)
            # Bounded to 5 um; samples are 50 um apart.
            assert plan.clearance <= line.min() + 1e-9 <= plan.clearance + 6e-5, seed
    assert 60 < sum(found) < 170


def test_shortest_of_equal_lines_is_used() -> None:
    """
    No voxel of the entry region has a shorter line with the largest clearance of all.

    Lines are equal if the least clearance is that of the target, or the limit of the search.
    """
    equal = 0
    for seed in range(120):
        case = Case(seed)
        # Far obstacles: the clearance is at the limit.
        case.boxes = case.boxes[: seed % 3]
        labels = np.where(case.anatomy.labels == ENTRY, ENTRY, 0)
        for label, (low, high, _) in enumerate(case.boxes, FIRST):
            labels[tuple(map(slice, low, high))] = label
        case.anatomy = replace(case.anatomy, labels=labels)
        plan = plan_or_error(case)
        if not isinstance(plan, Plan):
            continue
        away = (case.entries - case.target) * case.spacing
        lengths = np.linalg.norm(away, axis=1)
        s = np.linspace(0.0, 1.0, 1000)[:, np.newaxis]
        entries = case.entries[lengths < plan.length - 1e-9, np.newaxis]
        clearances = case.clearances(entries * (1.0 - s) + s * case.target).min(axis=1)
        assert (clearances < plan.straight_bound - 1e-9).all(), seed
        equal += plan.straight_bound - plan.clearance < 1e-5
    assert equal > 20


def test_clearance_at_the_limit_is_at_least_that() -> None:
    """Text and page do not state a bound that is not searched."""
    anatomy = window()
    labels = np.where(anatomy.labels == 1, 0, anatomy.labels)
    labels[:, :, 0] = 1
    high = find_plan(replace(anatomy, labels=labels), (0.042, 0.041, 0.05), bow=False)
    assert high.at_limit
    text = text_of(high, 0.0)
    assert 'clearance at least 30.00 mm to all obstacles, searched up to 30 mm' in text
    assert 'no straight needle' not in text
    near = find_plan(anatomy, TARGET, bow=False)
    assert not near.at_limit
    assert 'no straight needle has more than' in text_of(near, 0.0)
    far = text_of(replace(near, straight_bound=0.03, bound=0.03), 0.0)
    assert 'a straight needle may have 30 mm or more,' in far
    assert 'a needle within the limits of the guide may have 30 mm or more' in far


def test_larger_resolution_is_as_true() -> None:
    """Bounds hold at any resolution, and overlap."""
    for seed in range(20):
        bounds = []
        for resolution in (2e-4, 1e-3, 3e-3):
            plan = plan_or_error(Case(seed), resolution)
            if isinstance(plan, Plan):
                bounds.append((plan.clearance, plan.straight_bound))
                assert plan.straight_bound - plan.clearance <= resolution
            elif isinstance(plan, NoPathError):
                bounds.append((-np.inf, plan.bound))
                assert plan.bound <= resolution
        assert all(low <= high + 1e-9 for low, _ in bounds for _, high in bounds), seed


def moved(anatomy: Anatomy, motion: FloatArray) -> Anatomy:
    """Return an anatomy whose patient coordinates are transformed, shape (4, 4)."""
    return replace(anatomy, to_patient=motion @ anatomy.to_patient)


@pytest.mark.parametrize('bow', [False, True])
@pytest.mark.parametrize('mirror', [False, True])
def test_moved_anatomy_has_the_moved_plan(bow: bool, mirror: bool) -> None:
    """
    A rotated or mirrored patient has the rotated or mirrored plan, to rounding.

    The guide has axes along the body: with a bow the rotation is about the body axis, and mirrored
    setpoints change their sign in x.
    """
    motion = np.eye(4)
    rotation = Rotation.from_rotvec([0.0, 0.0, 0.4] if bow else [0.5, -1.2, 0.3]).as_matrix()
    motion[:3, :3] = rotation * ([-1.0, 1.0, 1.0] if mirror else [1.0] * 3)
    motion[:3, 3] = 0.1, -0.2, 0.05
    # Insertion along x, so that the axis z of the guide is along S.
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler('y', 80, degrees=True).as_matrix()
    anatomy = moved(window(shift=1), turn)

    def planned(matrix: FloatArray) -> Plan:
        to = matrix @ turn
        return find_plan(
            moved(anatomy, matrix), to[:3, :3] @ TARGET + to[:3, 3], bow=bow, resolution=2e-4
        )

    plan, other = planned(np.eye(4)), planned(motion)
    assert other.clearance == pytest.approx(plan.clearance, abs=1e-7)
    for name in ('entry', 'path', 'place'):
        there = getattr(plan, name) @ motion[:3, :3].T + motion[:3, 3]
        # Rounding changes the place of the least clearance by the size of a patch.
        tolerance = 2e-5 if name == 'place' else 1e-7
        assert getattr(other, name) == pytest.approx(there, abs=tolerance), name
    assert other.direction == pytest.approx(plan.direction @ motion[:3, :3].T, abs=1e-9)
    mirrored = plan.guide * ([-1.0, 1.0] if mirror else [1.0, 1.0])
    assert other.guide == pytest.approx(mirrored, abs=1e-6)
    assert plan.structure == other.structure == 'bone'


@pytest.mark.parametrize('axes', [(1, 2, 0), (2, 1, 0), (0, 2, 1)])
@pytest.mark.parametrize('flip', [(0,), (1, 2), (0, 1, 2)])
def test_order_of_the_image_does_not_matter(axes: tuple[int, ...], flip: tuple[int, ...]) -> None:
    """The same patient in another orientation of the image has the same clearance, to h."""
    anatomy = window()
    labels = np.flip(anatomy.labels.transpose(axes), flip)
    index = np.zeros((4, 4))
    index[3, 3] = 1.0
    for new, old in enumerate(axes):
        index[old, new] = -1.0 if new in flip else 1.0
        index[old, 3] = labels.shape[new] - 1 if new in flip else 0.0
    other = replace(anatomy, labels=labels, to_patient=anatomy.to_patient @ index)
    plans = [find_plan(one, TARGET, bow=False) for one in (anatomy, other)]
    assert plans[0].clearance == pytest.approx(plans[1].clearance, abs=RESOLUTION)
    assert plans[0].clearance <= plans[1].straight_bound


def inserted_clearance(anatomy: Anatomy, plan: Plan) -> float:
    """Return the least clearance of the simulated needle of a plan, by the distance to voxels."""
    needle, steering, _ = find_needle(plan.needle)
    one, line = SteeredNeedle(needle, steering, roll=plan.roll), Line(plan.entry, plan.axes)
    spacing = np.linalg.norm(anatomy.to_patient[:3, :3], axis=0)
    to_index = np.linalg.inv(anatomy.to_patient)
    obstacles = [
        (np.argwhere(anatomy.labels == label), item.margin)
        for label, item in anatomy.structures.items()
        if item.role == 'obstacle'
    ]
    least = np.inf

    def check() -> None:
        nonlocal least
        points = np.append(np.arange(0.0, one.depth, 1e-3), one.depth)
        shape = line.points(points, inserted_shape(one, points)[0])
        index = shape @ to_index[:3, :3].T + to_index[:3, 3]
        for voxels, margin in obstacles:
            away = np.maximum(np.abs(index[:, np.newaxis] - voxels) - 0.5, 0.0) * spacing
            distance = float(np.linalg.norm(away, axis=2).min())
            least = min(least, distance - margin - plan.radius)

    for depth, setpoint in zip(plan.depths[1:], plan.guide, strict=True):
        one.move(guide=setpoint.tolist())
        check()
        one.move(depth=float(depth))
        check()
    assert one.tip == pytest.approx([0.0, plan.length, 0.0], abs=1e-4)
    return least


@pytest.mark.parametrize(('shift', 'bevel'), [(0, 0.0), (1, 0.0), (2, 0.0), (1, 0.15)])
def test_plan_keeps_its_clearance_when_inserted(shift: int, bevel: float, tmp_path: Path) -> None:
    """The simulated needle without uncertainty has at least the stated clearance to all voxels."""
    name = 'bending_35mm'
    if bevel:
        file = tmp_path / 'bevel.yaml'
        file.write_text(f'bevel_load: {bevel}\n')
        name = str(file)
    anatomy = window(margin=1.3e-3, shift=shift)
    plan = find_plan(anatomy, TARGET, entry=(0.028, 0.038, 0.117), needle=name)
    assert inserted_clearance(anatomy, plan) >= plan.clearance > 0.0
    assert plan.clearance <= plan.bound
    assert plan.clearances.min() == plan.clearance
    limits = SteeringLimits()
    assert np.abs(plan.guide).max() <= limits.guide_limit + 1e-9
    assert np.abs(np.diff(plan.guide, axis=0)).max() <= limits.guide_step + 1e-9


def test_bow_finds_a_path_where_a_straight_needle_has_none() -> None:
    """And never gives less clearance than a straight needle."""

    def planned(shift: int, margin: float, bow: bool) -> float:
        anatomy = window(margin, shift)
        try:
            plan = find_plan(anatomy, TARGET, entry=(0.028, 0.038, 0.117), bow=bow)
        except NoPathError:
            return -np.inf
        assert plan.clearance <= plan.bound + 1e-9
        assert plan.straight_bound <= plan.bound + 1e-9
        return plan.clearance

    gains = []
    for shift, margin in ((0, 1.5e-3), (2, 1.3e-3), (2, 1e-3), (4, 1e-3)):
        straight, bowed = planned(shift, margin, False), planned(shift, margin, True)
        assert bowed >= straight
        gains.append((straight > 0.0, bowed > 0.0))
    assert gains == [(True, True), (False, True), (True, True), (False, False)]


def test_wider_margin_gives_less_clearance() -> None:
    """The bound decreases by the margin; plans are the best ones to the resolution."""
    plans = [find_plan(window(margin), TARGET, bow=False) for margin in (0.0, 1e-3, 1.8e-3)]
    for narrow, wide in pairwise(plans):
        assert wide.clearance <= narrow.straight_bound
        assert wide.straight_bound < narrow.straight_bound


def test_plans_are_deterministic() -> None:
    one, other = (find_plan(window(shift=2), TARGET) for _ in range(2))
    for item in fields(Plan):
        assert np.array_equal(getattr(one, item.name), getattr(other, item.name)), item.name


def test_far_side_of_a_thick_entry_region_counts() -> None:
    """The needle enters a region of several layers of voxels at its surface."""
    anatomy = window()
    labels = anatomy.labels.copy()
    labels[:, :, 52:59] = ENTRY
    thick = voxel_region(replace(anatomy, labels=labels), [ENTRY], TARGET)
    assert thick is not None
    outside = thick.centers[:, 2] > 0.1159
    # Lines towards the sides leave the region at its rim.
    rim = np.isin(thick.centers[:, :2], [0.0, 0.078]).any(axis=1)
    assert (outside | rim).all()
    assert outside.sum() == 1600


@pytest.mark.parametrize('axis', [0, 1, 2])
def test_needle_does_not_enter_through_a_cut_face(axis: int) -> None:
    """
    A layer that ends at a side of the image is entered from above only, in any orientation.

    The target is low and far from the side, so that lines through the side leave the layer there.
    """
    labels = np.zeros((30, 30, 20), dtype=np.int16)
    labels[:, :, 16:19] = ENTRY
    target = np.array([2.0, 15.0, 14.0])
    order = np.roll([0, 1, 2], axis)
    anatomy = replace(window(), labels=labels.transpose(order), to_patient=affine([2e-3] * 3))
    region = voxel_region(anatomy, [ENTRY], 2e-3 * target[order])
    assert region is not None
    index = np.round(region.centers / 2e-3).astype(int)[:, np.argsort(order)]
    away = np.abs(index - target)
    # The line leaves the image through its nearest side: the layer continues beyond it.
    sides = np.isin(index[:, :2], [0, 29]) & (away[:, :2] >= 2.0 * away[:, 2:])
    assert not sides.any()
    # Above the target the layer counts as before.
    assert ((index[:, 2] == 18) & (away[:, :2] < 4.0).all(axis=1)).sum() == 6 * 7


@pytest.mark.parametrize('shape', [(20, 20, 3), (1, 1, 1), (7, 30, 2)])
def test_region_at_the_skin_of_a_cropped_image_counts(shape: tuple[int, int, int]) -> None:
    """An image may end at the skin: a layer in the plane of a face is entered through the face."""
    labels = np.zeros((30, 30, 20), dtype=np.int16)
    labels[: shape[0], : shape[1], 20 - shape[2] :] = ENTRY
    region = voxel_region(
        replace(window(), labels=labels, to_patient=affine([2e-3] * 3)),
        [ENTRY],
        np.array([0.03, 0.03, 0.0]),
    )
    assert region is not None
    assert np.isclose(region.centers[:, 2], 0.038).sum() == shape[0] * shape[1]


def test_region_that_only_a_cut_face_ends_has_no_entry() -> None:
    """A tube of entry voxels from the target to the border of the image has no outer end."""
    labels = np.zeros((30, 30, 20), dtype=np.int16)
    labels[15, 15, 5:] = ENTRY
    anatomy = replace(window(), labels=labels, to_patient=affine([2e-3] * 3))
    with pytest.raises(ParameterError, match='only a face of the image ends the entry region'):
        find_plan(anatomy, (0.03, 0.03, 0.002), bow=False)


def test_disc_covers_its_radius() -> None:
    """Squares around the point, perpendicular to the line to the target."""
    point = np.array([0.01, 0.02, 0.1])
    region = disc_region(point, 0.005, np.array([0.03, 0.0, 0.0]))
    away = region.centers - point
    assert away @ (np.array([0.03, 0.0, 0.0]) - point) == pytest.approx(0.0, abs=1e-12)
    edge = 2.0 * np.linalg.norm(region.halves, axis=1).max()
    area = len(away) * edge**2
    # Squares of 0.9 mm on a circle of 5 mm.
    assert area == pytest.approx(np.pi * 0.005**2, rel=0.05)
    assert len(disc_region(point, 0.0, TARGET).centers) == 1


def test_needle_that_is_long_enough_is_used() -> None:
    """Entry points beyond the length of the needle are left out."""
    anatomy, limit = window(), 0.16
    target = np.array([0.0, 0.0, 0.006])
    labels = np.zeros_like(anatomy.labels)
    labels[:, :, 58] = ENTRY
    free = replace(anatomy, labels=labels)
    plan = find_plan(free, target, bow=False)
    assert plan.length <= limit
    far = replace(free, to_patient=affine([2e-3, 2e-3, 3e-3]))
    with pytest.raises(ParameterError, match='too short: the nearest entry point is 168'):
        find_plan(far, target)


def cases() -> dict[str, tuple[dict[str, Any], str]]:
    return {
        'target outside': ({'target': (0.5, 0.0, 0.0)}, 'is outside the image'),
        'target in bone': ({'target': (0.0, 0.0, 0.048)}, 'the target is in bone'),
        'no number': ({'target': (np.nan, 0.0, 0.0)}, 'target must be finite, got nan'),
        'unknown entry': ({'entry': 'air'}, "entry must be one of bone, skin, got 'air'"),
        'entry at the target': ({'entry': TARGET}, 'further from the target'),
        'disc': ({'entry': (0.0, 0.0, 0.1), 'entry_radius': -1.0}, 'entry_radius must be finite'),
        'resolution': ({'resolution': 0.0}, 'resolution must be finite, >= 0.0001 m, got 0.0'),
        'skin': ({'skin_limit': np.nan}, 'skin_limit must be >= 0 m, got nan'),
        'needle': ({'needle': 'none'}, "needle must be one of .* got 'none'"),
    }  # fmt: skip


@pytest.mark.parametrize('case', cases())
def test_invalid_request_is_rejected_by_a_line(case: str) -> None:
    changes, message = cases()[case]
    with pytest.raises(NeedleError, match=message) as error:
        find_plan(window(), **{'target': TARGET, **changes})
    assert len(str(error.value).splitlines()) == 1


def test_entry_behind_bone_has_no_path() -> None:
    """Also not with a bow, which cannot leave thick bone."""
    anatomy = window()
    labels = anatomy.labels.copy()
    labels[:, :, 30:50] = 1
    with pytest.raises(NoPathError) as error:
        find_plan(replace(anatomy, labels=labels), TARGET)
    text = str(error.value)
    assert text.startswith('no straight path to a resolution of 0.5 mm: the best line is')
    assert 'too near to bone' in text
    assert 'no path with a bow either, with slopes up to 0.1' in text
    assert error.value.bound <= RESOLUTION
    # Beside thin bone a needle may pass with a bow: the result has no proof.
    with pytest.raises(NoPathError, match='it is not excluded') as error:
        find_plan(window(shift=4), TARGET, entry=(0.028, 0.038, 0.117))
    assert error.value.bound > RESOLUTION


@pytest.mark.parametrize('resolution', [0.01, 0.05])
def test_coarse_resolution_is_named(resolution: float) -> None:
    """A line that is free, but not by the resolution, has no other reason."""
    with pytest.raises(NoPathError) as error:
        find_plan(window(0.0), TARGET, bow=False, resolution=resolution)
    text = str(error.value)
    assert text.startswith(f'no straight path to a resolution of {1e3 * resolution:g} mm')
    assert 'use a finer --resolution: a straight path with a clearance up to ' in text
    assert 'bevel' not in text


def test_all_corners_of_an_oblique_image_are_stated() -> None:
    """With digits for an image of 4.5 mm x 4.5 mm x 9 mm."""
    turn = Rotation.from_euler('z', 45.0, degrees=True).as_matrix()
    labels = np.ones((3, 3, 6), dtype=np.int16)
    image = Anatomy(
        labels=labels, to_patient=affine([1.5e-3] * 3, turn),
        structures={1: Structure(name='skin', role='entry')},
    )  # fmt: skip
    with pytest.raises(ParameterError) as error:
        find_plan(image, (0.0, 0.02, 0.0))
    # The diagonal is 6.364 mm; the corner of the first voxel is at -1.061 mm.
    assert str(error.value).endswith('within -3.18 to 3.18, -1.06 to 5.30, -0.75 to 8.25 mm')


def test_entry_region_must_have_voxels() -> None:
    anatomy = window()
    labels = np.where(anatomy.labels == ENTRY, 0, anatomy.labels)
    with pytest.raises(ParameterError, match='no voxel belongs to the entry region'):
        find_plan(replace(anatomy, labels=labels), TARGET)


def test_images_with_other_grids_are_all_respected() -> None:
    """A second image with the same obstacle as the first leaves the plan; a wall excludes it."""
    anatomy = window()
    second = replace(
        anatomy, structures={1: anatomy.structures[1]}, to_patient=anatomy.to_patient.copy()
    )
    plans = [find_plan(one, TARGET, bow=False) for one in (anatomy, [anatomy, second])]
    assert plans[0].clearance == plans[1].clearance
    wall = replace(second, labels=np.where(np.indices((40, 40, 60))[2] == 30, 1, 0))
    with pytest.raises(NoPathError):
        find_plan([anatomy, wall], TARGET, bow=False)


@pytest.mark.parametrize('shift', [0, 2])
def test_free_space_is_free_to_its_edge(shift: int) -> None:
    """In every direction: clear before the edge, and not clear just beyond it, by brute force."""
    anatomy = window(1.3e-3, shift)
    plan = find_plan(anatomy, TARGET, entry=(0.028, 0.038, 0.117))
    clearance = Clearance(
        [anatomy], np.vstack([plan.entry, plan.path]), radius=plan.radius, beyond=0.02
    )
    depths, free, path, axes = plan.free[:, 0], plan.free[:, 1:], plan.tip_path, plan.axes
    assert depths[0] < 2e-3 < plan.length - 2e-3 < depths[-1] < plan.length
    assert free.min() >= plan.clearance - 1e-4
    # Samples of each place, 0.1 mm apart, on the path.
    along = depths[:, np.newaxis] + np.linspace(-9.5e-4, 9.5e-4, 20)
    middle = [np.interp(along, path.depths, one) for one in path.tips.T]

    def clearances(distance: FloatArray) -> FloatArray:
        """Return the least clearance of each place in each direction at a distance (m, 16)."""
        x = middle[0][..., np.newaxis] + (distance * UNITS[:, 0])[:, np.newaxis]
        z = middle[1][..., np.newaxis] + (distance * UNITS[:, 1])[:, np.newaxis]
        points = np.stack([x, np.broadcast_to(along[..., np.newaxis], x.shape), z], axis=-1)
        found = clearance.at(plan.entry + points.reshape(-1, 3) @ axes)
        return np.asarray(found.reshape(x.shape).min(axis=1))

    for part in (0.2, 0.5, 0.8, 0.99):
        assert (clearances(part * free) >= 0.0).all()
    # One sample limits the distance, to 10 um and the rounding of its depth.
    assert clearances(free)[free < 0.01].max() < 2e-5


def test_synthetic_liver_has_a_plan() -> None:
    """A trunk of 128 x 128 x 50 voxels with vessels, ribs and bowel."""
    anatomy = liver((128, 128, 50))
    plan = find_plan(anatomy, (0.05, 0.02, -0.01), resolution=1e-3)
    assert plan.clearance > 0.0
    assert inserted_clearance(anatomy, plan) >= plan.clearance
    assert anatomy.structures[SKIN].name == 'skin'


@given(text=st.text(), bound=st.floats(allow_nan=False))
def test_error_without_a_path_crosses_processes(text: str, bound: float) -> None:
    error = pickle.loads(pickle.dumps(NoPathError(text, bound)))  # noqa: S301
    assert (str(error), error.bound) == (str(NoPathError(text, bound)), bound)
