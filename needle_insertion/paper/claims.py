"""
Every claim that the paper makes about model, data and controllers, judged by what a run gives.

One function per claim computes its evidence and derives the verdict from it; `always=False` marks
claims that numbers can refute, yet whose condition is a judgment. Left out are
statements on the literature, on clinical practice and on future work, textbook formulas, and
assumptions (2) to (4), which the model cannot judge. Everything is deterministic.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from math import cosh, pi, sin, sinh, sqrt
from typing import Final

from needle_controller import Axis, LoopRun, Pid, PidGains, run_continuous, stability_limit
from needle_dynamics import FloatArray, Integrator, NeedleModel, NeedleParameters
from needle_dynamics.analysis import Analysis, analyze, linearize, operating_point
from needle_dynamics.compiled.kernels import decay_means
from needle_dynamics.modes import mode_shapes
from needle_identification import asymmetry, StiffnessSettings
from needle_insertion.paper import figures, mismatch
from needle_insertion.paper.convergence import exact_compliance, exact_frequencies
from needle_insertion.paper.figures import (
    base_alone,
    CASES,
    closed_loop,
    DEFLECTION,
    DEPTH,
    FORCE,
    hub_time,
    needle,
    open_loop,
    Outcome,
    PID_KP,
    PID_KV,
    READINGS,
)
from needle_insertion.report.section import Grid, Section
import numpy as np
from scipy.linalg import eigh

HOLDS: Final = 'holds'
ONLY_IF: Final = 'holds only if'
FAILS: Final = 'does not hold'

#: Table 1: mean and STD of mu_s [N] and mu_v [N s/mm].
TABLE_1: Final[Mapping[str, tuple[float, float]]] = {'mu_s': (0.56, 0.0374), 'mu_v': (0.3, 0.0447)}

#: Table 2: force levels [N]; means and STD of each entry at each level [kN/m].
LEVELS: Final = (1.1, 1.2, 1.3, 1.4, 1.5)
TABLE_2: Final[Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]]] = {
    'k_xx': ((1.26, 0.82, 1.10, 1.03, 0.96), (0.08, 0.54, 0.11, 0.12, 0.12)),
    'k_zz': ((1.01, 0.81, 0.69, 0.60, 0.52), (0.11, 0.15, 0.18, 0.19, 0.18)),
    'k_xz': ((0.04, 0.04, 0.01, 0.001, -0.005), (0.08, 0.07, 0.09, 0.08, 0.08)),
    'k_zx': ((-0.10, -0.10, -0.11, -0.11, -0.11), (0.06, 0.10, 0.09, 0.09, 0.09)),
}

#: Experiments behind each table.
REPEATS: Final = 20

#: Depths at which the linearized needle is looked at [m], and its speed [m/s].
_DEPTHS: Final = (0.02, 0.1, 0.2)
_SPEED: Final = 5e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """
    One claim of the paper with its verdict.

    Attributes
    ----------
    section : str
        Where the paper makes it.
    claim : str
        What it says.
    verdict : str
        One of ``holds``, ``holds only if``, ``does not hold``.
    condition : str
        What it holds only if.
    evidence : str
        What was computed, in words with numbers.
    numbers : Mapping[str, float]
        The numbers.

    """

    section: str
    claim: str
    verdict: str
    condition: str = ''
    evidence: str
    numbers: Mapping[str, float] = field(default_factory=dict)

    @property
    def words(self) -> str:
        """Verdict with its condition."""
        return f'{self.verdict} {self.condition}' if self.verdict == ONLY_IF else self.verdict


@dataclass(frozen=True, slots=True, kw_only=True)
class Tables:
    """
    Statistics that claims about Tables 1 and 2 are judged by.

    Attributes
    ----------
    source : str
        Where they come from, in words.
    friction : Mapping[str, tuple of float]
        Mean and STD by the keys of `TABLE_1`, in its units.
    stiffness : Mapping[str, tuple of tuple of float]
        Means and STD at each force level by the keys of `TABLE_2`, in its units.
    repeats : int
        Experiments behind each.

    """

    source: str = 'the printed tables'
    friction: Mapping[str, tuple[float, float]] = field(default_factory=lambda: TABLE_1)
    stiffness: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]] = field(
        default_factory=lambda: TABLE_2
    )
    repeats: int = REPEATS


def _verdict(*, always: bool, sometimes: bool = False) -> str:
    if always:
        return HOLDS
    return ONLY_IF if sometimes else FAILS


@cache
def _random_states() -> FloatArray:
    """Return deflected states in motion, from 2 cm to the hub."""
    random = np.random.default_rng(1)
    states = np.zeros((40, 8))
    for x in states:
        model = needle('paper_si', 'complete')
        x[:] = model.state_at(float(random.uniform(0.02, 0.2)), DEFLECTION)
        x[4:] = random.standard_normal(4) * (0.1, 1.0, 0.1, 0.1)
    return states


# 3.2.1, the model.


def mass_matrix() -> Claim:
    """Structure of M."""
    model = needle('paper_si', 'complete')
    matrices = [model.mass_matrix(x) for x in _random_states()]
    skew = max(float(np.abs(m - m.T).max()) for m in matrices)
    coupled = max(float(np.abs(np.delete(m[:2].ravel(), (0, 5))).max()) for m in matrices)
    least = min(float(np.linalg.eigvalsh(m)[0]) for m in matrices)
    still = [model.mass_matrix([*x[:2], 0.0, 0.0, *np.zeros(4)]) for x in _random_states()]
    other = max(float(np.abs(a - b).max()) for a, b in zip(matrices, still, strict=True))
    return Claim(
        section='3.2.1',
        claim='M(q) is symmetric, depends on q only, and couples nothing but q1 and q2.',
        verdict=_verdict(always=skew == coupled == other == 0.0 and least > 0.0),
        evidence=f'{len(matrices)} states: M - M^T, the entries printed as 0 and the dependence '
        f'on rates are exactly 0; the least eigenvalue is {least:.2g}, so that M is positive '
        'definite too.',
        numbers={'skew': skew, 'coupled': coupled, 'least': least},
    )


def zero_rows() -> Claim:
    """Rows of N."""
    run = open_loop('paper_si', 'complete')
    model = run.model
    moving = run.states[run.states[:, 0] > 0.0][::5]
    bias = np.array([model.bias_forces(x) for x in moving])
    straight = max(
        float(np.abs(model.bias_forces([*x[:2], 0.0, 0.0, *x[4:6], 0.0, 0.0])[:2]).max())
        for x in moving[::20]
    )
    largest = float(np.abs(bias[:, 0]).max())
    part = largest / model.parameters.coulomb_friction
    return Claim(
        section='3.2.1',
        claim='The first two rows of N(q, q_dot) are zero.',
        verdict=_verdict(always=largest == 0.0, sometimes=straight == 0.0),
        condition='the needle is straight',
        evidence='Row theta is 0. Row d is the derivative of (12) with respect to its limits l - '
        f'd, which the paper writes out and then drops: up to {largest:.2g} N in its own '
        'open-loop '
        f'run, {100.0 * part:.0f} % of mu_s.',
        numbers={'largest': largest, 'theta': float(np.abs(bias[:, 1]).max())},
    )


def rates_in_bias() -> Claim:
    """Coriolis and centrifugal terms of N."""
    shares = {}
    for formulation in ('complete', 'as_printed'):
        run = open_loop('paper_si', formulation)
        moving = run.states[run.states[:, 0] > 0.0][::5]
        whole = np.array([run.model.bias_forces(x) for x in moving])
        still = np.array([run.model.bias_forces([*x[:4], *np.zeros(4)]) for x in moving])
        shares[formulation] = float(np.abs(whole - still)[:, 2].max() / np.abs(whole[:, 2]).max())
    return Claim(
        section='3.2.1',
        claim='N(q, q_dot) has elements of q and of q_dot, the Coriolis and centrifugal terms.',
        verdict=_verdict(
            always=min(shares.values()) > 0.0, sometimes=shares['complete'] > shares['as_printed']
        ),
        condition='the rate of G is kept',
        evidence='In the open loop (0.3 N s/m) they come to '
        f'{100.0 * shares["complete"]:.2g} % of row q1 at most by the complete equations, and to '
        f'exactly {shares["as_printed"]:.0f} by those printed at the end of 3.2.1, which hold '
        'stiffness alone.',
        numbers=shares,
    )


def momentum_of_d() -> Claim:
    """Judge the derivative of L with respect to d_dot."""
    model = needle('paper_si', 'complete')
    state, h = model.state_at(DEPTH), 1e-3
    high, low = state.copy(), state.copy()
    high[4], low[4] = 1.0 + h, 1.0 - h
    momentum = (model.kinetic_energy(high) - model.kinetic_energy(low)) / (2.0 * h)
    return Claim(
        section='3.2.1',
        claim='The derivative of L with respect to d_dot is 0 (and so is its rate).',
        verdict=_verdict(always=momentum == 0.0),
        evidence=f'It is rho A l d_dot, {momentum:.3g} kg m/s at 1 m/s, as M11 in the same paper '
        'says.',
        numbers={'momentum': momentum},
    )


@cache
def _coast(formulation: str) -> float:
    """Return the relative change of energy of a coast without friction from 2 to 19.5 cm."""
    p = replace(
        needle('paper_si', formulation).parameters, coulomb_friction=0.0, viscous_friction=0.0
    )
    model = NeedleModel(p)
    state = model.state_at(DEPTH, DEFLECTION)
    state[4] = -3.0
    integrator = Integrator(p, state, 1e-6)
    while integrator.depth < 0.195:
        integrator.advance(1e-3)
    before = model.energy(state)
    return float((model.energy(integrator.state) - before) / before)


def conservation() -> Claim:
    """Energy without friction."""
    complete, printed = _coast('complete'), _coast('as_printed')
    return Claim(
        section='3.2.1',
        claim='Without friction the system is conservative; (13) follows from (12) by (3).',
        verdict=_verdict(
            always=max(abs(complete), abs(printed)) < 1e-3, sometimes=abs(complete) < 1e-3
        ),
        condition='all terms are kept',
        evidence='Coasting at 3 m/s from 2 to 19.5 cm without friction, energy changes by '
        f'{complete:.1e} of itself (complete) and by {printed:.3g} (as printed): d/dt of the '
        'momentum of q lacks the rate of G as the needle goes in.',
        numbers={'complete': complete, 'as_printed': printed},
    )


@cache
def _dependence(reading: str, formulation: str) -> tuple[float, float]:
    """Return by how much d, and the time at the hub, depend on an initial deflection."""
    bent, straight = (open_loop(reading, formulation, w) for w in (DEFLECTION, 0.0))
    apart = float(np.abs(bent.states[:, 0] - straight.states[:, 0]).max())
    return apart, hub_time(bent) - hub_time(straight)


def independence() -> Claim:
    """Independence of d from q1 and q2."""
    printed = max(_dependence(reading, 'as_printed')[0] for reading in READINGS)
    complete = {reading: _dependence(reading, 'complete') for reading in READINGS}
    parts = [one[0] / (NeedleParameters().length - DEPTH) for one in complete.values()]
    return Claim(
        section='3.2.1',
        claim='d depends negligibly, yet not zero, on the initial q1 and q2.',
        verdict=_verdict(
            always=0.0 < printed < 1e-2, sometimes=all(0.0 < part < 1e-2 for part in parts)
        ),
        condition='row d of N is kept, which the printed equations drop',
        evidence=f'As printed the dependence is exactly {printed:.0f}. By the complete equations '
        'an initial deflection of 0.5 mm moves d by up to '
        f'{1e3 * complete["paper_si"][0]:.2g} mm (0.3 N s/m) and '
        f'{1e3 * complete["paper_mm"][0]:.2g} mm (0.3 N s/mm), {100.0 * max(parts):.1g} % of '
        'its way.',
        numbers={'printed': printed, **{name: one[0] for name, one in complete.items()}},
    )


@cache
def _pushed(modes: int, deflection: float) -> FloatArray:
    """Return d over the first 20 ms of the open loop with a number of modes."""
    p = NeedleParameters(modes=modes, minimum_depth=0.0195)
    integrator = Integrator(p, NeedleModel(p).state_at(DEPTH, deflection))
    found = []
    for _ in range(20):
        integrator.advance(1e-3, FORCE)
        found.append(integrator.state[0])
    return np.array(found)


def two_modes_cause() -> Claim:
    """Two modes as the cause of the dependence of d on q."""
    apart = {n: float(np.abs(_pushed(n, DEFLECTION) - _pushed(n, 0.0)).max()) for n in (1, 2, 3)}
    return Claim(
        section='3.2.1',
        claim='That dependence may come from the approximation with only two modes.',
        verdict=_verdict(always=apart[3] < 0.1 * apart[2]),
        evidence='It does not vanish with more modes: '
        + ', '.join(f'{1e3 * value:.3g} mm with {n}' for n, value in apart.items())
        + ' (20 ms, 0.3 N s/m). It is the force by which a bent needle is pushed out.',
        numbers={f'{n} modes': value for n, value in apart.items()},
    )


def only_d() -> Claim:
    """Judge what q1 and q2 depend on."""
    model = needle('paper_si', 'complete')
    ends = []
    for torque in (0.0, 1e-6):
        integrator = Integrator(model.parameters, model.state_at(DEPTH, DEFLECTION))
        integrator.advance(0.01, FORCE, torque)
        ends.append(integrator.state[[0, 2, 3, 4, 6, 7]])
    apart = float(np.abs(ends[0] - ends[1]).max())
    return Claim(
        section='3.2.1, 3.2.8',
        claim='q1 and q2 are related to d only; theta may be left out of the simulations.',
        verdict=_verdict(always=apart == 0.0),
        evidence='With and without a torque, d, q1 and q2 and their rates after 10 ms of the open '
        'loop are bit-identical.',
        numbers={'apart': apart},
    )


def deflection_changes() -> Claim:
    """Further deflection from an initial one."""
    peaks = {case: abs(Outcome.of(open_loop(*case)).peak) for case in CASES}
    straight = max(
        float(np.abs(open_loop(reading, 'complete', 0.0).tip_deflection).max())
        for reading in READINGS
    )
    grown = peaks['paper_si', 'complete'] / DEFLECTION
    return Claim(
        section='3.2.1, 3.2.9',
        claim='The initial deflection changes during insertion and causes further deflection.',
        verdict=_verdict(always=straight == 0.0 and min(peaks.values()) > DEFLECTION),
        evidence=f'0.5 mm grow to {1e3 * peaks["paper_si", "complete"]:.2g} mm, {grown:.1f} times '
        'as much, under 3 N; a straight needle stays exactly straight. As printed it would be '
        f'{1e3 * peaks["paper_si", "as_printed"]:.3g} mm, which is an artifact of the missing '
        'terms.',
        numbers={', '.join(case): value for case, value in peaks.items()},
    )


def equation_9() -> Claim:
    """Factor of k_a in (9)."""
    model = needle('paper_si', 'complete')
    state = model.state_at(0.1, DEFLECTION)
    y, weights = np.polynomial.legendre.leggauss(40)
    w = model.modes.values(0.05 * (y + 1.0)) @ state[2:4]
    by_7 = 0.5 * model.parameters.tissue_stiffness * float(0.05 * weights @ w**2)
    bent = float(
        0.5
        * model.parameters.bending_stiffness
        * state[2:4]
        @ model.modes.integrals(0.1).curvature_gram
        @ state[2:4]
    )
    by_12 = model.potential_energy(state) - bent
    return Claim(
        section='3.2.1, (9)',
        claim='The tissue stores (k_a / 2) ∫ (∫ w dw) dy, (9).',
        verdict=_verdict(always=abs(0.5 * by_7 - by_12) < 1e-9 * by_12),
        evidence=f'∫ w dw is w^2 / 2, which makes (9) {0.5 * by_7 / by_12:.3f} of what (7) and '
        '(12) say.',
        numbers={'ratio': 0.5 * by_7 / by_12},
    )


def spring_at_the_tip() -> Claim:
    """One spring at the tip instead of the tissue."""
    model = needle('paper_si', 'complete')
    at = model.modes.integrals(DEPTH)
    mass = model.parameters.linear_density * at.gram
    shapes = eigh(model.stiffness_matrix(DEPTH), mass)[1].T
    tissue = np.array([shape @ at.gram @ shape for shape in shapes])
    # The spring that stores what the tissue does in the first natural shape.
    tip = (shapes @ at.value) ** 2
    ratio = float(tip[1] / tip[0] * tissue[0] / tissue[1])
    return Claim(
        section='3.2.1, (7)',
        claim='One equivalent spring at the tip can stand for the tissue.',
        verdict=_verdict(always=abs(ratio - 1.0) < 0.02, sometimes=True),
        condition='the needle keeps one shape',
        evidence='At 2 cm, a spring at the tip that stores as much as the tissue in the first '
        f'natural shape stores {ratio:.2f} times as much in the second. (9), (12) and all that '
        'follows keep the tissue along the needle.',
        numbers={'ratio': ratio},
    )


def equation_11() -> Claim:
    """Sign in (11), and the closed form of the norm."""
    modes = mode_shapes(0.2, 2)
    x, ratio = float(modes.arguments[0]), float(modes.ratios[0])
    length, k = 0.2, x / 0.2
    y, weights = np.polynomial.legendre.leggauss(60)
    z = k * 0.1 * (y + 1.0)

    def norm(sign: float) -> float:
        shape = np.sin(z) - np.sinh(z) - ratio * (np.cos(z) + sign * np.cosh(z))
        return float(0.1 * weights @ shape**2)

    square = ratio * ratio
    printed = (
        2.0 * ratio / k * sin(x) * sinh(x)
        + (1.0 - square) / k * np.cos(x) * sinh(x)
        - (1.0 + square) / k * sin(x) * cosh(x)
        + (1.0 + square) / (4.0 * k) * sinh(2.0 * x)
        + (square - 1.0) / (4.0 * k) * sin(2.0 * x)
        + ratio / (2.0 * k) * (np.cos(2.0 * x) - cosh(2.0 * x))
        + square * length
    )
    entry = 2.0 * ratio / sqrt(norm(1.0))
    minus = abs(norm(-1.0) / printed - 1.0)
    return Claim(
        section='3.2.1, (11)',
        claim='Modes (11) with + cosh have the norm 1 / c_i^2 that is printed.',
        verdict=_verdict(always=abs(norm(1.0) / printed - 1.0) < 1e-9, sometimes=minus < 1e-9),
        condition='the sign before cosh is -',
        evidence=f'The printed norm of the first mode is that of the form with - cosh (to '
        f'{minus:.0e}) and {norm(1.0) / printed:.3g} times off with +, which would move the '
        'needle '
        f'sideways at its entry: phi_1(0) = {entry:.2g} instead of 0.',
        numbers={'minus': minus, 'plus': norm(1.0) / printed, 'entry': entry},
    )


def two_modes() -> Claim:
    """How good two modes are."""
    model = needle('paper_si', 'complete')
    short, slow, fast = {}, {}, {}
    for depth in _DEPTHS:
        value = model.modes.integrals(depth).value
        stiffness = model.stiffness_matrix(depth)
        mass = model.parameters.linear_density * model.modes.integrals(depth).gram
        exact = exact_frequencies(depth)
        found = np.sqrt(eigh(stiffness, mass, eigvals_only=True))
        compliance = float(value @ np.linalg.solve(stiffness, value))
        short[depth] = 1.0 - compliance / exact_compliance(depth)
        slow[depth], fast[depth] = found / exact[:2] - 1.0
    most = max(*short.values(), *slow.values())
    worst = max(fast.values())
    return Claim(
        section='3.2.1, (10)',
        claim='Two dominant modes approximate the deflection.',
        verdict=_verdict(always=max(most, worst) < 0.05, sometimes=most < 0.05),
        condition='the second frequency of a part-inserted needle does not matter',
        evidence='Against the exact beam on its foundation at 2, 10 and 20 cm: deflection under a '
        f'force at the tip within {100.0 * max(short.values()):.1g} %, first frequency within '
        f'{100.0 * max(slow.values()):.1g} %, second frequency up to {100.0 * worst:.0f} % off.',
        numbers={'deflection': max(short.values()), 'first': max(slow.values()), 'second': worst},
    )


def rotation_energy() -> Claim:
    """Kinetic energy of rotation."""
    model = needle('paper_si', 'complete')
    state = model.state_at(DEPTH)
    state[5] = 1.0
    part = model.kinetic_energy(state) / (0.5 * model.parameters.rotary_inertia)
    return Claim(
        section='3.2.1',
        claim='The energy of rotation is I_x theta_dot^2 / 4.',
        verdict=_verdict(always=part == 1.0),
        evidence=f'That is {part:.2g} of the energy I omega^2 / 2 of a rigid body with the mass '
        'moment I_x; a torque turns the needle twice as fast. No figure depends on it.',
        numbers={'part': part},
    )


def axis_of_rotation() -> Claim:
    """Axis that theta turns about."""
    p = NeedleParameters()
    mass = p.linear_density * p.length
    moments = {'across': mass * p.length**2 / 12.0, 'along': 0.5 * mass * p.area / pi}
    ratios = {axis: p.rotary_inertia / moment for axis, moment in moments.items()}
    return Claim(
        section='3.2.1, 3.2.8',
        claim='theta and tau turn about x, across the plane of deflection, with the inertia I_x.',
        verdict=_verdict(always=0.5 < ratios['across'] < 2.0),
        evidence='About x, through its middle, a needle has '
        f'{moments["across"]:.2g} kg m^2; I_x is {ratios["across"]:.1g} of that and '
        f'{ratios["along"]:.1f} times the {moments["along"]:.2g} kg m^2 about its length, which '
        '3.2.8 takes theta to turn about. A turn about x would swing the tip in the plane; in '
        'w(y, t) there is no theta.',
        numbers=ratios,
    )


def table_3() -> Claim:
    """Constants of Table 3."""
    p = NeedleParameters()
    radius = sqrt(p.area / pi)
    second = p.area_moment / (pi * radius**4 / 4.0)
    polar = p.rotary_inertia / (pi * radius**4 / 2.0)
    spun = p.rotary_inertia / (0.5 * p.linear_density * p.length * radius**2)
    return Claim(
        section='3.2.8, Table 3',
        claim='The constants of Table 3 are those of an 18 gauge needle.',
        verdict=_verdict(
            always=max(abs(second - 1.0), abs(polar - 1.0)) < 0.02,
            sometimes=abs(second - 1) < 0.02,
        ),
        condition='I_x is left out',
        evidence=f'A is that of a solid wire of {2e3 * radius:.3f} mm and I_y is {second:.3f} '
        f'times its second moment. I_x, in m^4, is {polar:.0f} times its polar moment; taken in '
        'kg '
        f'm^2 it is {spun:.1f} times the mass moment about the axis.',
        numbers={'second': second, 'polar': polar, 'mass': spun},
    )


def sign_of_force() -> Claim:
    """Sign of f_y in (14)."""
    model = needle('paper_si', 'complete')
    state = model.state_at(DEPTH)
    printed = float(model.acceleration(state, -FORCE)[0])
    return Claim(
        section='3.2.1, (14)',
        claim='f_y enters the row of d with a plus.',
        verdict=_verdict(always=printed < 0.0),
        evidence=f'With +3 N in that row d grows, at {printed:.0f} m/s^2 from rest: a push would '
        'pull the needle out of the tissue. The figures need the minus.',
        numbers={'acceleration': printed},
    )


def friction_direction() -> Claim:
    """Friction against motion, and at rest."""
    model = needle('paper_si', 'complete')
    least = min(model.friction_power(x) for x in _random_states())
    p = model.parameters
    pushed = 0.5 * p.coulomb_friction
    held = float(model.acceleration(model.state_at(DEPTH), pushed)[0])
    return Claim(
        section='3.2.1, (15)',
        claim='Friction mu_s sign(d_dot) + mu_v d_dot always acts against the motion.',
        verdict=_verdict(always=least > 0.0 and held != 0.0, sometimes=least > 0.0),
        condition='the needle moves; at rest it must be set-valued',
        evidence=f'Its power is positive in all states looked at. At rest sign(0) = 0 leaves no '
        f'friction: half of mu_s would move the needle, at {pushed / p.moving_mass:.0f} m/s^2. '
        'Taken as up to mu_s there, it holds it exactly.',
        numbers={'least': least, 'held': held},
    )


def friction_matters() -> Claim:
    """Significance of friction."""
    p = NeedleParameters()
    free = sqrt(2.0 * (p.length - DEPTH) * p.moving_mass / FORCE)
    times = {reading: hub_time(open_loop(reading, 'complete')) for reading in READINGS}
    return Claim(
        section='3.2.1',
        claim='Friction plays a significant role.',
        verdict=_verdict(always=min(times.values()) > 1.1 * free),
        evidence=f'3 N insert the straight needle in {1e3 * free:.1f} ms without it, in '
        f'{1e3 * times["paper_si"]:.1f} ms with 0.3 N s/m and in {times["paper_mm"]:.1f} s with '
        '0.3 N s/mm.',
        numbers={'none': free, **times},
    )


def transients() -> Claim:
    """Judge static against dynamic models."""
    p = NeedleParameters.preset('phantom')
    fade = p.linear_density * 2.0 / p.tissue_damping
    rings = Outcome.of(open_loop('paper_mm', 'complete')).final
    return Claim(
        section='3',
        claim='Static models are not adequate: transients have to be studied.',
        verdict=_verdict(always=False, sometimes=rings > DEFLECTION),
        condition='the insertion is fast, or nothing damps the needle',
        evidence=f"In the paper's model nothing does: 0.5 mm still ring with {1e3 * rings:.2g} mm "
        f'after 22 s of insertion. With a tissue that damps the first mode by 30 % (preset '
        f'phantom) a deflection fades within {1e3 * fade:.0f} ms, a thousandth of that time.',
        numbers={'fade': fade, 'rings': rings},
    )


# 3.2.2, identification.


def reading_of_table_1(tables: Tables) -> Claim:
    """Judge the unit of mu_v."""
    times = {reading: hub_time(open_loop(reading, 'complete')) for reading in READINGS}
    mean, deviation = tables.friction['mu_v']
    return Claim(
        section='3.2.2.2, Table 1',
        claim='mu_v = 0.3 with an STD of 0.0447.',
        verdict=_verdict(always=False, sometimes=abs(mean - 0.3) < 2.0 * 0.0447),
        condition='read in N s/mm',
        evidence=f'No unit is printed. 3 N insert the needle in {1e3 * times["paper_si"]:.1f} ms '
        f'if it is N s/m and in {times["paper_mm"]:.1f} s if it is N s/mm, which is a pace of '
        f'clinical use. From {tables.source}: {mean:.3g} with an STD of {deviation:.2g} N s/mm.',
        numbers={**times, 'mean': mean, 'deviation': deviation},
    )


def identifiable(tables: Tables) -> Claim:
    """Friction from simple experiments."""
    mean, deviation = tables.friction['mu_s']
    error = deviation / sqrt(tables.repeats)
    apart = abs(mean - TABLE_1['mu_s'][0]) / error
    return Claim(
        section='abstract, 3.2.2',
        claim='All parameters are measurable or identifiable by simple experiments.',
        verdict=_verdict(always=False, sometimes=apart < 3.0),
        condition='the length of contact behind k_a is known as well',
        evidence=f'From {tables.source}: mu_s = {mean:.4f} with an STD of {deviation:.3f} N in '
        f'{tables.repeats} experiments, {apart:.1f} standard errors from 0.56 N. k_zz of the '
        'indentation is a force per displacement, k_a one per displacement and length.',
        numbers={'apart': apart},
    )


def _variations(tables: Tables, entry: str) -> FloatArray:
    means, deviations = (np.array(values) for values in tables.stiffness[entry])
    return np.asarray(deviations / np.abs(means))


def consistency(tables: Tables) -> Claim:
    """Scatter of Table 2."""
    scatter = {entry: _variations(tables, entry) for entry in ('k_xx', 'k_zz')}
    small = np.maximum(*scatter.values()) < 0.15
    levels = ', '.join(f'{level:g}' for level, one in zip(LEVELS, small, strict=True) if one)
    words = ' and '.join(
        f'{100.0 * values.min():.0f} to {100.0 * values.max():.0f} % of {entry}'
        for entry, values in scatter.items()
    )
    return Claim(
        section='3.2.2.3, Table 2',
        claim='Consistency is evident from the small STD of k_xx and k_zz.',
        verdict=_verdict(always=bool(small.all()), sometimes=bool(small.any())),
        condition=f'the force is {levels} N',
        evidence=f'From {tables.source}: STD {words}. k_a, from 1.5 N, is known to '
        f'{100.0 * scatter["k_zz"][-1]:.0f} % in a place.',
        numbers={f'{entry} at {LEVELS[-1]} N': float(v[-1]) for entry, v in scatter.items()},
    )


def spring(tables: Tables) -> Claim:
    """Whether the tissue is a spring."""
    entries = {name: np.array(values) for name, values in tables.stiffness.items()}
    mean = {name: value[0] for name, value in entries.items()}
    curl = mean['k_xz'] - mean['k_zx']
    matrices = np.stack([mean[name] for name in ('k_xx', 'k_xz', 'k_zx', 'k_zz')], axis=-1)
    part = np.array([asymmetry(matrix) for matrix in matrices.reshape(-1, 2, 2)])
    limit = StiffnessSettings().largest_asymmetry
    error = np.hypot(entries['k_xz'][1], entries['k_zx'][1]) / sqrt(tables.repeats)
    sigmas = np.abs(curl) / error
    return Claim(
        section='3.2.2.3',
        claim='The antisymmetric part is small: the tissue is a spring.',
        verdict=_verdict(always=bool((sigmas < 2.0).all()), sometimes=bool((part <= limit).all())),
        condition=f'a curl of up to {100.0 * part.max():.0f} % counts as none',
        evidence=f'From {tables.source}: antisymmetric over symmetric part '
        f'{100.0 * part.min():.1f} to {100.0 * part.max():.1f} % (Frobenius). Over '
        f'{tables.repeats} places the curl is {sigmas.min():.1f} to {sigmas.max():.1f} standard '
        'errors from zero: it is small, and it is there.',
        numbers={'least': float(part.min()), 'most': float(part.max()), 'sigmas': sigmas.min()},
    )


def linear(tables: Tables) -> Claim:
    """Linearity over the forces."""
    k = np.array(tables.stiffness['k_zz'][0])
    fall = 1.0 - k[-1] / k[0]
    return Claim(
        section='3.2.2.3',
        claim='For the small displacements applied, force and displacement are linear.',
        verdict=_verdict(always=abs(fall) < 0.1),
        evidence=f'From {tables.source}: k_zz falls by {100.0 * fall:.0f} % from 1.1 to 1.5 N. '
        f'k_a is that of 1.5 N; from 1.1 N it would be {k[0] / k[-1]:.1f} times as much.',
        numbers={'fall': float(fall)},
    )


def off_plane(tables: Tables) -> Claim:
    """Difference of k_xx and k_zz."""
    xx, zz = (np.array(tables.stiffness[name][0]) for name in ('k_xx', 'k_zz'))
    apart = np.abs(xx - zz) / (0.5 * (xx + zz))
    grows = bool(apart[2:].min() > apart[:2].max())
    return Claim(
        section='3.2.2.3',
        claim='For bigger forces k_xx is not close to k_zz, because of off-plane motion.',
        verdict=_verdict(always=False, sometimes=grows),
        condition='off-plane motion is the cause, which the table cannot tell',
        evidence=f'From {tables.source}: they differ by '
        + ', '.join(
            f'{100.0 * value:.0f} % at {level:g} N'
            for level, value in zip(LEVELS, apart, strict=True)
        )
        + '. A tissue that gives way differently along x and z would do the same.',
        numbers={f'{level:g} N': float(v) for level, v in zip(LEVELS, apart, strict=True)},
    )


def tissue_stiffness(tables: Tables) -> Claim:
    """Judge the unit of k_a."""
    k = tables.stiffness['k_zz'][0][-1]
    return Claim(
        section='3.2.2.3',
        claim='k_a was found to be 0.52 kN/m^2.',
        verdict=_verdict(always=False, sometimes=abs(k - 0.52) < 2.0 * 0.18),
        condition='the indenter touches the tissue over 1 m',
        evidence=f'From {tables.source}: k_zz = {k:.2f} kN/m at 1.5 N, a force per displacement. '
        f'Over a contact of 1 cm it would be k_a = {100.0 * k:.0f} kN/m^2. Table 2 prints no '
        'unit.',
        numbers={'k_zz': k},
    )


# 3.2.3 to 3.2.6, analysis.


@cache
def _analyses(deflection: float) -> tuple[Analysis, ...]:
    """Analyze the moving needle at three depths, in both readings and formulations."""
    found = []
    for case in CASES:
        model = needle(*case)
        for depth in _DEPTHS:
            state = operating_point(model, depth, deflection, _SPEED)
            found.append(analyze(linearize(model, state)))
    return tuple(found)


def controllability() -> Claim:
    """State controllability."""
    bent, straight = _analyses(DEFLECTION), _analyses(0.0)
    ranks = {one.state.rank for one in bent}, {one.state.rank for one in straight}
    least = min(one.state.distance for one in bent)
    full = ranks[0] == {8}
    return Claim(
        section='3.2.5, 3.2.9',
        claim='The linearized system is fully controllable around some operating points.',
        verdict=_verdict(always=full and ranks[1] == {8}, sometimes=full),
        condition='the needle is deflected',
        evidence='At the operating points of 3.2.4, with q1 = q2 = 0, the rank is '
        f'{min(ranks[1])} of 8: f_y and tau cannot bend a straight needle. With 0.5 mm it is '
        f'{min(ranks[0])}, {least:.1e} from losing it in natural units. The rank of the printed '
        'matrix in SI units is rounding.',
        numbers={'bent': min(ranks[0]), 'straight': min(ranks[1]), 'distance': least},
    )


def output_controllability() -> Claim:
    """Output controllability."""
    bent, straight = _analyses(DEFLECTION), _analyses(0.0)
    steered = all(one.output_controllable for one in bent)
    none = not any(one.output_controllable for one in straight)
    return Claim(
        section='3.2.5',
        claim='Output controllability is not satisfied for most of the operating points.',
        verdict=_verdict(always=none and not steered, sometimes=none),
        condition='the needle is straight',
        evidence='The paper asks a matrix of one row for rank m = 2, the number of inputs, which '
        'no point can have. With the number of outputs, 1, all points with a deflection of 0.5 mm '
        'have it and no straight one.',
        numbers={'bent': float(steered), 'straight': float(not none)},
    )


def state_and_output() -> Claim:
    """Judge output controllability where the state is controllable."""
    found = [*_analyses(DEFLECTION), *_analyses(0.0)]
    full = [one for one in found if one.state.rank == one.state.order]
    steered = sum(one.output_controllable for one in full)
    return Claim(
        section='3.2.5',
        claim='A state controllable system is not necessarily output controllable.',
        verdict=_verdict(always=steered < len(full), sometimes=bool(full)),
        condition='outputs depend on one another, which a single one cannot',
        evidence=f'{len(full)} of {len(found)} points looked at are state controllable, and '
        f'{steered} of these are output controllable: the tip deflection is one row C, not zero. '
        'So the two findings of 3.2.5 cannot both be had at one point.',
        numbers={'state': len(full), 'output': steered},
    )


def inadequate() -> Claim:
    """How much the base moves the tip."""
    gains = [one.output_gain for one in _analyses(DEFLECTION)]
    return Claim(
        section='3.2.5',
        claim='f_y and tau are inadequate for maneuvering the needle.',
        verdict=_verdict(always=max(gains) < 0.1),
        evidence=f'A move of the base by 1 mm moves the tip sideways by {min(gains):.4f} to '
        f'{max(gains):.3f} mm at 2 to 20 cm, deflected by 0.5 mm.',
        numbers={'least': min(gains), 'most': max(gains)},
    )


def observability() -> Claim:
    """Rank of the observability matrix."""
    lost = {
        name: {8 - one.observed.rank for one in _analyses(w)}
        for name, w in (('bent', DEFLECTION), ('straight', 0.0))
    }
    return Claim(
        section='3.2.6',
        claim='The observability matrix has a rank deficiency of 2.',
        verdict=_verdict(
            always=lost == {'bent': {2}, 'straight': {2}}, sometimes=lost['bent'] == {2}
        ),
        condition='the needle is deflected',
        evidence='Deflected, theta and theta_dot do not show in the tip: 2. Straight, d and d_dot '
        f'do not either: {max(lost["straight"])}.',
        numbers={name: max(values) for name, values in lost.items()},
    )


def modes_observable() -> Claim:
    """Observability of q1 and q2."""
    seen = [*_analyses(DEFLECTION), *_analyses(0.0)]
    hidden = {name for one in seen for name in (*one.observed.lost, *one.observed.combined)}
    margin = min(one.observed.margin for one in _analyses(0.0))
    bending = not any(name.startswith(('q', 'bending')) for name in hidden)
    return Claim(
        section='3.2.6',
        claim='q1 and q2 are observable.',
        verdict=_verdict(always=bending),
        evidence='At no point looked at, straight or deflected, is one of them or of their rates '
        f'hidden; straight, what shows is {margin:.2f} from being lost, in natural units.',
        numbers={'margin': margin},
    )


# 3.2.7 and 3.2.8, controllers.


def error_equation() -> Claim:
    """Judge the closed loop of inverse dynamics."""
    run = closed_loop('inverse_dynamics', 'paper_si', 'complete')
    late = run.time <= 20.0
    times, start = run.time[late], run.model.state_at(DEPTH, DEFLECTION)
    errors = []
    for k, kp in ((0, 1.0), (2, 10.0), (3, 10.0)):
        damping = 0.05 * kp
        w = sqrt(kp - damping**2)
        exact = np.exp(-damping * times) * (np.cos(w * times) + damping / w * np.sin(w * times))
        errors.append(float(np.abs(run.states[late, k] / start[k] - exact).max()))
    p = run.model.parameters
    pushed = p.moving_mass * (p.length - DEPTH)
    return Claim(
        section='3.2.7.1',
        claim='Inverse dynamics gives q_ddot_e + k_v q_dot_e + k_p q_e = 0: the error goes to 0.',
        verdict=_verdict(always=False, sometimes=max(errors) < 1e-3),
        condition='friction counts at rest in the direction of the motion that begins',
        evidence=f'Then d, q1 and q2 follow the equation to {max(errors):.0e}. With sign(0) = 0 '
        f'as printed, the law pushes with M k_p e = {1e3 * pushed:.2f} mN at the start against '
        f'{p.coulomb_friction:g} N of friction, and the needle never moves.',
        numbers={'error': max(errors), 'pushed': pushed},
    )


def positive_definite() -> Claim:
    """Positive definite gains and stability."""
    p = NeedleParameters.preset('paper_mm')
    gains = PidGains(kp=PID_KP, ki=0.0, kd=PID_KV, tolerance=0.0)
    radii = {
        rate: stability_limit(
            Pid(axis=Axis.insertion(p), gains=gains, period=1.0 / rate), 1
        ).radius
        for rate in (1e3, 1e6)
    }
    # One period of the textbook form: the pole of d_dot under its held force.
    ends = [
        Outcome.of(closed_loop(law, 'paper_mm', 'complete', hub_stop=True)).final
        for law in figures.LAWS
    ]
    x = p.viscous_friction * 1e-3 / p.moving_mass
    textbook = 1.0 - x * decay_means(x)[0] - decay_means(x)[0] * 1e-3 * PID_KV / p.moving_mass
    return Claim(
        section='3.2.7.1',
        claim='Positive definite k_p and k_v make the closed loop stable.',
        verdict=_verdict(always=max(radii.values()) < 1.0, sometimes=max(ends) < 1e-6),
        condition='the law runs in continuous time',
        evidence='In continuous time the runs of figures 6 to 8 come to rest. Sampled at 1 kHz '
        'the PID gains of the paper move d with a pole at '
        f'{textbook:.0f} in the textbook form. In the implicit form, with one period of delay and '
        f'one in reserve, the spectral radius is {radii[1e3]:.6g} at 1 kHz and {radii[1e6]:.6g} '
        'at 1 MHz.',
        numbers={'1 kHz': radii[1e3], '1 MHz': radii[1e6], 'textbook': textbook},
    )


def same_inputs() -> Claim:
    """Judge the inputs of model and controllers."""
    start = {
        law: closed_loop(law, 'paper_si', 'complete', hub_stop=True).forces[0]
        for law in figures.LAWS
    }
    return Claim(
        section='abstract, 3.2.7',
        claim='The model has the inputs of manual insertion, f_y and tau, and is controlled so.',
        verdict=_verdict(
            always=not any(force[2:].any() for force in start.values()), sometimes=True
        ),
        condition='the laws push on the base alone, unlike those of figures 6 to 8',
        evidence='The gain matrices push on q1 and q2, whose rows of F are zero in (14): with '
        + ' and '.join(
            f'{force[2]:.2g} and {force[3]:.2g} N m^-1/2 at the start ({figures.LAWS[law]})'
            for law, force in start.items()
        )
        + '. No motor of a needle robot applies that.',
        numbers={law: float(force[2]) for law, force in start.items()},
    )


def tip_varies() -> Claim:
    """Figure 4."""
    found = [Outcome.of(open_loop(*case)) for case in CASES]
    turns = _turns(open_loop('paper_si', 'complete'))
    return Claim(
        section='3.2.8, figure 4',
        claim='The tip deflection varies as the needle passes through the tissue.',
        verdict=_verdict(always=all(abs(one.peak) > DEFLECTION for one in found)),
        evidence=f'It changes sign {turns} times on the way (0.3 N s/m, complete) and reaches '
        f'{1e3 * found[0].peak:.2f} mm at {1e3 * found[0].peak_time:.0f} ms.',
        numbers={'turns': turns, 'peak': found[0].peak},
    )


def _turns(run: LoopRun) -> int:
    """Return how often the tip changes sides by more than rounding."""
    tip = run.tip_deflection
    tip = tip[np.abs(tip) > 1e-9]
    return int(np.count_nonzero(np.diff(np.sign(tip))))


def smoother() -> Claim:
    """Smoothness of the closed loop."""
    free = open_loop('paper_mm', 'complete')
    rates = {'open loop': _turns(free) / float(free.time[-1])}
    for law in figures.LAWS:
        run = closed_loop(law, 'paper_mm', 'complete', hub_stop=True)
        rates[law] = _turns(run) / float(run.time[-1])
        alone = base_alone(law, 'paper_mm')
        rates[f'{law}, f_y alone'] = _turns(alone) / float(alone.time[-1])
    controlled = max(rates[law] for law in figures.LAWS)
    alone_rate = min(rates[f'{law}, f_y alone'] for law in figures.LAWS)
    peaks = {
        law: abs(Outcome.of(closed_loop(law, 'paper_mm', 'complete', hub_stop=True)).peak)
        for law in figures.LAWS
    }
    peak = abs(Outcome.of(free).peak)
    return Claim(
        section='3.2.8',
        claim='The controlled tip deflection is smoother.',
        verdict=_verdict(always=alone_rate < 1.0, sometimes=controlled < 0.1 * rates['open loop']),
        condition='generalized forces act on q1 and q2',
        evidence=f'Changes of side per second: {rates["open loop"]:.0f} or more in the open loop '
        f'(0.3 N s/mm), {controlled:.2f} at most under control; with f_y alone {alone_rate:.0f} '
        'or '
        'more. Smoother is not smaller: the peak is '
        f'{1e3 * peaks["inverse_dynamics"]:.0f} mm (inverse dynamics) and '
        f'{1e3 * peaks["pid"]:.0f} mm (PID) instead of {1e3 * peak:.1f} mm.',
        numbers={**rates, **{f'peak, {law}': value for law, value in peaks.items()}},
    )


def zero_deflection() -> Claim:
    """Inverse dynamics to zero deflection."""
    modal = max(
        Outcome.of(closed_loop('inverse_dynamics', *case, hub_stop=hub)).final
        for case in CASES
        for hub in (False, True)
    )
    alone = min(Outcome.of(base_alone('inverse_dynamics', reading)).final for reading in READINGS)
    pid = Outcome.of(closed_loop('pid', 'paper_mm', 'complete', hub_stop=True)).final
    return Claim(
        section='3.2.8, figures 6 and 7',
        claim='Inverse dynamics leads to zero deflection as time grows.',
        verdict=_verdict(always=alone < 1e-6, sometimes=modal < 1e-6),
        condition='generalized forces act on q1 and q2',
        evidence=f'With them the tip ends within {1e9 * modal:.2g} nm of it in all four cases. '
        f'With f_y alone it rings on with {1e3 * alone:.1f} mm. PID reaches zero deflection too, '
        f'within {1e9 * pid:.1g} nm.',
        numbers={'modal': modal, 'alone': alone, 'pid': pid},
    )


def fully_inserted() -> Claim:
    """Wanted state and hub."""
    free, held = (
        Outcome.of(closed_loop('inverse_dynamics', 'paper_si', 'complete', hub_stop=hub))
        for hub in (False, True)
    )
    arrival = hub_time(closed_loop('inverse_dynamics', 'paper_si', 'complete', hub_stop=True))
    return Claim(
        section='3.2.8',
        claim='q_d = 0 is the fully inserted needle, which the controlled system comes to.',
        verdict=_verdict(always=free.deepest <= 0.2, sometimes=held.deepest <= 0.2),
        condition='the hub stops it',
        evidence=f'With the gains printed d has a damping ratio of 0.05 and overshoots: '
        f'{100.0 * free.deepest:.0f} cm of a 20 cm needle inserted. On a hub it stops at d = 0 '
        f'after {arrival:.1f} s.',
        numbers={'deepest': free.deepest, 'arrival': arrival},
    )


def position_error() -> Claim:
    """Position error of PID."""
    found = {case: Outcome.of(closed_loop('pid', *case, hub_stop=True)).error for case in CASES}
    bound = NeedleParameters().coulomb_friction / PID_KP
    near = all(abs(value - bound) < 1e-2 * bound for value in found.values())
    return Claim(
        section='3.2.8, figure 8',
        claim='PID results in a nonzero position error.',
        verdict=_verdict(always=near),
        evidence='d ends at '
        f'{1e3 * found["paper_mm", "complete"]:.3f} mm = mu_s / k_p = {1e3 * bound:.2f} mm in all '
        'four cases. It is Coulomb friction against a proportional force; the gains printed have '
        'no integral, which would take it away.',
        numbers={', '.join(case): value for case, value in found.items()},
    )


def minimum_deflection() -> Claim:
    """PID gains of minimum deflection."""
    peaks = {
        (kp, kv): abs(
            Outcome.of(
                closed_loop('pid', 'paper_mm', 'complete', hub_stop=True, factors=(kp, kv))
            ).peak
        )
        for kp, kv in ((1.0, 1.0), (2.0, 1.0), (0.5, 1.0), (1.0, 2.0), (1.0, 0.5))
    }
    paper, same = peaks[1.0, 1.0], peaks[1.0, 0.5]
    best = min(peaks, key=lambda factors: peaks[factors])
    return Claim(
        section='3.2.8, figure 8',
        claim='The PID gains printed give the minimum needle deflection.',
        verdict=_verdict(always=best == (1.0, 1.0)),
        evidence=f'Peak {1e3 * paper:.1f} mm (0.3 N s/mm). With k_v halved it is '
        f'{1e3 * same:.1f} mm at the same position error; the least of {len(peaks)} pairs a '
        f'factor 2 apart is {1e3 * peaks[best]:.1f} mm, with k_p times {best[0]:g} and k_v times '
        f'{best[1]:g}; the printed one is number {sorted(peaks.values()).index(paper) + 1}.',
        numbers={f'k_p {kp:g}, k_v {kv:g}': value for (kp, kv), value in peaks.items()},
    )


def informed(study: mismatch.Mismatch) -> Claim:
    """Whether knowledge of the model helps."""
    model = needle('paper_mm', 'complete')
    p = model.parameters
    believed = NeedleModel(replace(p, coulomb_friction=0.99 * p.coulomb_friction))
    law = figures.paper_law('inverse_dynamics', believed)
    run = run_continuous(
        law, model, model.state_at(DEPTH, DEFLECTION), np.zeros((3, 4)), [0.0, 30.0],
        method='DOP853',
    )  # fmt: skip
    left = float(run.states[-1, 0])
    printed = {
        law: abs(Outcome.of(closed_loop(law, 'paper_mm', 'complete', hub_stop=True)).error)
        for law in figures.LAWS
    }
    finals = {law: np.median(np.abs(b.final)) for law, b in study.batches.items()}
    known = {law: float(b.rms[0]) for law, b in study.nominal.items()}
    return Claim(
        section='3.2.8, 3.2.9',
        claim='The controller that is informed by the model follows better.',
        verdict=_verdict(
            always=finals['inverse_dynamics'] < finals['pid'],
            sometimes=known['inverse_dynamics'] < known['pid'],
        ),
        condition='the model is exact',
        evidence='In figures 6 to 8, with the hub, d ends at '
        f'{1e3 * printed["inverse_dynamics"]:.2g} mm under it and at '
        f'{1e3 * printed["pid"]:.2g} mm under PID, as it is told mu_s. '
        'Sampled at 1 kHz on the needle it knows, the rms error of inverse dynamics is '
        f'{1e6 * known["inverse_dynamics"]:.0f} um against {1e6 * known["pid"]:.0f} um of PID. '
        'With friction and stiffness up to 30 % off, the median error at the end is '
        f'{1e6 * finals["inverse_dynamics"]:.0f} um against {1e6 * finals["pid"]:.0f} um of PID '
        'with its integral. The gains of the paper are worth M k_p = 2 mN/m: with mu_s '
        f'underestimated by 1 % the needle stays where it is, {1e3 * left:.0f} mm from its goal.',
        numbers={'left': left, **{f'final, {k}': float(v) for k, v in finals.items()}},
    )


def not_zero(study: mismatch.Mismatch) -> Claim:
    """Error in reality."""
    least = {law: float(np.abs(b.final).min()) for law, b in study.batches.items()}
    return Claim(
        section='3.2.8',
        claim='In reality the error will not be zero, as models are inaccurate.',
        verdict=_verdict(always=min(least.values()) > 0.0),
        evidence=f'In {len(study.factors)} needles with friction and stiffness up to 30 % off, '
        'the '
        f'least error at the end is {1e6 * least["inverse_dynamics"]:.1f} um (inverse dynamics) '
        f'and {1e6 * least["pid"]:.1f} um (PID, whose integral rests below its tolerance).',
        numbers=least,
    )


_MODEL: Final[tuple[Callable[[], Claim], ...]] = (
    mass_matrix, zero_rows, rates_in_bias, momentum_of_d, conservation, independence,
    two_modes_cause, only_d, deflection_changes, spring_at_the_tip, equation_9, equation_11,
    two_modes, rotation_energy, axis_of_rotation, table_3, sign_of_force, friction_direction,
    friction_matters, transients,
)  # fmt: skip
_DATA: Final[tuple[Callable[[Tables], Claim], ...]] = (
    reading_of_table_1, identifiable, consistency, spring, linear, off_plane, tissue_stiffness,
)  # fmt: skip
_ANALYSIS: Final[tuple[Callable[[], Claim], ...]] = (
    controllability, output_controllability, state_and_output, inadequate, observability,
    modes_observable,
)  # fmt: skip
_CONTROL: Final[tuple[Callable[[], Claim], ...]] = (
    error_equation, positive_definite, same_inputs, tip_varies, smoother, zero_deflection,
    fully_inserted, position_error, minimum_deflection,
)  # fmt: skip


def claims(
    tables: Tables | None = None,
    study: mismatch.Mismatch | None = None,
    progress: Callable[[], object] | None = None,
) -> list[Claim]:
    """
    Judge every claim.

    Parameters
    ----------
    tables : Tables, optional
        Statistics behind Tables 1 and 2, as identified from recordings; the printed ones if not
        given.
    study : Mismatch, optional
        The mismatch study; a small one is run if not given.
    progress : callable, optional
        Called after each claim.

    Returns
    -------
    list of Claim
        In the order of the paper.

    """
    tables, study = tables or Tables(), study or mismatch.study(60)
    jobs: list[Callable[[], Claim]] = [
        *_MODEL,
        *((lambda judge=judge: judge(tables)) for judge in _DATA),
        *_ANALYSIS,
        *_CONTROL,
        lambda: informed(study),
        lambda: not_zero(study),
    ]
    found = []
    for job in jobs:
        found.append(job())
        if progress is not None:
            progress()
    return found


def section(found: list[Claim] | None = None) -> Section:
    """
    Return the claims for the page.

    Parameters
    ----------
    found : list of Claim, optional
        From `claims`; judged now if not given.

    Returns
    -------
    Section
        Plain data.

    """
    found = claims() if found is None else found
    verdicts = [one.verdict for one in found]
    return Section(
        title='What the paper claims',
        paragraphs=(
            (
                f'{len(found)} claims: {verdicts.count(HOLDS)} hold, {verdicts.count(ONLY_IF)} '
                f'hold only if a condition is met, {verdicts.count(FAILS)} do not hold. The '
                'numbers beside each are computed in this run, and decide. Where one turns on a '
                'unit, on a cause that data cannot tell or on what it leaves unsaid, numbers can '
                'refute it, but the condition is our judgment. Statements on the literature and '
                'on clinical practice are not among them.'
            ),
        ),
        tables=(
            Grid(
                caption='Claims with verdict and evidence',
                heads=('claim', 'where', 'verdict', 'evidence'),
                rows=tuple((one.claim, one.section, one.words, one.evidence) for one in found),
            ),
        ),
    )
