# SPDX-License-Identifier: Apache-2.0
"""Laws of the simulated needles, guides and sensors that are independent of the model."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from benchmarks.worlds import compare
from benchmarks.worlds.bevel import BevelNeedle, bicycle_curvature, CURVATURE, LEAD
from benchmarks.worlds.breathing import Breath, BreathingTissue
from benchmarks.worlds.faulty_guide import FaultyGuide
from benchmarks.worlds.inclusions import draw_obstacles, Inclusions
from benchmarks.worlds.nonlinear_tissue import HARDENING, NonlinearTissue, TissueLaw, YIELDING
from benchmarks.worlds.pointing import PointingNeedle
from benchmarks.worlds.rod import ExactRod
from benchmarks.worlds.scenarios import Case, SCENARIOS
from benchmarks.worlds.sensors import Bursts, Colored, Distorted, WhiteNoise
from benchmarks.worlds.stiffness_field import draw_field, StiffnessField
from benchmarks.worlds.world import CELL, DrawnConstants, IndependentNeedle
from needle_controller.steering.law import GuideSetpoint
from needle_controller.steering.simulation import SteeringPlant
from needle_dynamics import FloatArray, SteeredNeedle, SteeringParameters
from needle_dynamics.needles import NEEDLES
from needle_ros.errors import ParameterError
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from support.reference_models import bicycle

DEPTHS = 5e-3 * np.arange(21.0)

#: A bending length of 25 mm, the stiffest tissue, where errors of discretization are largest.
TISSUE = 4.0 * 0.0256 / 0.025**4
NEEDLE = DrawnConstants(tissue=TISSUE, skin=0.02 * TISSUE, tilt=(0.02, -0.01), bevel=(0.06, 0.08))

Make = Callable[[DrawnConstants], IndependentNeedle]

#: Needles in tissue that is linear, or nearly so at small deflections, by name, with the size of
#: their elements as a parameter.
BEAMS: dict[str, Callable[..., IndependentNeedle]] = {
    'differences': lambda c, size=1e-3: StiffnessField(c, DEPTHS, size=size),
    'polynomial': lambda c, size=1.25e-3: Inclusions(c, DEPTHS, degree=18, size=size),
    'elements': lambda c, size=2.5e-3: NonlinearTissue(c, DEPTHS, size=size),
    'flexibility': lambda c, size=1.25e-3: BreathingTissue(c, DEPTHS, size=size),
    'rod': lambda c, size=2.5e-3: ExactRod(c, DEPTHS, size),
}

#: All needles that the guide moves.
GUIDED: dict[str, Make] = {
    **BEAMS,
    'hardening': lambda c: NonlinearTissue(c, DEPTHS, HARDENING),
    'yielding': lambda c: NonlinearTissue(c, DEPTHS, YIELDING),
    'pointing': lambda c: PointingNeedle(c, DEPTHS),
    'field': lambda c: StiffnessField(c, DEPTHS, draw_field(np.random.default_rng(1))),
    'faulty guide': lambda c: FaultyGuide(c, DEPTHS, gap=5e-4, gain=(0.9, 0.9)),
}


def inserted(
    world: IndependentNeedle | SteeringPlant, size: float = 1e-3, turn: float = 0.0
) -> FloatArray:
    """Insert with motions of the guide; return tip [m] and load on the guide [N] at each step."""
    found = []
    for k in range(len(world.depths) - 1):
        at = size * min(1.0, k / 4) * np.exp(1j * turn) * complex(np.sin(0.4 * k), np.cos(0.6 * k))
        world.guide(GuideSetpoint(at.real, at.imag))
        found.append([*world.tip, *world.needle.guide_load[0]])
        world.insert()
        found.append([*world.tip, *world.needle.guide_load[0]])
    return np.array(found)


def own(c: DrawnConstants) -> SteeringPlant:
    """Return the needle of the project's model, with its elements of 0.5 mm."""
    needle = replace(NEEDLES['phantom'].needle, tissue_stiffness=c.tissue)
    steering = SteeringParameters(
        free_length=c.free,
        skin_stiffness=c.skin,
        bevel_load=(float(np.hypot(*c.bevel)),),
        element=5e-4,
    )
    roll = float(np.arctan2(*c.bevel))
    return SteeringPlant(SteeredNeedle(needle, steering, tilt=c.tilt, roll=roll), DEPTHS)


def scaled(c: DrawnConstants, factor: float) -> DrawnConstants:
    """Return constants with a tenth, or another factor, of all that bends the needle."""
    (x, z), (bx, bz) = c.tilt, c.bevel
    return replace(c, tilt=(factor * x, factor * z), bevel=(factor * bx, factor * bz))


@pytest.mark.parametrize('name', BEAMS)
def test_small_deflections_are_those_of_the_own_model(name: str) -> None:
    # Deflections of 0.1 to 2 mm; 3 um is the largest error of the elements of 2.5 mm. The rod is
    # linear at a tenth of them.
    small = 0.1 if name == 'rod' else 1.0
    c = scaled(NEEDLE, small)
    theirs, ours = inserted(BEAMS[name](c), 1e-3 * small), inserted(own(c), 1e-3 * small)
    assert np.abs(theirs - ours)[:, :2].max() < 3e-6
    assert np.abs(ours[:, :2]).max() > 1e-4
    assert np.abs(theirs - ours)[:, 2:].max() < 2e-3 * np.abs(ours[:, 2:]).max()


@pytest.mark.parametrize('name', BEAMS)
def test_error_decreases_with_the_element(name: str) -> None:
    c = scaled(NEEDLE, 0.1)
    # Shooting needs shorter steps.
    first = 2.5e-3 if name == 'rod' else 5e-3
    coarse, middle, fine = (
        inserted(BEAMS[name](c, size=size), 1e-4)[-1, :2]
        for size in (first, 0.5 * first, 0.25 * first)
    )
    # Second order is a factor of 4; terms of higher order change it at these lengths.
    assert np.hypot(*(coarse - middle)) > 2.5 * np.hypot(*(middle - fine))
    assert np.hypot(*(middle - fine)) > 0.0


@pytest.mark.parametrize('name', GUIDED)
def test_mirror_and_rotation_symmetry(name: str) -> None:
    make = GUIDED[name]
    straight = inserted(make(NEEDLE))
    # The mirror of x, and a rotation from x to z.
    (x, z), (bx, bz) = NEEDLE.tilt, NEEDLE.bevel
    angle = 0.5 * np.pi
    turned = replace(NEEDLE, tilt=(-z, x), bevel=(-bz, bx))
    found = inserted(make(turned), turn=angle)
    there = straight[:, [1, 0, 3, 2]] * np.array([-1.0, 1.0, -1.0, 1.0])
    # Newton's method stops at changes of a nanometer.
    assert np.abs(found - there)[:, :2].max() < 1e-8
    opposite = inserted(make(replace(NEEDLE, tilt=(-x, -z), bevel=(-bx, -bz))), turn=np.pi)
    assert np.abs(opposite + straight)[:, :2].max() < 1e-8


@pytest.mark.parametrize('name', GUIDED)
def test_straight_needle_stays_straight(name: str) -> None:
    world = GUIDED[name](DrawnConstants(tissue=TISSUE, skin=0.02 * TISSUE))
    assert np.abs(inserted(world, 0.0)).max() < 1e-12


@pytest.mark.parametrize('name', [name for name in GUIDED if name != 'yielding'])
def test_guide_at_rest_does_not_move_the_tip(name: str) -> None:
    relaxes = name == 'hardening'
    world = GUIDED[name](NEEDLE)
    inserted(world)
    before = world.tip
    at = GuideSetpoint(-2e-3, 1e-3)
    world.guide(at)
    once = world.tip
    world.guide(at)
    # Tissue that relaxes creeps for some time.
    assert np.abs(world.tip - once).max() < (2e-5 if relaxes else 1e-9)
    assert np.abs(once - before).max() > 1e-6


def test_rod_differs_with_the_cube_of_the_deflection() -> None:
    off = []
    for size in (0.25, 0.5):
        c = scaled(NEEDLE, size)
        fine = inserted(ExactRod(c, DEPTHS, 1.25e-3), 4e-3 * size)
        off.append(np.abs(fine - inserted(own(c), 4e-3 * size))[:, :2].max())
    # Eight times; the error of the discretization is linear.
    assert 5.0 < off[1] / off[0] < 10.0


def test_rod_before_the_skin_is_an_elastica() -> None:
    """Compare with a planar elastica, integrated from its tip by SciPy."""
    stiffness, length, load = 0.0256, 0.1, 3.0
    rod = ExactRod(DrawnConstants(tissue=TISSUE, free=length, bevel=(0.0, load)), DEPTHS, 2e-3)

    def back(angle: float) -> FloatArray:
        """Return y, z, angle and moment at the guide for an angle of the tip."""
        # The part of the load perpendicular to the tip.
        ny, nz = load * np.cos(angle) * np.array([-np.sin(angle), np.cos(angle)])

        def rate(_: float, state: FloatArray) -> list[float]:
            _, _, turn, moment = state
            c, s = np.cos(turn), np.sin(turn)
            return [c, s, moment / stiffness, s * ny - c * nz]

        begin = [0.0, 0.0, angle, 0.0]
        return solve_ivp(rate, (length, 0.0), begin, rtol=1e-10, atol=1e-12).y[:, -1]

    angle = brentq(lambda one: back(one)[2], 0.1, 1.0)
    _, z, _, _ = back(angle)
    assert angle > 0.3
    # The steps of the rod are 4 mm, of fourth order.
    assert rod.position[1] == pytest.approx(-z, abs=1e-7)
    assert rod.position[0] == 0.0
    assert rod.guide_load[0, 1] == pytest.approx(load * np.cos(angle) ** 2, rel=1e-5)


def test_energy_is_conserved_by_elastic_tissue_only() -> None:
    work = {}
    for name, law in {
        'hardening': TissueLaw(hardening=5e-4),
        'yielding': TissueLaw(yielding=3e-4),
    }.items():
        world = NonlinearTissue(NEEDLE, DEPTHS, law)
        inserted(world)
        turn = np.linspace(0.0, 2.0 * np.pi, 201)
        x, z = 4e-3 * (1.0 - np.cos(turn)), 4e-3 * np.sin(turn)
        world.guide(GuideSetpoint(x[0], z[0]))
        loads = []
        for at in zip(x, z, strict=True):
            world.guide(GuideSetpoint(*at))
            # The force of the guide on the needle.
            loads.append(-world.guide_load[0])
        middle = 0.5 * (np.array(loads)[1:] + np.array(loads)[:-1])
        steps = np.diff(np.array([x, z]).T, axis=0)
        work[name] = float((middle * steps).sum()) / float(np.abs(middle * steps).sum())
    # The trapezoidal rule leaves 1e-4; tissue that yields takes energy.
    assert abs(work['hardening']) < 1e-3
    assert work['yielding'] > 0.01


def test_unicycle_moves_on_a_circle() -> None:
    c = DrawnConstants(tissue=TISSUE)
    needle = BevelNeedle(c, DEPTHS, CURVATURE, roll=0.3)
    for _ in DEPTHS[1:]:
        needle.insert()
    radius, angle = 1.0 / CURVATURE, CURVATURE * DEPTHS[-1]
    aside = radius * (1.0 - np.cos(angle))
    expected = [aside * np.sin(0.3), radius * np.sin(angle), aside * np.cos(0.3)]
    np.testing.assert_allclose(needle.point, expected, rtol=1e-12)


def test_bicycle_is_that_of_the_literature() -> None:
    """Compare with the independent model, also with a turn, and with the figures of its source."""
    c = DrawnConstants(tissue=TISSUE)
    needle = BevelNeedle(c, DEPTHS, bicycle_curvature(), LEAD, windup=0.0)
    for k in range(len(DEPTHS) - 1):
        needle.guide(GuideSetpoint(0.0, 0.0, 0.5 * k))
        needle.insert()
    rolls = np.append(0.0, 0.5 * np.arange(len(DEPTHS) - 1))
    there = bicycle(DEPTHS, rolls, bicycle_curvature(), LEAD)[-1]
    np.testing.assert_allclose(needle.point, there, atol=1e-12)


def test_tip_lags_by_the_windup() -> None:
    needle = BevelNeedle(DrawnConstants(tissue=TISSUE), DEPTHS)
    for _ in DEPTHS[1:]:
        needle.insert()
    needle.guide(GuideSetpoint(0.0, 0.0, 1.0))
    assert needle.roll == pytest.approx(1.0 - 0.25 * np.pi)
    needle.guide(GuideSetpoint(0.0, 0.0, 0.9))
    assert needle.roll == pytest.approx(1.0 - 0.25 * np.pi)
    needle.guide(GuideSetpoint(0.0, 0.0, -1.0))
    assert needle.roll == pytest.approx(-1.0 + 0.25 * np.pi)


def test_pointing_needle_follows_its_tip() -> None:
    """In tissue too soft to bend it, the needle follows the direction of the guide."""
    c = DrawnConstants(tissue=1.0, tilt=(0.02, 0.0))
    world = PointingNeedle(c, DEPTHS)
    found = inserted(world, 0.0)
    np.testing.assert_allclose(found[-1, :2], [0.02 * 0.14, 0.0], atol=1e-9)
    # The order is between one and two.
    ends = [
        inserted(PointingNeedle(NEEDLE, DEPTHS, size=size))[-1, 0] for size in (1e-3, 5e-4, 2.5e-4)
    ]
    assert 1.6 < (ends[0] - ends[1]) / (ends[1] - ends[2]) < 4.5


def test_uniform_field_and_no_obstacles_change_nothing() -> None:
    uniform = StiffnessField(NEEDLE, DEPTHS, np.ones(126))
    np.testing.assert_array_equal(inserted(uniform), inserted(StiffnessField(NEEDLE, DEPTHS)))
    field = draw_field(np.random.default_rng(3))
    assert field.min() >= 0.5
    assert field.max() <= 1.5
    many = np.array([draw_field(np.random.default_rng(seed)) for seed in range(300)])
    # Uniform in 0.5 to 1.5: standard deviation 0.289; 300 values of each depth.
    assert many.std() == pytest.approx(12.0**-0.5, abs=0.01)
    near = np.corrcoef(many[:, 50], many[:, 60])[0, 1]
    # At one correlation length, exp(-1/2), which the uniform distribution hardly changes.
    assert near == pytest.approx(np.exp(-0.5), abs=0.1)


def test_obstacles_push_the_tip_aside() -> None:
    obstacles = draw_obstacles(np.random.default_rng(2))
    off = inserted(Inclusions(NEEDLE, DEPTHS, obstacles)) - inserted(Inclusions(NEEDLE, DEPTHS))
    assert np.abs(off[-1, :2]).max() > 1e-4
    pushing = CELL * np.flatnonzero(obstacles.loads.any(axis=1))[0]
    before = np.count_nonzero(DEPTHS[1:] < min(pushing, obstacles.begins.min()))
    assert before > 0
    np.testing.assert_array_equal(off[: 2 * before], 0.0)


def test_breathing_returns_at_exhale() -> None:
    c = DrawnConstants(tissue=TISSUE, skin=0.02 * TISSUE)
    breath = Breath(amplitude=(6e-3, -3e-3), gated=True)
    world = BreathingTissue(c, DEPTHS, breath)
    inserted(world, 0.0)
    # Gated at 5 % of the amplitude, the path is displaced by less than this.
    assert np.abs(world.tip).max() < 0.05 * 7e-3
    free = BreathingTissue(c, DEPTHS, replace(breath, gated=False))
    moved = inserted(free, 0.0)
    assert np.abs(moved[:-1, 0]).max() > 1e-3


def test_backlash_and_gain_of_the_guide() -> None:
    world = FaultyGuide(NEEDLE, DEPTHS, gap=4e-4, gain=(1.1, 0.9))
    for to, at in ((1e-3, 0.9e-3), (0.9e-3, 0.9e-3), (0.0, 0.2e-3)):
        world.guide(GuideSetpoint(to, 0.0))
        assert world.at[0] == pytest.approx(at)
    turned = FaultyGuide(NEEDLE, DEPTHS, turn=0.5 * np.pi)
    turned.guide(GuideSetpoint(1e-3, 2e-3))
    np.testing.assert_allclose(turned.at, [-2e-3, 1e-3], atol=1e-12)
    exact = FaultyGuide(NEEDLE, DEPTHS)
    np.testing.assert_array_equal(inserted(exact), inserted(StiffnessField(NEEDLE, DEPTHS)))


def test_errors_of_the_sensors() -> None:
    tip, rng = np.array([3e-3, -1e-3]), np.random.default_rng(0)
    exact = WhiteNoise(rng, 0.0)
    sizes = [Distorted(exact, np.random.default_rng(seed)).error(0.04) for seed in range(2000)]
    # 4000 values: the error of their mean square is about 2 %.
    assert np.sqrt((np.array(sizes) ** 2).sum(axis=1).mean()) == pytest.approx(5e-4, rel=0.05)
    colored = Colored(exact, rng, 5e-4)
    noise = np.array([colored(tip) - tip for _ in range(20000)])
    assert noise.std() == pytest.approx(5e-4, rel=0.05)
    follows = np.mean(noise[1:] * noise[:-1]) / noise.var()
    assert follows == pytest.approx(np.exp(-1.7 / 3.0), abs=0.03)
    bursts = Bursts(exact, rng)
    lost = np.array([bursts(tip) is None for _ in range(20000)])
    # A Markov chain: begin / (begin + end) of the time, 1 / end measurements each.
    assert lost.mean() == pytest.approx(0.15 / 0.75, abs=0.02)
    assert lost.sum() / np.sum(lost[1:] & ~lost[:-1]) == pytest.approx(1.0 / 0.6, rel=0.05)


@pytest.mark.parametrize('name', SCENARIOS)
def test_seed_determines_needle_target_and_noise(name: str) -> None:
    first, second, other = (
        compare.insert(name, ['springs'], seed)['springs'] for seed in (3, 3, 4)
    )
    assert first == second
    assert first.miss != other.miss
    assert np.isfinite(first.miss)


def test_targets_can_be_reached() -> None:
    for name in ('beam', 'unicycle'):
        case = Case(name, 0)
        np.testing.assert_array_equal(case.target, Case(name, 0).target)


def test_comparison_does_not_depend_on_the_number_of_jobs() -> None:
    worlds, laws = ['beam', 'unicycle'], ['ours', 'roll towards the target', 'open loop']
    stages: list[str] = []
    one, two = (compare.measure(worlds, laws, 3, jobs, stages.append) for jobs in (1, 2))
    assert str(one) == str(two)
    assert stages == 2 * worlds
    assert set(one['beam']) == {'ours', 'open loop'}
    assert set(one['unicycle']) == set(laws)
    assert len(compare.section(one, 3).rows) == 5


def test_summary_counts_stops_and_silent_misses() -> None:
    found = [
        compare.ComparedInsertion(miss=0.5e-3, travel=1e-2, load=1.0, held=True, chance=1.0),
        compare.ComparedInsertion(miss=2e-3, travel=1e-2, load=3.0, held=False, chance=1.0),
        compare.ComparedInsertion(miss=3e-3, travel=1e-2, load=2.0, held=False, warned=True),
        compare.ComparedInsertion(stopped='the tip sensor is frozen', chance=0.8),
    ]
    one = compare.Summary.of(found)
    assert (one.hit, one.stopped, one.silent) == (25.0, 25.0, 25.0)
    assert one.mean == pytest.approx(5.5 / 3.0)
    assert one.held == pytest.approx(100.0 / 3.0)
    assert np.isnan(one.forecast)
    assert [one.chance, one.hits] == pytest.approx([280.0 / 3.0, 100.0 / 3.0])
    assert [one.travel, one.load] == pytest.approx([10.0, 2.0])


def test_invalid_arguments_are_rejected() -> None:
    measure = partial(compare.measure, jobs=1, tick=lambda _: None)
    with pytest.raises(ParameterError, match=r"must be one of own, beam.* got 'moon'"):
        measure(['moon'], ['ours'], 1)
    with pytest.raises(ParameterError, match='count must be at least 1, got 0'):
        measure(['beam'], ['ours'], 0)
