# SPDX-License-Identifier: Apache-2.0
"""Layers of tissue along a plan: from labels to the needle, the plan and its insertions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_controller.steering.insertion_plan import in_layers, MOST_LAYERS, read_plan, write_plan
from needle_dynamics import find_needle, SteeredNeedle, SteeringParameters
from needle_planning import Anatomy, chance_of, find_plan, Structure
from needle_planning.layers import tissue_layers
from needle_ros.errors import NeedleError
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

NEEDLE, STEERING, _ = find_needle('bending_35mm')
OWN = NEEDLE.tissue_stiffness
FAT, LIVER = 1, 2
ENTRY, TARGET = np.array([0.03, 0.03, 0.1]), np.array([0.03, 0.03, 0.02])


def body(*, obstacle: bool = True) -> Anatomy:
    """Return 10 mm of fat below a surface at z = 100 mm, 30 mm of liver, and unlabeled tissue."""
    labels = np.zeros((61, 61, 111), dtype=np.int16)
    labels[:, :, 91:101] = FAT
    labels[:, :, 61:91] = LIVER
    structures = {
        FAT: Structure(name='fat', role='entry', stiffness=5e3, spread=0.3),
        LIVER: Structure(name='liver', role='tissue', stiffness=4e4),
    }
    if obstacle:
        labels[0:4, :, 40], structures[3] = 3, Structure(name='bone', role='obstacle', margin=1e-3)
    return Anatomy(
        labels=labels, to_patient=np.diag([1e-3, 1e-3, 1e-3, 1.0]), structures=structures
    )


def test_layers_are_those_of_the_labels() -> None:
    """Borders to 0.1 mm, at half a voxel below the last voxel; also along an oblique line."""
    for target in (TARGET, TARGET + np.array([0.02, -0.01, 0.0])):
        found = tissue_layers([body()], ENTRY, target, NEEDLE)
        longer = float(np.linalg.norm(target - ENTRY)) / 0.08
        borders = longer * np.array([0.0, 9.5e-3, 39.5e-3])
        assert_allclose(found[:, 0], borders, atol=1e-4)
        assert_array_equal(found[:, 1:], [[5e3, 0.3], [4e4, 0.0], [OWN, 0.0]])


def test_labels_without_a_stiffness_are_no_layers() -> None:
    plain = body()
    plain = replace(
        plain,
        structures={k: replace(one, stiffness=np.nan) for k, one in plain.structures.items()},
    )
    assert tissue_layers([plain], ENTRY, TARGET, NEEDLE).shape == (0, 3)
    tissue = in_layers(np.zeros((0, 3)), NEEDLE, STEERING)
    assert tissue.needle is NEEDLE
    assert tissue.steering is STEERING
    assert tissue.prior.layer_spread == ()


@settings(deadline=None, max_examples=50)
@given(st.lists(st.sampled_from([0, 1, 2, 3]), min_size=80, max_size=80))
def test_at_most_eight_layers_with_the_same_mean(labels: list[int]) -> None:
    """Merged layers keep the mean of the logarithm of the stiffness, and their order."""
    values = np.array([OWN, 2e3, 3e4, 9e5])
    anatomy = Anatomy(
        labels=np.array(labels, dtype=np.int16).reshape(1, 1, -1),
        to_patient=np.diag([1e-3, 1e-3, 1e-3, 1.0]),
        structures={
            k: Structure(name=str(k), role='tissue', stiffness=float(values[k]), spread=0.1)
            for k in (1, 2, 3)
        },
    )
    entry, target = np.array([0.0, 0.0, -0.5e-3]), np.array([0.0, 0.0, 79.5e-3])
    found = tissue_layers([anatomy], entry, target, NEEDLE)
    if not any(labels):
        assert len(found) == 0
        return
    assert 1 <= len(found) <= MOST_LAYERS
    sizes = np.diff(np.append(found[:, 0], 0.08))
    assert (sizes > 0.0).all()
    # Rounding of a mean of 800 numbers.
    expected = np.log(values[labels]).mean()
    assert sizes @ np.log(found[:, 1]) / 0.08 == pytest.approx(expected, rel=1e-9)


def test_constants_by_layer_follow_the_depth() -> None:
    needle = replace(NEEDLE, layer_depths=(0.02,), layer_stiffnesses=(3e4,))
    steering = SteeringParameters(bevel_load=(0.1, 0.4), cutting_force=(0.2,))
    layers = np.array([[0.0, 1e4, 0.2], [0.01, 2e4, 0.0], [0.03, 5e4, 0.4]])
    tissue = in_layers(layers, needle, steering)
    assert tissue.needle.tissue.starts == (0.0, 0.01, 0.03)
    assert tissue.needle.tissue.stiffnesses == (1e4, 2e4, 5e4)
    assert tissue.steering.bevel_load == (0.1, 0.1, 0.4)
    assert tissue.steering.cutting_force == (0.2,)
    assert tissue.prior.layer_spread == (0.2, 0.0, 0.4)


def test_bowed_plan_is_for_the_needle_in_layers() -> None:
    """The tip of the needle in layers ends at the target; that of the needle file does not."""
    labels = np.zeros((40, 40, 60), dtype=np.int16)
    labels[:, :, 26:58] = LIVER
    labels[:, :, 44] = labels[:, :, 24] = 3
    labels[12:18, 16:22, 44] = labels[18:23, 18:23, 24] = 0
    labels[:, :, 58] = FAT
    bone = Structure(name='bone', role='obstacle', margin=1.3e-3)
    structures = {**body().structures, 3: bone}
    matrix = np.diag([2e-3, 2e-3, 2e-3, 1.0])
    anatomy = Anatomy(labels=labels, to_patient=matrix, structures=structures)
    target = np.array([0.042, 0.041, 0.006])
    plan = find_plan(anatomy, target, entry=(0.028, 0.038, 0.117))
    assert plan.bow > 5e-4
    assert len(plan.layers) >= 3
    ends = []
    for layers in (plan.layers, np.zeros((0, 3))):
        needle, steering, _ = in_layers(layers, NEEDLE, STEERING)
        one = SteeredNeedle(needle, replace(steering, path_noise=0.0), roll=plan.roll)
        for guide, depth in zip(plan.guide.tolist(), plan.depths[1:].tolist(), strict=True):
            one.move(guide=guide)
            one.move(depth=depth)
        x, _, z = one.tip
        across = plan.axes[[0, 2]].T @ [x, z]
        ends.append(np.linalg.norm(plan.entry + plan.length * plan.direction + across - target))
    # The limit of the planner.
    assert ends[0] <= 1e-4
    assert ends[1] > 1.5e-4
    # No proof for bows in layers: the bound is the clearance at the target.
    assert plan.bound >= plan.clearance


def test_plan_has_the_layers_and_its_insertions_sample_them(tmp_path: Path) -> None:
    """The file has the same layers; only those with a spread are sampled."""
    plan = find_plan(body(), TARGET, entry=ENTRY, entry_radius=0.0, bow=False)
    assert_array_equal(plan.layers[:, 1], [5e3, 4e4, OWN])
    write_plan(plan, tmp_path / 'plan.yaml')
    assert_array_equal(read_plan(tmp_path / 'plan.yaml').layers, plan.layers)
    chance = chance_of(plan, body(), insertions=40, radius=3e-3, workers=1)
    logs = np.log(chance.values['layer_1'])
    # The deviation of a standard deviation from 40 samples is 11 %.
    assert logs.std() == pytest.approx(0.3, rel=0.35)
    assert chance.hit.value > 0.8


@pytest.mark.parametrize(
    ('layers', 'message'),
    [
        ('[[0.001, 1.0, 0.0]]', 'must begin at 0 m'),
        ('[[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]]', 'increasing depths'),
        ('[[0.0, 0.0, 0.0]]', 'a stiffness > 0'),
        ('[[0.0, 1.0]]', r'must have shape \(n, 3\), got \(1, 2\)'),
        ('soft', 'must be real numbers'),
    ],
)
def test_damaged_layers_are_rejected(layers: str, message: str, tmp_path: Path) -> None:
    plan = find_plan(body(), TARGET, entry=ENTRY, entry_radius=0.0, bow=False)
    file = tmp_path / 'plan.yaml'
    write_plan(replace(plan, layers=np.zeros((0, 3))), file)
    file.write_text(file.read_text().replace('layers: []', f'layers: {layers}'))
    with pytest.raises(NeedleError, match=message):
        read_plan(file)
