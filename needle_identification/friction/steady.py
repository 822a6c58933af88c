# SPDX-License-Identifier: Apache-2.0
r"""
Test the terms at constant speeds by the scatter of equal strokes.

A residual that depends on the speed is constant within a stroke of constant speed, and resembles
slow noise. The mean forces of the strokes, times their direction, are therefore compared with a
free friction for each speed: an F test of lack of fit [Fisher1922]_, without a model of the noise.
Both directions are required at each speed, because slow noise has opposite signs there.

References
----------
.. [Fisher1922] R. A. Fisher, "The goodness of fit of regression formulae, and the distribution of
   regression coefficients", Journal of the Royal Statistical Society 85(4), 1922.

"""

from typing import Final

from needle_dynamics.arrays import FloatArray, IntArray
from needle_identification.estimation.residual_tests import ResidualTest
from needle_identification.friction.design import Design
import numpy as np
from scipy.special import fdtrc

_SIGNIFICANCE: Final = 1e-4  # probability of a false alarm
_STEADY: Final = 0.05  # tolerance of a constant speed, and of equal speeds
_NOISE: Final = 6.0  # range of the noise of the speed [standard deviations]
_MOST: Final = 0.2  # largest tolerance: less than half of a sine is within it
_SHARE: Final = 0.5  # least part of a stroke with constant speed
_ROUNDING: Final = 1e-3  # relative size of a direction that the terms lack at constant speeds


def misfit_at_speeds(design: Design) -> ResidualTest | None:
    """Return the test if it rejects the terms."""
    speed, way, samples, x = _strokes(design)
    order = np.argsort(speed)
    speed, way = speed[order], way[order]
    group = np.cumsum(np.diff(speed, prepend=0.0) > _STEADY * speed) - 1
    both = (np.abs(np.bincount(group, way)) < np.bincount(group))[group]
    if not both.any():
        return None
    group = np.unique(group[both], return_inverse=True)[1]
    # White noise has equal variance in each row; slow noise makes the test conservative.
    weight = np.sqrt(samples[order][both])[:, np.newaxis]
    x = weight * way[both, np.newaxis] * x[order][both]
    free = np.column_stack([weight * np.eye(int(group[-1]) + 1)[group], x[:, :-1]])
    (lack, few), (noise, more) = _left(x[:, :-1], x[:, -1]), _left(free, x[:, -1])
    between, within = more - few, len(x) - more
    if between < 1 or within < 1 or noise <= 0.0:
        return None
    found = (lack - noise) / between / (noise / within)
    p_value = float(fdtrc(between, within, found))
    if not p_value < _SIGNIFICANCE:
        return None
    names = ', '.join(design.signals.settings.terms)
    words = (
        f'the terms {names} do not describe the friction at constant speeds (p = {p_value:.2g}): '
        'the intervals do not hold'
    )
    return ResidualTest(name='speed', statistic=found, p_value=p_value, words=words)


def _strokes(design: Design) -> tuple[FloatArray, FloatArray, IntArray, FloatArray]:
    """Return speed, direction, samples, and mean regressors and force, of constant strokes."""
    rows, signals = design.rows, design.signals
    size = np.abs(design.velocity[rows])
    starts = np.flatnonzero(np.diff(design.stroke[rows], prepend=-1))
    counts = np.diff(starts, append=len(rows))
    peak = np.maximum.reduceat(size, starts)
    limit = peak - np.minimum(_STEADY * peak + _NOISE * signals.velocity_noise, _MOST * peak)
    steady = size >= np.repeat(limit, counts)
    samples = np.add.reduceat(steady, starts, dtype=np.int_)
    enough = (samples >= signals.correlation) & (samples >= _SHARE * counts)
    x = design.regressors(signals.settings.terms)[:, : design.terms][rows]
    scale = np.sqrt(np.mean(x**2, axis=0))
    table = np.column_stack([size, x / np.where(scale > 0.0, scale, 1.0), signals.force[rows]])
    table = np.add.reduceat(table * steady[:, np.newaxis], starts, axis=0)[enough]
    samples = samples[enough]
    table /= samples[:, np.newaxis]
    return table[:, 0], design.regime[rows[starts[enough]]], samples, table[:, 1:]


def _left(x: FloatArray, y: FloatArray) -> tuple[float, int]:
    """Return the sum of squares that columns leave, and their rank."""
    basis, strengths, _ = np.linalg.svd(x, full_matrices=False)
    basis = basis[:, strengths > _ROUNDING * strengths[0]]
    rest = y - basis @ (basis.T @ y)
    return float(rest @ rest), basis.shape[1]
