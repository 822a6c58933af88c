"""Principal stiffnesses and directions of the symmetric part of the stiffness matrix."""

from __future__ import annotations

from dataclasses import replace
from math import atan2, hypot, nan

from needle_dynamics.arrays import FloatArray
from needle_identification.estimation.estimate import ParameterEstimate
from needle_identification.stiffness.matrix import MatrixFit
from needle_identification.stiffness.plateaus import ROUNDING
import numpy as np
from scipy.special import fdtri


def principal_estimates(
    fit: MatrixFit,
) -> tuple[ParameterEstimate, ParameterEstimate, ParameterEstimate]:
    """
    Return larger and smaller principal stiffness [N/m], and direction of the larger [rad].

    If both agree within their errors, they are biased apart: their intervals then include the
    interval of their mean, and the direction (from x toward z) is undetermined.
    """
    k = fit.matrix
    half, shear = (k[0, 0] - k[1, 1]) / 2.0, (k[0, 1] + k[1, 0]) / 2.0
    mean, radius = (k[0, 0] + k[1, 1]) / 2.0, hypot(half, shear)
    stretch, slide = np.diag([0.5, -0.5]), np.array([[0.0, 0.5], [0.5, 0.0]])
    cosine, sine = (half / radius, shear / radius) if radius > 0.0 else (1.0, 0.0)
    outward, around = cosine * stretch + sine * slide, cosine * slide - sine * stretch
    middle = fit.derived('', '', '', mean, np.eye(2) / 2.0)
    differ = fit.known.all() and _differ(fit, np.array([half, shear]), stretch, slide)
    found = []
    for number, sign in ((1, 1.0), (2, -1.0)):
        one = fit.derived(
            f'principal_stiffness_{number}',
            f'k_{number}',
            'N/m',
            mean + sign * radius,
            np.eye(2) / 2.0 + sign * outward,
        )
        if one.determined and not differ:
            ends = (*one.interval, *middle.interval)
            one = replace(one, interval=(min(ends), max(ends)))
        found.append(one)
    angle = fit.derived(
        'principal_angle',
        'phi',
        'rad',
        atan2(shear, half) / 2.0 if differ else nan,
        around / (2.0 * (radius or 1.0)),
    )
    return found[0], found[1], angle


def _differ(fit: MatrixFit, found: FloatArray, stretch: FloatArray, slide: FloatArray) -> bool:
    """Test at 1 % whether the two principal stiffnesses differ (F test)."""
    (a, _), (b, _), (c, freedom) = (fit.variance_of(g) for g in (stretch, slide, stretch + slide))
    covariance = np.array([[a, (c - a - b) / 2.0], [(c - a - b) / 2.0, b]])
    if np.linalg.det(covariance) <= 0.0:
        return bool(np.linalg.norm(found) > ROUNDING * np.linalg.norm(fit.matrix))
    return bool(found @ np.linalg.solve(covariance, found) / 2.0 > fdtri(2, freedom, 0.99))
