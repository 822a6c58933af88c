# SPDX-License-Identifier: Apache-2.0
"""Verdicts on claims about model assumptions, sections 3.2.1 to 3.2.4 and 3.2.8."""

from dataclasses import replace
from math import log, pi

from needle_dynamics import NeedleModel, NeedleParameters
import numpy as np
from reproduction.beam import ENTRIES, whole_needle
from reproduction.claims.claim import Finding, finding
from reproduction.runs import DEFLECTION, DEPTH, FORCE, hub_time, needle, open_loop
from scipy.linalg import eigh
from scipy.optimize import brentq

#: Smallest bore of an 18 gauge tube with regular wall [m], and outer diameter: ISO 9626.
_BORE, _OUTER = 0.79e-3, 1.27e-3

#: Depth of a second layer [m], larger than the decay length of a deflection in the tissue.
_LAYER = 0.15


def _first_frequency(model: NeedleModel, depth: float) -> float:
    """Return the first natural frequency of the model at a depth [Hz]."""
    gram = model.modes.integrals(depth).gram
    stiffness = model.stiffness_matrix(depth)
    squares = eigh(stiffness, model.parameters.linear_density * gram, eigvals_only=True)
    return float(np.sqrt(squares[0])) / (2.0 * pi)


def _compliance(model: NeedleModel, depth: float) -> float:
    """Return the deflection of the tip per lateral force at the tip [m/N]."""
    value = model.modes.integrals(depth).value
    return float(value @ np.linalg.solve(model.stiffness_matrix(depth), value))


def _bending_outside() -> Finding:
    """Test the clamp at the entry against a beam that also bends outside."""
    model = needle('paper_si', 'complete')
    p = model.parameters
    free, pinned, guided = (whole_needle(p, DEPTH, entry) for entry in ENTRIES)
    clamped = _compliance(model, DEPTH)
    return finding(
        {
            'model_hz': _first_frequency(model, DEPTH),
            'model_mm': 1e3 * clamped,
            'free_hz': free.frequency,
            'free_mm': 1e3 * free.compliance,
            'pinned_hz': pinned.frequency,
            'pinned_mm': 1e3 * pinned.compliance,
            'free_felt': free.force,
            'pinned_felt': pinned.force,
            'guided_felt': guided.force,
        },
        always=free.compliance < 1.1 * clamped,
        sometimes=abs(guided.compliance / clamped - 1.0) < 0.1,
    )


def _three_dimensions() -> Finding:
    """Test bending in a second plane: row d of N adds both planes, as it is quadratic."""
    model = needle('paper_si', 'complete')
    one = model.bias_forces(model.state_at(DEPTH, DEFLECTION))
    # Deflections w in both planes store the same energy as sqrt(2) w in a single plane.
    both = model.bias_forces(model.state_at(DEPTH, np.sqrt(2.0) * DEFLECTION))
    return finding(
        {'one': abs(float(one[0])), 'both': abs(float(both[0]))},
        always=False,
        sometimes=abs(both[0] - 2.0 * one[0]) < 1e-9 * abs(one[0]),
    )


def _linearization() -> Finding:
    """Test the linearized system by the insertion that changes its first frequency by 10 %."""
    model = needle('paper_si', 'complete')
    there = _first_frequency(model, DEPTH)

    def change(advance: float) -> float:
        return there / _first_frequency(model, DEPTH + advance) - 1.1

    advance = float(brentq(change, 1e-5, 0.1))
    return finding(
        {'way_mm': 1e3 * advance, 'insertion_mm': 1e3 * (model.parameters.length - DEPTH)},
        always=advance > model.parameters.length - DEPTH,
        sometimes=True,
    )


def _friction_length() -> Finding:
    """Compare constant friction with friction proportional to the insertion depth."""
    p = NeedleParameters.preset('paper_mm')
    # F = (mu_s + mu_v v) s / l without inertia; the integral of ds / v with a = F l / mu_s.
    a = FORCE * p.length / p.coulomb_friction
    advance = a * log((a - DEPTH) / (a - p.length)) - (p.length - DEPTH)
    per_length = p.viscous_friction / p.coulomb_friction * advance
    constant = hub_time(open_loop('paper_mm', 'complete', 0.0))
    return finding(
        {'constant': constant, 'per_length': per_length},
        always=abs(per_length / constant - 1.0) < 0.1,
        sometimes=True,
    )


def _no_cutting() -> Finding:
    """Test friction without the cutting force of a tip in tissue."""
    dry = NeedleParameters().coulomb_friction
    cutting = 1.0
    return finding(
        {'cutting': cutting, 'dry': dry, 'both': dry + cutting}, always=False, sometimes=True
    )


def _cannula() -> Finding:
    """Compare the cross-section with a tube for seeds."""
    p = NeedleParameters()
    bore, tube = _BORE / _OUTER, pi * _OUTER**2 / 4.0
    area = 1.0 - bore**2
    return finding(
        {
            'bore_mm': 1e3 * _BORE,
            'area': 100.0 * area,
            'area_moment': 100.0 * (1.0 - bore**4),
            'solid': 100.0 * p.area / tube,
        },
        always=abs(p.area / tube - area) < 0.05,
        sometimes=abs(p.area / tube - 1.0) < 0.05,
    )


def _stiffness_along() -> Finding:
    """Test k(d, t) with the tip just inside a second layer of twice the stiffness."""
    p = NeedleParameters()
    depth, stiff = _LAYER + 0.01, 2.0 * p.tissue_stiffness
    layered = replace(p, layer_depths=(_LAYER,), layer_stiffnesses=(stiff,))
    along = _compliance(NeedleModel(layered), depth)
    lumped = _compliance(NeedleModel(replace(p, tissue_stiffness=stiff)), depth)
    error = 100.0 * abs(lumped / along - 1.0)
    return finding(
        {'error': error, 'layer_cm': 100.0 * _LAYER}, always=error < 5.0, sometimes=True
    )
