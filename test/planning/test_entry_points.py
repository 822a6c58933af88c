# SPDX-License-Identifier: Apache-2.0
"""Entry points are at the skin, or a line says how much tissue is outside of them."""

from __future__ import annotations

from dataclasses import replace

from needle_planning import find_plan
from needle_planning.anatomy import Anatomy, covered, plan_warnings, Structure
from needle_planning.search import voxel_region
from needle_ros.errors import ParameterError
import numpy as np
import pytest
from support.anatomies import affine

BODY, VEIN, TUMOR, PATCH = 1, 2, 3, 4
TARGET = np.array([0.03, 0.03, 0.02])


def body(below: int = 0, thick: int = 3) -> Anatomy:
    """Return a body of voxels of 1 mm to z = 59.5 mm, and a patch so many voxels below its top."""
    labels = np.zeros((60, 60, 70), dtype=np.int16)
    labels[:, :, :60] = BODY
    labels[40:44, :, 30:34] = VEIN
    labels[29:32, 29:32, 19:22] = TUMOR
    labels[10:30, 10:30, 60 - below - thick : 60 - below] = PATCH
    return Anatomy(
        labels=labels,
        to_patient=affine([1e-3] * 3),
        structures={
            BODY: Structure(name='body', role='tissue'),
            VEIN: Structure(name='vein', role='obstacle', margin=1e-3),
            TUMOR: Structure(name='tumor', role='target'),
            PATCH: Structure(name='patch', role='entry'),
        },
    )


def warnings_of(anatomy: Anatomy) -> list[str]:
    plan = find_plan(anatomy, TARGET, bow=False, resolution=1e-3)
    return plan_warnings([anatomy], TARGET, plan.entry, plan.direction)


@pytest.mark.parametrize('thick', [1, 3, 6])
def test_thick_patch_in_the_skin_is_entered_at_the_skin(thick: int) -> None:
    """Its sides in the tissue are no entry, and the part at the skin is complete."""
    anatomy = body(thick=thick)
    region = voxel_region(anatomy, [PATCH], TARGET)
    assert region is not None
    np.testing.assert_allclose(region.centers[:, 2], 0.059)
    assert len(region.centers) == 20 * 20
    assert warnings_of(anatomy) == []


def test_patch_under_the_skin_is_entered_with_a_warning() -> None:
    """Of a patch that nowhere borders on empty voxels, all sides count as before."""
    anatomy = body(below=5)
    region = voxel_region(anatomy, [PATCH], TARGET)
    outside = voxel_region(
        replace(anatomy, labels=np.where(anatomy.labels == PATCH, PATCH, 0)), [PATCH], TARGET
    )
    assert region is not None
    assert outside is not None
    np.testing.assert_array_equal(region.centers, outside.centers)
    (line,) = warnings_of(anatomy)
    assert line.startswith('the needle passes through ')
    assert 'body for ' in line


@pytest.mark.parametrize('depth', [0.004, 0.02])
def test_tissue_outside_of_an_entry_point_is_measured(depth: float) -> None:
    direction = np.array([0.6, 0.0, -0.8])
    line = covered([body()], np.array([0.035, 0.05, 0.0595 - depth]), direction)
    length = float(line.removesuffix(' mm outside of the entry point').rpartition(' ')[2])
    assert length == pytest.approx(1e3 * depth / 0.8, abs=0.11)
    assert line.startswith('the needle passes through body for ')


def test_entry_point_within_the_size_of_the_voxels_is_at_the_skin() -> None:
    for depth in (-0.01, 0.0, 0.001):
        entry = np.array([0.05, 0.05, 0.0595 - depth])
        assert covered([body()], entry, np.array([0.0, 0.0, -1.0])) == ''


def test_obstacle_outside_of_an_entry_point_is_named() -> None:
    """Clearance is of the needle from its entry point on: the line is the only hint."""
    entry = np.array([0.042, 0.03, 0.025])
    line = covered([body()], entry, np.array([0.0, 0.0, -1.0]))
    assert line.startswith('the needle passes through body and vein for 34.5 mm')


@pytest.mark.parametrize(('name', 'role'), [('tumor', 'target'), ('vein', 'obstacle')])
def test_target_and_obstacle_are_no_entry(name: str, role: str) -> None:
    with pytest.raises(ParameterError, match=f'entry: {name} has the role {role}: no needle'):
        find_plan(body(), TARGET, entry=name)


DOWN = np.array([0.0, 0.0, -1.0])


@pytest.mark.parametrize('away', [0.003, 0.05, 0.4])
@pytest.mark.parametrize('slope', [0.0, 0.5])
def test_entry_point_outside_of_the_patient_has_its_distance(away: float, slope: float) -> None:
    """Also outside of the image, which ends 10 mm above the body."""
    direction = np.array([slope, 0.0, -1.0]) / np.hypot(1.0, slope)
    entry = np.array([0.03, 0.03, 0.0595]) + away / direction[2] * direction
    lines = plan_warnings([body()], TARGET, entry, direction)
    (line,) = [one for one in lines if 'in no structure for' in one]
    stated = float(line.partition(' for ')[2].partition(' mm')[0])
    assert stated == pytest.approx(1e3 * away * np.hypot(1.0, slope), abs=0.11)
    assert line.endswith('after the entry point, which may be outside of the patient')


def test_entry_point_of_images_without_tissue_is_not_examined() -> None:
    """Only obstacles and a target do not state where the patient begins."""
    anatomy = body()
    obstacles = {label: anatomy.structures[label] for label in (VEIN, TUMOR)}
    entry = np.array([0.03, 0.03, 0.05])
    found = plan_warnings([replace(anatomy, structures=obstacles)], TARGET, entry, DOWN)
    assert found == []


@pytest.mark.parametrize('low', [25, 40, 59])
def test_needle_outside_of_an_image_with_obstacles_has_its_length(low: int) -> None:
    """A closed surface has no further obstacles, and an image without obstacles says nothing."""
    anatomy, entry = body(), np.array([0.03, 0.03, 0.0595])
    part = replace(
        anatomy,
        labels=anatomy.labels[:, :, low:],
        to_patient=affine([1e-3] * 3, origin=[0.0, 0.0, 1e-3 * low]),
        structures={VEIN: anatomy.structures[VEIN]},
    )
    lines = plan_warnings([anatomy, part], TARGET, entry, DOWN)
    (line,) = [one for one in lines if 'image with vein' in one]
    # The lower face of the image is half a voxel below the center of its first voxel.
    assert float(line.partition(' mm')[0]) == pytest.approx(low - 0.5 - 20.0, abs=0.11)
    for other in (
        replace(part, closed=True),
        replace(part, structures={VEIN: Structure(name='vein', role='tissue')}),
    ):
        assert plan_warnings([anatomy, other], TARGET, entry, DOWN) == []


@pytest.mark.parametrize('axis', [0, 1, 2])
@pytest.mark.parametrize('shift', [0.2, 3.0, -3.0])
def test_image_away_from_the_plan_is_rejected(axis: int, shift: float) -> None:
    """It would be used without any effect; a shift that keeps it near the plan is accepted."""
    anatomy = body()
    for part, refused in ((1.0, True), (0.02 / abs(shift), False)):
        moved = anatomy.to_patient.copy()
        moved[axis, 3] += part * shift
        second = replace(anatomy, to_patient=moved, structures={VEIN: anatomy.structures[VEIN]})
        if refused:
            with pytest.raises(ParameterError, match='the image with vein is away from the entry'):
                find_plan([anatomy, second], TARGET, bow=False)
        else:
            find_plan([anatomy, second], TARGET, bow=False)


def test_target_in_m_that_would_be_inside_in_mm_has_a_hint() -> None:
    with pytest.raises(ParameterError, match=r'numbers without a unit are m: 30mm,30mm,20mm$'):
        find_plan(body(), 1e3 * TARGET)
    with pytest.raises(ParameterError, match='is outside the image') as error:
        find_plan(body(), 1e4 * TARGET)
    assert 'unit' not in str(error.value)
    # It is in m, although 0.4 mm would be inside.
    with pytest.raises(ParameterError, match='is outside the image') as error:
        find_plan(body(), (0.4, 0.03, 0.02))
    assert 'unit' not in str(error.value)
