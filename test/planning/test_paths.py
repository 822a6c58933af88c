# SPDX-License-Identifier: Apache-2.0
"""Paths of a planned needle: linear responses, largest bow, and the best bow."""

from __future__ import annotations

from needle_controller.steering.insertion_plan import guide_axes
from needle_controller.steering.settings import SteeringLimits
from needle_dynamics import find_needle, FloatArray, NEEDLES, SteeredNeedle
from needle_dynamics.needles import NeedlePreset
from needle_dynamics.steering.needle import inserted_shape
from needle_planning.anatomy import Anatomy, Structure
from needle_planning.certificate import simulate_insertion
from needle_planning.clearance import Clearance
from needle_planning.paths import (
    best_bow,
    bow_profile,
    Line,
    needle_radius,
    path_responses,
    PathResponses,
    SKIN_LIMIT,
    STEEPEST,
)
from needle_ros.errors import ParameterError
import numpy as np
import pytest
from scipy.optimize import linprog
from support.anatomies import affine

LIMITS = SteeringLimits()
PARTS = 16
#: Line of 100 mm along R, at the center of the images of `wall`.
LINE = Line(np.zeros(3), guide_axes(np.array([1.0, 0.0, 0.0])))


def needle(bevel: float = 0.0, name: str = 'bending_35mm') -> NeedlePreset:
    return find_needle(name).changed({'bevel_load': (bevel,)})


def wall(low: list[float], high: list[float], margin: float = 2e-3) -> Anatomy:
    """Return voxels of 2 mm around `LINE` with a block between two corners [m]."""
    index = np.moveaxis(np.indices((70, 40, 40)), 0, -1)
    points = 2e-3 * index - np.array([0.02, 0.039, 0.039])
    labels = ((points > low) & (points < high)).all(axis=-1).astype(np.int16)
    return Anatomy(
        labels=labels,
        to_patient=affine([2e-3] * 3, origin=(-0.02, -0.039, -0.039)),
        structures={1: Structure(name='vessel', role='obstacle', margin=margin)},
    )


def clearance_of(anatomy: Anatomy) -> Clearance:
    ends = [LINE.entry, LINE.entry + 0.1 * LINE.axes[1]]
    radius = needle_radius(needle().needle)
    return Clearance([anatomy], ends, radius=radius, beyond=0.015)


def simulated(
    preset: NeedlePreset, responses: PathResponses, guide: FloatArray, roll: float
) -> tuple[FloatArray, FloatArray]:
    """Return deflections (m, 2) and loads (n, 2) of an insertion, at the rows of the responses."""
    one = SteeredNeedle(preset.needle, preset.steering, roll=roll)
    rows, shapes, loads = list(responses.rows), [], []

    def keep() -> None:
        # A group of rows ends at the tip.
        count = next(k for k, y in enumerate(rows, 1) if abs(y - one.depth) < 1e-9)
        shapes.append(inserted_shape(one, np.array(rows[:count]))[0])
        del rows[:count]

    for k, setpoint in enumerate(guide):
        one.move(guide=setpoint.tolist())
        loads.append(one.guide_load[0])
        keep()
        one.move(depth=float(responses.depths[k + 1]))
        keep()
    assert not rows
    return np.concatenate(shapes), np.array(loads)


@pytest.mark.parametrize('length', [0.1, 0.0937])
@pytest.mark.parametrize('name', ['bending_35mm', 'hollow_1.05mm'])
def test_shaft_is_linear_in_guide_and_bevel(name: str, length: float) -> None:
    """
    The sum of responses is the simulated needle, in both planes, at all depths.

    Steps that end at nodes agree to the restarts of the path (0.1 um for each motion). Other steps
    cut a part of an element again: 1 % of the motion of the guide.
    """
    preset = needle(0.3, name)
    responses = path_responses(preset.needle, preset.steering, length, 5e-3)
    steps = len(responses.depths) - 1
    rng = np.random.default_rng(0)
    guide = np.cumsum(rng.uniform(-1e-3, 1e-3, (steps, 2)), axis=0)
    roll = 0.7
    push = np.array([np.sin(roll), np.cos(roll)])
    shapes, loads = simulated(preset, responses, guide, roll)
    found = responses.shaft @ guide + np.outer(responses.shaft_bevel, push)
    tolerance = 3e-6 if length == 0.1 else 2e-5
    assert found == pytest.approx(shapes, abs=tolerance)
    force = responses.loads @ guide + np.outer(responses.loads_bevel, push)
    assert force == pytest.approx(loads, abs=0.02 * np.abs(loads).max())
    assert responses.rows[responses.tips] == pytest.approx(responses.depths)
    assert responses.rows[responses.last][[0, -1]] == pytest.approx([0.0, length])


@pytest.mark.parametrize('name', ['bending_35mm', 'bending_25mm', 'hollow_1.05mm'])
def test_bow_profile_bounds_every_path(name: str) -> None:
    """
    No guide setpoints bow the needle more, at random lengths and places.

    The largest deflection of a place is found by a linear program of the test. The search uses
    1.1 times the profile, for lengths between those with a profile.
    """
    preset, rng = find_needle(name), np.random.default_rng(3)
    profiles = [
        bow_profile(
            path_responses(preset.needle, preset.steering, length, 5e-3), LIMITS, 0.0, PARTS
        )
        for length in (0.07, 0.09, 0.11, 0.13, 0.15)
    ]
    profile = 1.1 * np.max(profiles, axis=0)
    for length in rng.uniform(0.07, 0.15, 4):
        r = path_responses(preset.needle, preset.steering, float(length), 5e-3)
        n = len(r.depths) - 1
        change = np.eye(n) - np.eye(n, k=-1)
        skin = r.shaft[r.rows == 0.0]
        rows = np.vstack([change, r.loads, skin, r.slopes])
        most = np.repeat(
            [2e-3, 8.0, SKIN_LIMIT, STEEPEST / np.sqrt(2.0)], [n, n, len(skin), len(r.slopes)]
        )
        box = [(0.0, 0.0)] + [(-6e-3, 6e-3)] * (n - 1)
        for place in rng.uniform(0.05, 0.98, 4):
            found = []
            for group in (r.last, r.tips):
                row = [np.interp(place * length, r.rows[group], one) for one in r.shaft[group].T]
                best = linprog(
                    -np.array(row), np.vstack([rows, -rows]), np.tile(most, 2),
                    r.shaft[[r.tip]], [0.0], box,
                )  # fmt: skip
                found.append(-best.fun)
            bound = np.interp(place, np.linspace(0.0, 1.0, PARTS + 1), profile)
            assert np.sqrt(2.0) * min(found) <= bound, (length, place)


#: A block on the line, which a needle may pass at 1.5 mm; and a channel with a bend.
BLOCKS = {
    'grazed': ([0.04, -0.03, -0.03], [0.06, 0.03, -0.0015]),
    'beside': ([0.02, -0.0015 - 0.03, -0.03], [0.05, -0.0015, 0.03]),
}


@pytest.mark.parametrize('bevel', [0.0, 0.2])
@pytest.mark.parametrize('name', BLOCKS)
def test_best_bow_keeps_the_limits_and_gains_clearance(name: str, bevel: float) -> None:
    """The guide stays in its limits, the tip reaches the target, and the clearance grows."""
    clearance, preset = clearance_of(wall(*BLOCKS[name])), needle(bevel)
    responses = path_responses(preset.needle, preset.steering, 0.1, 5e-3)
    found = best_bow(clearance, LINE, responses, LIMITS)
    assert found is not None
    guide = found.guide
    tolerance = 1e-9  # of the solver: 1e-7 mm
    assert (guide[0] == 0.0).all()
    assert np.abs(guide).max() <= LIMITS.guide_limit + tolerance
    assert np.abs(np.diff(guide, axis=0)).max() <= LIMITS.guide_step + tolerance
    done = simulate_insertion(clearance, LINE, *preset[:2], responses.depths, guide)
    # Linear to 3 um, and a bound of 50 um.
    assert np.linalg.norm(done.path[-1] - (LINE.entry + 0.1 * LINE.axes[1])) < 1e-5
    assert found.clearance - 2e-4 < done.clearance <= found.clearance + 1e-5
    assert done.slope <= 1.05 * STEEPEST
    assert done.load <= 1.05 * LIMITS.load_limit
    straight = simulate_insertion(
        clearance, LINE, *needle()[:2], responses.depths, np.zeros_like(guide)
    )
    # The limit at the skin leaves 0.44 mm to the needle with a bevel, whose bow it shares.
    assert done.clearance > straight.clearance + 4e-4


@pytest.mark.parametrize('bevel', [0.0, 0.2])
def test_guide_keeps_the_needle_at_its_entry_point(bevel: float) -> None:
    """
    At all depths the needle is at most the limit from the entry point; a larger limit gains.

    The linear model holds at the skin to 1 %, as elsewhere.
    """
    clearance, preset = clearance_of(wall(*BLOCKS['beside'])), needle(bevel)
    responses = path_responses(preset.needle, preset.steering, 0.1, 5e-3)
    found = []
    for limit in (5e-4, 1e-3, 2e-3, np.inf):
        bow = best_bow(clearance, LINE, responses, LIMITS, skin_limit=limit)
        assert bow is not None
        done = simulate_insertion(clearance, LINE, *preset[:2], responses.depths, bow.guide)
        assert done.skin <= 1.01 * limit
        found.append((done.clearance, done.skin))
    values, shifts = zip(*found, strict=True)
    assert list(values) == sorted(values)
    assert shifts[-1] > 2.2e-3


def test_certificate_is_below_every_sampled_shape() -> None:
    """The clearance of a bowed insertion holds at all depths and during motions at rest."""
    clearance, preset = clearance_of(wall(*BLOCKS['grazed'])), needle(0.2)
    responses = path_responses(preset.needle, preset.steering, 0.1, 5e-3)
    rng = np.random.default_rng(1)
    guide = np.cumsum(rng.uniform(-1e-3, 1e-3, (20, 2)), axis=0)
    guide[0] = 0.0
    found = simulate_insertion(clearance, LINE, *preset[:2], responses.depths, guide)
    one = SteeredNeedle(*preset[:2])
    sampled = np.full(21, np.inf)
    for k, setpoint in enumerate(guide, 1):
        before = one.guide
        for part in (0.3, 0.62, 1.0):
            one.move(guide=(before + part * (setpoint - before)).tolist())
            points = np.arange(0.0, one.depth + 1e-9, 0.37e-3)
            shape = LINE.points(points, inserted_shape(one, points)[0])
            sampled[k] = min(sampled[k], clearance.at(shape).min())
        for depth in np.linspace(responses.depths[k - 1], responses.depths[k], 8)[1:]:
            one.move(depth=float(depth))
            points = np.append(np.arange(0.0, depth, 0.37e-3), depth)
            shape = LINE.points(points, inserted_shape(one, points)[0])
            sampled[k] = min(sampled[k], clearance.at(shape).min())
        assert found.path[k] == pytest.approx(
            LINE.points(points, inserted_shape(one, points)[0])[-1]
        )
    # The path restarts at other depths if an insertion has other stops: 5 um.
    assert (found.clearances[1:] <= sampled[1:] + 5e-6).all()
    # Tight: 50 um, and 0.4 mm between the samples.
    assert (found.clearances[1:] >= sampled[1:] - 4e-4).all()
    assert found.clearance == found.clearances.min()
    assert clearance.at(found.place[np.newaxis])[0] == pytest.approx(found.clearance, abs=1e-4)


def test_straight_needle_has_the_clearance_of_its_line() -> None:
    clearance, preset = clearance_of(wall(*BLOCKS['grazed'])), needle()
    depths = np.linspace(0.0, 0.1, 21)
    found = simulate_insertion(clearance, LINE, *preset[:2], depths, np.zeros((20, 2)))
    line = clearance.lines(LINE.entry, LINE.entry + 0.1 * LINE.axes[1], tolerance=1e-7)
    assert found.clearance == pytest.approx(line.least[0], abs=6e-6)
    assert (np.diff(found.clearances) <= 0.0).all()
    assert found.bow == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize('name', [name for name in NEEDLES if name.startswith('hollow')])
def test_radius_is_that_of_the_tube(name: str) -> None:
    """The names of these needles have their outer diameters."""
    diameter = float(name.removeprefix('hollow_').removesuffix('mm')) * 1e-3
    assert needle_radius(NEEDLES[name].needle) == pytest.approx(0.5 * diameter)


@pytest.mark.parametrize('direction', [[1.0, 2.0, 3.0], [0.0, 0.0, -1.0], [0.1, -5.0, 0.2]])
def test_axes_of_the_guide_are_right_handed(direction: list[float]) -> None:
    axes = guide_axes(np.array(direction))
    assert axes @ axes.T == pytest.approx(np.eye(3))
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert axes[1] == pytest.approx(np.array(direction) / np.linalg.norm(direction))


def test_too_many_steps_are_rejected() -> None:
    preset = needle()
    with pytest.raises(ParameterError, match='1000 steps'):
        path_responses(preset.needle, preset.steering, 0.1, 1e-4)
