# SPDX-License-Identifier: Apache-2.0
"""The needle that cuts its path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf, nan, pi
from typing import Any

from benchmarks.steering_model import HermiteNeedle
from hypothesis import given
from hypothesis import strategies as some
from needle_dynamics import (
    insert_batch,
    NeedleModel,
    NeedleParameters,
    NEEDLES,
    ParameterError,
    ShapeError,
    SteeredNeedle,
    SteeringParameters,
)
from needle_dynamics.steering.needle import NeedleShape
from needle_dynamics.steering.parameters import tissue_of
import numpy as np
from numpy.testing import assert_allclose
import pytest

#: The paper's needle; its bending stiffness [N m^2].
PAPER = NeedleParameters.preset('phantom')
EI = PAPER.bending_stiffness


def needle_in(tissue: float, layers: Sequence[tuple[float, float]] = ()) -> NeedleParameters:
    """Return a long needle in tissue, with layers that begin at depths."""
    return replace(
        PAPER,
        length=0.6,
        tissue_stiffness=tissue,
        layer_depths=tuple(depth for depth, _ in layers),
        layer_stiffnesses=tuple(stiffness for _, stiffness in layers),
    )


def inserted(
    tissue: float,
    depth: float,
    layers: Sequence[tuple[float, float]] = (),
    *,
    start: dict[str, Any] | None = None,
    **steering: Any,
) -> SteeredNeedle:
    """Return a needle that was inserted with a fixed guide."""
    one = SteeredNeedle(needle_in(tissue, layers), SteeringParameters(**steering), **(start or {}))
    one.move(depth=depth)
    return one


@pytest.mark.parametrize('part', [1, 2, 4])
def test_long_needle_cuts_an_arc(part: int) -> None:
    """Its curvature is F lambda / (E I), for any elements: parabolas represent an arc."""
    length, load = 0.03, 0.2
    one = inserted(
        tissue_of(EI, length), 0.5, element=length / part, bevel_load=(load,), free_length=0.02
    )
    end = one.path.depths >= 0.4
    bend = 2.0 * np.polyfit(one.path.depths[end], one.path.deflections[end, 1], 2)[0]
    # 13 bending lengths: the initial transient decays to exp(-13).
    assert bend == pytest.approx(load * length / EI, rel=1e-5)


@given(some.floats(-0.05, 0.05), some.floats(0.005, 0.15), some.floats(0.0, 1e5))
def test_straight_oblique_insertion_needs_no_force(
    tilt: float, depth: float, tissue: float
) -> None:
    one = inserted(tissue, depth, start={'tilt': (0.0, tilt)}, skin_stiffness=300.0)
    line = tilt * (0.02 + one.shape.depths)
    assert_allclose(one.shape.deflections[:, 1], line, atol=1e-15)
    assert_allclose(one.path.deflections[:, 1], tilt * (0.02 + one.path.depths), atol=1e-15)
    # Rounding of deflections, times the stiffness of the free length, 3 E I / L0^3.
    assert_allclose(one.guide_load, 0.0, atol=1e-10)


def test_guide_response_changes_its_sign_with_depth() -> None:
    """Static shift of the tip per shift of the guide, by tissue and depth."""
    found = {
        tissue: [inserted(tissue, depth).authority[0, 0] for depth in np.arange(1, 6) * 0.02]
        for tissue in (520.0, 5e3, 2e4, 1e5)
    }
    expected = {
        520.0: [0.99, 0.97, 0.90, 0.78, 0.61],
        5e3: [0.95, 0.75, 0.41, 0.08, -0.13],
        2e4: [0.82, 0.34, -0.06, -0.24, -0.26],
        1e5: [0.40, -0.15, -0.26, -0.18, -0.08],
    }
    for tissue, row in found.items():
        # The reference values have two digits.
        assert_allclose(row, expected[tissue], atol=0.01)


def test_guide_shift_before_cutting_steers_more_than_at_rest() -> None:
    tissue = tissue_of(EI, 0.035)
    found = []
    for depth in (0.01, 0.015, 0.03, 0.05, 0.07, 0.09):
        one = inserted(tissue, depth, free_length=0.04)
        one.move(guide=(0.0, 1e-3))
        one.move(depth=0.1)
        found.append(1e3 * one.tip[2])
    # The reference values are from another path in elements of 1.25 mm; two have one digit.
    assert_allclose(found, [-0.9, -1.3, -1.5, -0.94, -0.41, -0.13], atol=0.05)


def way(one: SteeredNeedle, scale: float = 1.0, steps: int = 40) -> np.ndarray:
    """Insert with moves of guide, tilt and roll; return the tips."""
    tips = []
    for depth in np.linspace(0.0, 0.1, steps + 1)[1:]:
        one.move(
            depth=depth,
            guide=scale * np.array([2e-3, -3e-3]) * np.sin(50.0 * depth),
            tilt=scale * np.array([0.02, 0.01]) * depth / 0.1,
            roll=20.0 * depth,
        )
        tips.append(one.tip)
    return np.array(tips)


def steered(load: float, **more: Any) -> SteeredNeedle:
    return SteeredNeedle(
        needle_in(2e4, [(0.04, 6e4)]),
        SteeringParameters(bevel_load=(load, 2.0 * load), skin_stiffness=500.0, **more),
    )


def test_motion_is_linear_in_guide_and_load() -> None:
    both, guide, load = (way(steered(f), s) for f, s in ((0.3, 2.0), (0.0, 2.0), (0.3, 0.0)))
    # The path restarts only at a jump of the load: an error of the order of an element's.
    assert_allclose(both[:, [0, 2]], (guide + load)[:, [0, 2]], atol=1e-7)


def test_motion_is_invariant_to_rotation_about_y() -> None:
    """Rotate all inputs by a right angle about y; the tips rotate with them."""
    one = steered(0.3)
    first = []
    for depth in np.linspace(0.0, 0.1, 41)[1:]:
        one.move(depth=depth, guide=(1e-3, 2e-3), tilt=(0.01, 0.0), roll=20.0 * depth)
        first.append(one.tip)
    other = SteeredNeedle(one.needle, one.steering, roll=pi / 2)
    second = []
    for depth in np.linspace(0.0, 0.1, 41)[1:]:
        # Right-handed about y: z becomes x, and x becomes -z.
        other.move(depth=depth, guide=(2e-3, -1e-3), tilt=(0.0, -0.01), roll=20.0 * depth + pi / 2)
        second.append(other.tip)
    x, _, z = np.array(first).T
    assert_allclose(np.array(second)[:, 0], z, atol=1e-15)
    assert_allclose(np.array(second)[:, 2], -x, atol=1e-15)


def test_bevel_load_decays_gradually_during_retraction() -> None:
    """Over a millimeter, in proportion; a retraction by nanometers causes no jump."""
    one = SteeredNeedle(PAPER, SteeringParameters(bevel_load=(0.5,)))
    one.move(depth=0.05)
    tip, load = one.tip, one.load
    one.move(depth=0.05 - 1e-9)
    assert_allclose(one.load, load, rtol=2e-6)
    assert_allclose(one.tip[[0, 2]], tip[[0, 2]], atol=1e-8)
    for part in (0.25, 0.5, 1.0, 3.0):
        one.move(depth=0.05 - 1e-3 * part)
        assert_allclose(one.load, max(0.0, 1.0 - part) * load, atol=1e-12)
    one.move(depth=0.05)
    assert_allclose(one.tip, tip, atol=1e-15)


def test_reinsertion_follows_the_path() -> None:
    one = steered(0.3)
    way(one)
    end, path = one.shape, one.path
    shapes: dict[float, list[NeedleShape]] = {}
    for depth in (0.0732, 0.01, 0.0, 0.01, 0.0732):
        one.move(depth=depth)
        assert (one.load == 0.0).all()
        shapes.setdefault(depth, []).append(one.shape)
    for first, *again in shapes.values():
        for other in again:
            assert_allclose(other.deflections, first.deflections, rtol=0.0, atol=0.0)
    one.move(depth=0.1)
    # The tip was solved with the path when it cut, and now on a fixed path.
    assert_allclose(one.shape.deflections, end.deflections, rtol=0.0, atol=1e-17)
    assert_allclose(one.path.deflections, path.deflections, rtol=0.0, atol=0.0)


def test_forces_balance() -> None:
    """The forces of tissue, skin and bevel on the needle balance the force on the guide."""
    one = SteeredNeedle(
        needle_in(2e4, [(0.04, 6e4)]),
        SteeringParameters(bevel_load=(0.3,), skin_stiffness=500.0, element=0.1e-3),
    )
    way(one)
    shape, path = one.shape, one.path
    inside = shape.depths >= 0.0
    y, w = shape.depths[inside], shape.deflections[inside]
    away = np.array([np.interp(y, path.depths, p) for p in path.deflections.T]).T - w
    middle, width = 0.5 * (y[1:] + y[:-1]), np.diff(y)
    pulls = 0.5 * (away[1:] + away[:-1]) * np.where(middle < 0.04, 2e4, 6e4)[:, np.newaxis]
    skin = 500.0 * away[0]
    force = width @ pulls + one.load + skin
    moment = (width * (middle + 0.02)) @ pulls + one.load * 0.12 + skin * 0.02
    # Trapezoids of 0.1 mm with a bending length of 36 mm: (h / lambda)^2 of the canceling terms.
    assert_allclose(one.guide_load[0], force, rtol=1e-5)
    assert_allclose(one.guide_load[1], moment, rtol=1e-5)


def tip_with(element: float, steps: int, **more: Any) -> np.ndarray:
    return np.asarray(way(steered(0.3, element=element, **more), steps=steps)[-1])


def test_error_is_of_third_order_in_the_element_length() -> None:
    """With bevel, layers, skin, guide and roll."""
    # Enough steps for a guide motion that is smooth relative to the error of the elements.
    fine = tip_with(0.125e-3, 6400)
    errors = [np.abs(tip_with(h, 6400) - fine).max() for h in (4e-3, 2e-3, 1e-3)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders > 2.7).all()
    # 1e-5 um: far below the resolution of any sensor.
    assert errors[-1] < 1e-7


def test_path_is_independent_of_insertion_steps() -> None:
    """Whole elements at once, or a hundredth of an element."""
    depth = 0.0777
    ends = []
    for steps in (1, 7, 100, 10_000):
        one = SteeredNeedle(
            needle_in(2e4), SteeringParameters(bevel_load=(0.3,)), tilt=(0.0, 0.01)
        )
        for part in np.arange(1, steps + 1) / steps:
            one.move(depth=part * depth, guide=(0.0, 2e-3 * part), roll=2.0 * part)
        ends.append(one.tip)
    # Rounding, over ten thousand steps.
    for end in ends[1:]:
        assert_allclose(end, ends[0], atol=1e-13)


@pytest.mark.parametrize('skin', [0.0, 800.0])
def test_agrees_with_finite_elements_solved_by_scipy(skin: float) -> None:
    """Another beam element, another path between nodes, another solver."""
    parameters = needle_in(2e4, [(0.05, 6e4)])
    errors = []
    for h in (1e-3, 0.5e-3):
        steering = SteeringParameters(skin_stiffness=skin, bevel_load=(0.1,), element=h)
        one = SteeredNeedle(parameters, steering, tilt=(0.0, 0.02))
        # The tilt, and the bevel's load on the free length.
        steps, entry = round(0.1 / h), [0.0, 4e-4 + 0.1 * 0.02**3 / (3.0 * EI)]
        other = HermiteNeedle(parameters, 0.02, skin, h, steps, entry)
        for k in range(1, steps + 1):
            guide = 3e-3 * np.sin(60.0 * k * h)
            one.move(depth=k * h, guide=(0.0, guide))
            shape = other.advance([0.0, guide], [0.0, 0.02], [0.0, 0.1])
        errors.append(abs(one.tip[2] - shape[-1, 0, 1]))
        # Without a load, a plane is straight.
        assert not shape[:, :, 0].any()
    # Straight path segments are of first order; both converge to the same tip.
    assert errors[1] < 0.6 * errors[0] < 1e-5


@pytest.mark.parametrize('tissue', [520.0, 5e3])
def test_agrees_with_the_static_limit_of_the_paper(tissue: float) -> None:
    """For a path along the axis, clamped at the entry: the paper's modes converge to it."""
    depth, off = 0.2, []
    exact = inserted(tissue, depth, free_length=0.0).compliance[0, 0]
    for modes in (1, 2, 4, 8):
        parameters = replace(PAPER, tissue_stiffness=tissue, modes=modes, minimum_depth=0.15)
        model = NeedleModel(parameters)
        tip = model.modes.values(depth)
        found = tip @ np.linalg.solve(model.stiffness_matrix(depth, 0.0), tip)
        off.append(abs(found / exact - 1.0))
    # Modes have no shear at the tip: the sum converges with the third power of their number.
    orders = np.log2(np.array(off[:-1]) / off[1:])
    assert (orders[1:] > 2.7).all()
    assert off[-1] < 2e-3


def test_tip_roll_lags_base_roll() -> None:
    """Friction holds the tip until the windup is complete, and twice that after a reversal."""
    one = SteeredNeedle(
        needle_in(2e4), SteeringParameters(torsional_friction=0.1, torsional_stiffness=0.02)
    )
    one.move(depth=0.1)
    windup = 0.1 * 0.1 / 0.02 * (0.6 - 0.05)
    rolls = [0.5 * windup, windup, 2.0 * windup, 1.5 * windup, 0.0, -windup]
    tips = []
    for roll in rolls:
        one.move(roll=roll)
        tips.append(one.tip_roll)
    expected = np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.0]) * windup
    assert_allclose(tips, expected, atol=1e-15)


def test_without_friction_the_tip_rolls_with_the_base() -> None:
    one = SteeredNeedle(needle_in(2e4), SteeringParameters(bevel_load=(0.2,)))
    one.move(depth=0.05, roll=1.2)
    assert one.tip_roll == one.roll == 1.2
    assert_allclose(one.load, 0.2 * np.array([np.sin(1.2), np.cos(1.2)]), rtol=1e-15)


def test_common_motion_of_tissue_and_guide_has_no_effect() -> None:
    one = steered(0.3)
    way(one)
    tip, felt = one.tip, one.guide_load
    guide = 1e-3 * np.array([2.0, -3.0]) * np.sin(50.0 * 0.1)
    one.move(tissue=(4e-3, 0.0, -5e-3), guide=guide + np.array([4e-3, -5e-3]))
    assert_allclose(one.tip - tip, [4e-3, 0.0, -5e-3], atol=1e-15)
    assert_allclose(one.guide_load, felt, atol=1e-11)


def test_tissue_motion_along_the_needle_cuts_tissue() -> None:
    """Breathing moves tissue along the needle, which cuts deeper into it, or retracts."""
    one = steered(0.3)
    way(one)
    cut = one.path.depths[-1]
    one.move(tissue=(0.0, 2e-3, 0.0))
    assert one.depth == pytest.approx(0.1, abs=1e-15)
    # The end of the path moved with the tissue, away from the tip.
    assert one.path.depths[-1] == pytest.approx(cut + 2e-3, abs=1e-15)
    assert (one.load == 0.0).all()
    assert one.shape.depths[0] == pytest.approx(-0.02, abs=1e-15)
    one.move(tissue=(0.0, -1e-3, 0.0))
    assert one.deepest == one.depth
    assert (one.load != 0.0).any()


def test_tissue_shift_equals_another_free_length() -> None:
    """A longer free length by moving tissue equals that free length."""
    moved = SteeredNeedle(needle_in(2e4), SteeringParameters(free_length=0.02))
    moved.move(depth=0.08)
    moved.move(tissue=(0.0, 0.01, 0.0))
    plain = inserted(2e4, 0.07, free_length=0.03)
    assert_allclose(moved.authority, plain.authority, rtol=1e-12)
    assert_allclose(moved.compliance, plain.compliance, rtol=1e-12)


@pytest.mark.parametrize('name', NEEDLES)
def test_presets_cut_a_path(name: str) -> None:
    needle, steering, source = NEEDLES[name]
    assert source
    one = SteeredNeedle(needle, replace(steering, bevel_load=(0.01,)))
    one.move(depth=0.1)
    assert np.isfinite(one.shape.deflections).all()
    # The bevel pushes to z, with a deflection that grows with depth.
    assert one.tip[0] == 0.0
    assert (np.diff(one.path.deflections[:, 1]) > 0.0).all()


def test_path_noise_spreads_the_tips() -> None:
    """By its variance per length, for any elements; the same seed gives the same path."""
    needle, noise = needle_in(tissue_of(EI, 0.035)), 3e-4
    depths = np.array([0.0, 0.05, 0.1, 0.3])
    ends = [
        insert_batch(
            needle, SteeringParameters(path_noise=noise, element=h), depths, seeds=range(1000)
        )
        for h in (1e-3, 0.25e-3)
    ]
    # Corners of the loads, a millimeter apart, against parabolas: of second order.
    assert_allclose(ends[0], ends[1], atol=3e-5)
    found = ends[0][:, -1, [0, 2]].std()
    # A direction that wanders for 0.3 m, with its variance growing evenly, ends so far aside. The
    # elastic needle adds some at the ends: two bending lengths. 2000 samples are good to 1.6 %.
    aside = np.sqrt(noise * 0.3**3 / 3.0)
    assert aside < found < 1.3 * aside
    assert len(np.unique(ends[0][:, -1, 0])) == 1000


@pytest.mark.parametrize(
    ('pose', 'error', 'words'),
    [
        ({'depth': -1e-3}, ParameterError, r'depth must be in \[0, 0\.58\] m'),
        ({'depth': 0.59}, ParameterError, r'minus its free length, got 0\.59 m'),
        ({'depth': nan}, ParameterError, 'depth must be finite, got nan'),
        ({'depth': True}, ParameterError, 'depth must be a number, got True'),
        ({'roll': inf}, ParameterError, 'roll must be finite, got inf'),
        ({'guide': (0.0, nan)}, ParameterError, 'guide must be finite'),
        ({'tilt': (0.0,)}, ShapeError, r'tilt must have shape \(2,\), got \(1,\)'),
        ({'tissue': (0.0, 0.0)}, ShapeError, r'tissue must have shape \(3,\)'),
        ({'tissue': (0.0, 0.06, 0.0)}, ParameterError, 'tissue must stay between guide and tip'),
        ({'tissue': (0.0, -0.03, 0.0)}, ParameterError, 'tissue must stay between guide and tip'),
    ],
)
def test_invalid_poses_are_rejected_without_effect(
    pose: dict[str, Any], error: type, words: str
) -> None:
    one = inserted(2e4, 0.05)
    before = one.shape
    with pytest.raises(error, match=words):
        one.move(**pose)
    assert one.depth == 0.05
    assert_allclose(one.shape.deflections, before.deflections, rtol=0.0)


def test_invalid_constants_are_rejected() -> None:
    with pytest.raises(ParameterError, match='bevel_load must have one value, or one for each of'):
        SteeredNeedle(needle_in(2e4), SteeringParameters(bevel_load=(0.1, 0.2, 0.3)))
    with pytest.raises(ParameterError, match='free_length must be < length'):
        SteeredNeedle(needle_in(2e4), SteeringParameters(free_length=0.6))
    with pytest.raises(ParameterError, match='skin_stiffness must be finite, >= 0 N/m'):
        SteeringParameters(skin_stiffness=-1.0)
    with pytest.raises(ParameterError, match='bevel_load must have one value'):
        SteeringParameters(bevel_load=())
