# SPDX-License-Identifier: Apache-2.0
"""Verdicts on claims about the model of the needle, section 3.2.1."""

from functools import cache
from math import pi, sqrt

from needle_dynamics import FloatArray, Integrator, mode_shapes, NeedleModel, NeedleParameters
import numpy as np
from reproduction import runs
from reproduction.claims.claim import Finding, finding
from scipy.linalg import eigh


@cache
def _bias(formulation: str) -> tuple[FloatArray, FloatArray]:
    """Return N along the open loop (0.3 N s/m), with the rates and with zero rates."""
    run = runs.open_loop('paper_si', formulation)
    moving = run.states[run.states[:, 0] > 0.0][::5]
    still = moving.copy()
    still[:, 4:] = 0.0
    whole, rest = (np.array([run.model.bias_forces(x) for x in xs]) for xs in (moving, still))
    return whole, rest


def _zero_rows() -> Finding:
    """Test the rows of N for d and theta."""
    model = runs.needle('paper_si', 'complete')
    straight = model.state_at(runs.DEPTH)
    straight[4:6] = -1.0, 1.0
    whole, _ = _bias('complete')
    largest = float(np.abs(whole[:, :2]).max())
    return finding(
        {'largest': largest, 'percent': 100.0 * largest / model.parameters.coulomb_friction},
        always=largest == 0.0,
        sometimes=not np.any(model.bias_forces(straight)[:2]),
    )


def _rates_in_bias() -> Finding:
    """Test the contribution of the rates to row q1 of N."""
    complete, printed = (
        100.0 * float(np.abs(whole - rest)[:, 2].max() / np.abs(whole[:, 2]).max())
        for whole, rest in (_bias('complete'), _bias('as_printed'))
    )
    return finding(
        {'complete': complete, 'printed': printed},
        always=min(complete, printed) > 0.0,
        sometimes=complete > printed,
    )


def _independence() -> Finding:
    """Test the effect of an initial deflection on d."""

    def apart(reading: str, formulation: str) -> float:
        bent, straight = (runs.open_loop(reading, formulation, w) for w in (runs.DEFLECTION, 0.0))
        return float(np.abs(bent.states[:, 0] - straight.states[:, 0]).max())

    printed = max(apart(reading, 'as_printed') for reading in runs.READINGS)
    si, mm = (apart(reading, 'complete') for reading in runs.READINGS)
    part = max(si, mm) / (NeedleParameters().length - runs.DEPTH)
    return finding(
        {'printed': printed, 'si_mm': 1e3 * si, 'mm_mm': 1e3 * mm, 'percent': 100.0 * part},
        always=0.0 < printed < 1e-2,
        sometimes=0.0 < part < 1e-2,
    )


def _two_modes_cause() -> Finding:
    """Test whether this effect vanishes with more modes, over the first 20 ms."""

    def path(modes: int, deflection: float) -> FloatArray:
        p = NeedleParameters(modes=modes, minimum_depth=0.0195)
        integrator = Integrator(p, NeedleModel(p).state_at(runs.DEPTH, deflection))
        found = []
        for _ in range(20):
            integrator.advance(1e-3, runs.FORCE)
            found.append(integrator.state[0])
        return np.array(found)

    one, two, three = (
        1e3 * float(np.abs(path(n, runs.DEFLECTION) - path(n, 0.0)).max()) for n in (1, 2, 3)
    )
    si, mm = (
        runs.hub_time(runs.open_loop(reading, 'complete', 0.0))
        - runs.hub_time(runs.open_loop(reading, 'complete'))
        for reading in runs.READINGS
    )
    return finding(
        {'one_mm': one, 'two_mm': two, 'three_mm': three, 'si_ms': 1e3 * si, 'mm_ms': 1e3 * mm},
        always=three < 0.1 * two,
    )


def _deflection_changes() -> Finding:
    """Test whether only an initial deflection grows during insertion."""
    peaks = {case: abs(runs.RunOutcome.of(runs.open_loop(*case)).peak) for case in runs.CASES}
    straight = max(
        float(np.abs(runs.open_loop(reading, 'complete', 0.0).tip_deflection).max())
        for reading in runs.READINGS
    )
    peak = peaks['paper_si', 'complete']
    return finding(
        {
            'peak_mm': 1e3 * peak,
            'grown': peak / runs.DEFLECTION,
            'printed_mm': 1e3 * peaks['paper_si', 'as_printed'],
        },
        always=straight == 0.0 and min(peaks.values()) > runs.DEFLECTION,
    )


def _spring_at_the_tip() -> Finding:
    """Compare a spring at the tip with the tissue by the energy in the mode shapes."""
    model = runs.needle('paper_si', 'complete')
    at = model.modes.integrals(runs.DEPTH)
    shapes = eigh(model.stiffness_matrix(runs.DEPTH), model.parameters.linear_density * at.gram)[
        1
    ].T
    tissue = np.array([shape @ at.gram @ shape for shape in shapes])
    tip = (shapes @ at.value) ** 2
    ratio = float(tip[1] / tip[0] * tissue[0] / tissue[1])
    return finding({'ratio': ratio}, always=abs(ratio - 1.0) < 0.02, sometimes=True)


def _two_modes() -> Finding:
    """Compare two modes with the exact clamped beam on an elastic foundation."""
    model = runs.needle('paper_si', 'complete')
    p = model.parameters
    decay = (p.tissue_stiffness / (4.0 * p.bending_stiffness)) ** 0.25
    roots = mode_shapes(p.length, 2).arguments
    errors = []
    for depth in (0.02, 0.1, 0.2):
        at, stiffness = model.modes.integrals(depth), model.stiffness_matrix(depth)
        x = decay * depth
        # E I w'''' + k_a w = 0 under a force of 1 N at the tip.
        shape = np.sinh(x) * np.cosh(x) - np.sin(x) * np.cos(x)
        exact = 2.0 * decay / p.tissue_stiffness * shape / (np.cosh(x) ** 2 + np.cos(x) ** 2)
        compliance = at.value @ np.linalg.solve(stiffness, at.value)
        squares = eigh(stiffness, p.linear_density * at.gram, eigvals_only=True)
        bending = p.bending_stiffness * (roots / depth) ** 4
        excess = np.sqrt(squares * p.linear_density / (bending + p.tissue_stiffness)) - 1.0
        errors.append((1.0 - compliance / exact, *excess))
    deflection, first, second = map(float, np.max(errors, axis=0))
    return finding(
        {'deflection': 100.0 * deflection, 'first': 100.0 * first, 'second': 100.0 * second},
        always=max(deflection, first, second) < 0.05,
        sometimes=max(deflection, first) < 0.05,
    )


def _axis_of_rotation() -> Finding:
    """Identify the axis of theta by the moments of inertia of a round wire."""
    p = NeedleParameters()
    mass = p.linear_density * p.length
    across, along = mass * p.length**2 / 12.0, 0.5 * mass * p.area / pi
    of_across, of_along = p.rotary_inertia / across, p.rotary_inertia / along
    return finding(
        {'across': across, 'along': along, 'of_across': of_across, 'of_along': of_along},
        always=0.5 < of_across < 2.0,
    )


def _friction_matters() -> Finding:
    """Compare the duration of an insertion with and without friction."""
    p = NeedleParameters()
    free = sqrt(2.0 * (p.length - runs.DEPTH) * p.moving_mass / runs.FORCE)
    si, mm = (runs.hub_time(runs.open_loop(reading, 'complete', 0.0)) for reading in runs.READINGS)
    return finding(
        {'none_ms': 1e3 * free, 'si_ms': 1e3 * si, 'mm_s': mm}, always=min(si, mm) > 1.1 * free
    )


def _transients() -> Finding:
    """Test static models by the decay time of a deflection."""
    p = NeedleParameters.preset('phantom')
    fade = p.linear_density * 2.0 / p.tissue_damping
    rings = runs.RunOutcome.of(runs.open_loop('paper_mm', 'complete')).final
    return finding(
        {'rings_mm': 1e3 * rings, 'fade_ms': 1e3 * fade},
        always=False,
        sometimes=rings > runs.DEFLECTION,
    )
