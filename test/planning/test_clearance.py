# SPDX-License-Identifier: Apache-2.0
"""Clearance: exact distance to boxes, 1-Lipschitz, and bounds of lines."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_dynamics import FloatArray
from needle_planning.anatomy import Anatomy, Structure
from needle_planning.clearance import Clearance
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.anatomies import affine

CAP = 0.03  #: largest clearance that is distinguished [m]
RADIUS = 0.5e-3
MARGINS = {1: 2e-3, 2: 0.0, 7: 0.5e-3}


def random_anatomy(seed: int, margins: dict[int, float] = MARGINS) -> Anatomy:
    """Return random voxels of anisotropic size in a rotated, mirrored or plain frame."""
    rng = np.random.default_rng(seed)
    shape = rng.integers(1, 12, 3)
    labels = rng.choice([0, 0, 0, 0, 0, 0, 3, *margins], shape).astype(np.int16)
    # All orders of memory.
    order = rng.permutation(3)
    labels = np.ascontiguousarray(labels.transpose(order)).transpose(np.argsort(order))
    axes = Rotation.random(random_state=seed).as_matrix() * rng.choice([1.0, -1.0], 3)
    matrix = affine(rng.uniform(0.3e-3, 5e-3, 3), axes, rng.normal(0.0, 0.1, 3))
    structures = {
        label: Structure(name=f'obstacle {label}', role='obstacle', margin=margin)
        for label, margin in margins.items()
    }
    structures[3] = Structure(name='tissue', role='tissue')
    return Anatomy(labels=labels, to_patient=matrix, structures=structures)


def brute_force(anatomy: Anatomy, points: FloatArray, radius: float = RADIUS) -> FloatArray:
    """Return the clearance of points by the distance to every box."""
    matrix = anatomy.to_patient
    spacing = np.linalg.norm(matrix[:3, :3], axis=0)
    index = (points - matrix[:3, 3]) @ matrix[:3, :3] / spacing**2
    found = np.full(len(points), CAP)
    for label, one in anatomy.structures.items():
        voxels = np.argwhere(anatomy.labels == label)
        if one.role != 'obstacle' or not len(voxels):
            continue
        away = np.maximum(np.abs(index[:, np.newaxis] - voxels) - 0.5, 0.0) * spacing
        distance = np.linalg.norm(away, axis=2).min(axis=1)
        found = np.minimum(found, distance - one.margin - radius)
    return found


def points_of(anatomy: Anatomy, seed: int, count: int = 200) -> FloatArray:
    """Return random points inside and around an image [m], shape (count, 3)."""
    rng = np.random.default_rng(seed)
    index = rng.uniform(-4.0, np.array(anatomy.labels.shape) + 3.0, (count, 3))
    return np.asarray(index @ anatomy.to_patient[:3, :3].T + anatomy.to_patient[:3, 3])


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6))
def test_clearance_is_the_distance_to_the_boxes(seed: int) -> None:
    """In its region, for all voxel sizes, rotations, mirrorings and orders of memory."""
    anatomy = random_anatomy(seed)
    points = points_of(anatomy, seed)
    found = Clearance([anatomy], points, radius=RADIUS).at(points)
    # Rounding: coordinates of up to 0.3 m.
    assert found == pytest.approx(brute_force(anatomy, points), abs=1e-14)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6))
def test_clearance_is_1_lipschitz(seed: int) -> None:
    """Also across the border of the region, beyond which it is a lower bound."""
    anatomy = random_anatomy(seed)
    rng = np.random.default_rng(seed)
    a = points_of(anatomy, seed)
    # Steps from micrometers to centimeters.
    b = a + rng.normal(size=a.shape) * 10.0 ** rng.uniform(-6.0, -2.0, (len(a), 1))
    clearance = Clearance([anatomy], a[:20], radius=RADIUS)
    first, second = clearance.at(a), clearance.at(b)
    assert (np.abs(first - second) <= np.linalg.norm(a - b, axis=1) + 1e-14).all()
    assert (first <= brute_force(anatomy, a) + 1e-14).all()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.0, 0.01))
def test_wider_margin_gives_less_clearance(seed: int, more: float) -> None:
    points = points_of(random_anatomy(seed), seed)
    wide = {label: margin + more for label, margin in MARGINS.items()}
    narrow, wider = (
        Clearance([random_anatomy(seed, margins)], points).at(points)
        for margins in (MARGINS, wide)
    )
    assert (wider <= narrow).all()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6))
def test_gradient_is_the_slope_of_the_clearance(seed: int) -> None:
    """Its size is 1 outside the boxes; along it the clearance grows at this rate."""
    anatomy = random_anatomy(seed)
    points = points_of(anatomy, seed)
    clearance = Clearance([anatomy], points, radius=RADIUS, beyond=1e-3)
    values, gradients = clearance.gradient(points)
    assert values == pytest.approx(clearance.at(points), abs=1e-15)
    size = np.linalg.norm(gradients, axis=1)
    assert ((size < 1e-12) | (np.abs(size - 1.0) < 1e-12)).all()
    # Away from places where another box is as near, and from the cap: towards the nearest box
    # the distance to it decreases at the rate 1, and no other can increase it.
    step = 1e-6
    nearer = clearance.at(points - step * gradients)
    sure = (size > 0.5) & (values > -RADIUS + step)
    assert (nearer[sure] <= values[sure] - step * (1.0 - 1e-6)).all()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.floats(1e-5, 5e-3))
def test_bounds_of_lines_hold(seed: int, radius: float) -> None:
    """
    The least value is within the tolerance, and no needle in the radius exceeds the bound.

    A needle starts within the radius, and is deflected from its line by the gain at most.
    """
    anatomy, rng = random_anatomy(seed), np.random.default_rng(seed)
    entries, target = points_of(anatomy, seed, 5), points_of(anatomy, seed + 1, 1)[0]
    bow = rng.uniform(0.0, 3e-3, 5) * rng.choice([0.0, 1.0])
    near = rng.normal(size=(20, *entries.shape))
    near *= radius * rng.uniform(0.0, 1.0, (20, 5, 1)) / np.linalg.norm(near, axis=2)[..., None]
    clearance = Clearance([anatomy], [*entries, target], radius=RADIUS, beyond=0.01)
    tolerance = 1e-4
    found = clearance.lines(
        entries, target, radii=np.full(5, radius), bow=bow, tolerance=tolerance
    )
    s = np.linspace(0.0, 1.0, 501)
    gain = np.interp(s, np.linspace(0.0, 1.0, 5), bow)

    def sampled(starts: FloatArray, deflections: FloatArray) -> FloatArray:
        points = starts[:, np.newaxis] + s[:, np.newaxis] * (target - starts)[:, np.newaxis]
        values = clearance.at((points + deflections).reshape(-1, 3))
        return np.asarray(values.reshape(len(starts), -1))

    least = (sampled(entries, np.zeros(3)) + gain).min(axis=1)
    assert (least >= found.least - tolerance - 1e-12).all()
    # Between two samples the value changes by the slope of the clearance and of the gain at most.
    lengths = np.linalg.norm(target - entries, axis=1) + radius
    apart = 0.5 * (lengths + 4.0 * np.abs(np.diff(bow)).max()) / 500
    assert (least <= found.least + apart + 1e-12).all()
    for shift in near:
        direction = rng.normal(size=3)
        deflections = gain[:, np.newaxis] * direction / np.linalg.norm(direction)
        needles = sampled(entries + shift, deflections).min(axis=1)
        assert (needles <= found.upper + apart + 1e-12).all()


def test_line_ends_early_below_a_bound() -> None:
    """A line through a box ends early, and its bound is not above the given one."""
    labels = np.zeros((5, 5, 5), dtype=np.uint8)
    labels[2, 2, 2] = 1
    anatomy = Anatomy(
        labels=labels,
        to_patient=affine([1e-3] * 3),
        structures={1: Structure(name='bone', role='obstacle')},
    )
    ends = np.array([[2e-3, 2e-3, 4e-3], [-6e-3, 2e-3, 4e-3]]), np.array([2e-3, 2e-3, 0.0])
    clearance = Clearance([anatomy], [*ends[0], ends[1]], radius=RADIUS)
    found = clearance.lines(*ends, enough=0.0)
    assert found.least[0] == -np.inf
    assert found.upper[0] <= 0.0 < found.least[1]
    assert clearance.structure_at(ends[1]) == 'bone'
    assert clearance.structure_at([1.0, 1.0, 1.0]) == ''


def test_several_images_limit_the_clearance() -> None:
    """The least clearance of all images counts, for points, gradients and lines."""
    both = [random_anatomy(1), random_anatomy(2)]
    shifted = both[1].to_patient.copy()
    shifted[:3, 3] = both[0].to_patient[:3, 3]
    both[1] = Anatomy(labels=both[1].labels, to_patient=shifted, structures=both[1].structures)
    points = np.concatenate([points_of(one, 3) for one in both])
    every = Clearance(both, points)
    each = [Clearance([one], points) for one in both]
    assert every.at(points) == pytest.approx(np.min([one.at(points) for one in each], axis=0))
    assert every.gradient(points)[0] == pytest.approx(every.at(points))
    lines = [one.lines(points[:50], points[-1]).least for one in (every, *each)]
    # The tolerance of a line.
    assert lines[0] == pytest.approx(np.min(lines[1:], axis=0), abs=2e-6)


@pytest.mark.parametrize('labels', [[0, 1, 70000], [-40000, 1, 40000]])
def test_labels_of_any_size_are_found(labels: list[int]) -> None:
    """The table of labels is for a small range; other labels are compared one by one."""
    image = np.zeros((6, 5, 4), dtype=np.int32)
    image[1, 2, 3], image[4, 0, 0], image[3, 3, 3] = labels
    structures = {
        label: Structure(name=str(label), role='obstacle', margin=1e-3 * k)
        for k, label in enumerate(labels[1:])
    }
    anatomy = Anatomy(labels=image, to_patient=affine([1e-3] * 3), structures=structures)
    points = points_of(anatomy, 0)
    found = Clearance([anatomy], points).at(points)
    assert found == pytest.approx(brute_force(anatomy, points, 0.0), abs=1e-14)


def test_anatomy_without_obstacles_is_free() -> None:
    anatomy = Anatomy(
        labels=np.ones((3, 3, 3), dtype=np.int16),
        to_patient=affine([1e-3] * 3),
        structures={1: Structure(name='liver', role='tissue')},
    )
    clearance = Clearance([anatomy], [[0.0, 0.0, 0.0]], beyond=0.01)
    assert clearance.at([[1e-3, 0.0, 0.0]]) == pytest.approx(CAP)
    assert clearance.lines([[0.0, 0.0, 5e-3]], [0.0, 0.0, 0.0]).least == pytest.approx(CAP)
