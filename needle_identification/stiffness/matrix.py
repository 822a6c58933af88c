# SPDX-License-Identifier: Apache-2.0
r"""
Fit the stiffness matrix of a force level, and test whether the tissue is a spring.

.. math:: F = K d, \qquad K = \begin{bmatrix} k_{xx} & k_{xz} \\ k_{zx} & k_{zz} \end{bmatrix}

F is the force on the tissue and d the displacement of the end-effector, section 3.2.2.3 of
the paper. The force of the tissue is -K d. The tissue is a spring if the curl

.. math:: \frac{\partial F_x}{\partial z} - \frac{\partial F_z}{\partial x} = k_{zx} - k_{xz}

is zero, that is, if K is symmetric. The dimensionless measure is the Frobenius norm of the
antisymmetric part of K over the norm of its symmetric part. Its largest value for a spring is
`StiffnessSettings.largest_asymmetry`.
"""

from dataclasses import replace
from math import atan, atan2, degrees, hypot, inf, isfinite, nan, pi, sqrt, tan
from typing import Final, NamedTuple

from needle_dynamics.arrays import BoolArray, FloatArray, IntArray
from needle_identification.estimation.estimate import measured, ParameterEstimate, with_half_width
from needle_identification.estimation.regression import HUBER_LIMIT, regress
from needle_identification.stiffness.plateaus import ROUNDING
from needle_identification.stiffness.presses import Presses, PressNoise
from needle_ros.quantities import DEVIATION_OVER_MEDIAN
import numpy as np
from numpy.linalg import norm
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular
from scipy.optimize import brentq
from scipy.special import fdtri, stdtr, stdtrit

ENTRIES: Final = ('k_xx', 'k_xz', 'k_zx', 'k_zz')  #: entries of the matrix, by row
FEWEST_PRESSES: Final = 3  #: Smallest number of presses of a level.

#: Smallest ratio of scatter and error of the displacements that determines the matrix:
#: attenuation by the noise of the displacements is then below 1 %.
_SMALLEST_SPREAD: Final = 10.0

_LARGEST_NOISE: Final = 3.0  # column norm over error of a column with only noise
_LARGE: Final = 1e3  # ratio whose interval is shown as one limit
_CURL: Final = np.array([[0.0, -1.0], [1.0, 0.0]])  # gradient of k_zx - k_xz by K


class MatrixFit(NamedTuple):
    """Stiffness matrix with errors; by default undetermined."""

    matrix: FloatArray = np.full((2, 2), nan)  # K [N/m]; undetermined columns are nan
    known: BoolArray = np.zeros(2, dtype=np.bool_)  # (2,) columns that the presses determine
    #: R_rs A_r A_s^T is the covariance of rows r, s of K, and R the covariance of their residuals.
    factors: FloatArray = np.zeros((2, 2, 2))
    correlation: FloatArray = np.eye(2)
    degrees_of_freedom: float = 0.0  # of each row
    residual: FloatArray = np.zeros((1, 2))  # (m, 2) force minus K d [N]
    scatter: float = 0.0  # of the presses about the matrix over their noise [1]
    condition: float = inf  # of the displacements
    systematic: float = 0.0  # relative error of the whole matrix by creep and hysteresis
    carried: FloatArray = np.zeros((2, 2))  # error of K by what remains of the press before

    def derived(
        self, name: str, symbol: str, unit: str, value: float, gradient: FloatArray
    ) -> ParameterEstimate:
        """Return a quantity with its gradient (2, 2) by K; undetermined if a required entry is."""
        parameter = ParameterEstimate(name=name, symbol=symbol, unit=unit)
        if not self.known[np.any(gradient != 0.0, axis=0)].all() or not isfinite(value):
            return parameter
        variance, freedom = self.variance_of(gradient)
        error = sqrt(variance)
        half_width = error * float(stdtrit(freedom, 0.975))
        if self.systematic:
            scale = self.systematic * float(np.nansum(gradient * self.matrix))
            slack = hypot(scale, float(np.sum(gradient * self.carried)))
            error, half_width = hypot(error, slack), hypot(half_width, 2.0 * slack)
        return with_half_width(parameter, value, error, half_width)

    def variance_of(self, gradient: FloatArray) -> tuple[float, float]:
        """Return variance and degrees of freedom (Satterthwaite) of a quantity by its gradient."""
        along = np.einsum('rij,ri->rj', self.factors, gradient)
        parts = along @ along.T @ self.correlation
        variance = max(float(np.trace(parts)), 0.0)
        squares = float(np.trace(parts @ parts))
        freedom = self.degrees_of_freedom
        return variance, freedom * variance**2 / squares if squares > 0.0 else freedom


def fit_matrix(presses: Presses, noise: PressNoise, chosen: IntArray, estimator: str) -> MatrixFit:
    """Solve F = K d over the presses ``chosen`` (m,), with errors from their scatter."""
    displacement, force = presses.displacement[chosen], presses.force[chosen]
    error = sqrt(float(np.mean(presses.displacement_error[chosen] ** 2)) * len(chosen))
    if len(chosen) < FEWEST_PRESSES:
        return MatrixFit()
    columns = np.flatnonzero(norm(displacement, axis=0) > _LARGEST_NOISE * error)
    singular = np.linalg.svd(displacement[:, columns], compute_uv=False)
    if not len(columns) or singular[-1] < _SMALLEST_SPREAD * error:
        condition = float(singular[0] / singular[-1]) if singular[-1:].any() else inf
        return MatrixFit(condition=condition)
    displacement = displacement[:, columns]
    start = np.zeros((2, 2))
    start[:, columns] = np.linalg.lstsq(displacement, force, rcond=None)[0].T
    covariances, rounding = noise.covariance(start, chosen, pooled=estimator != 'weighted')
    matrix, factors = np.full((2, 2), nan), np.zeros((2, 2, 2))
    known = np.isin(np.arange(2), columns)
    residual = np.empty_like(force)
    freedom = float(len(chosen) - len(columns))
    freedoms = [freedom, freedom]
    # Weights are in the covariances.
    kind = 'ordinary' if estimator == 'weighted' else estimator
    spread, whitened = np.full(len(columns), error / sqrt(len(chosen))), []
    for row, covariance in enumerate(covariances):
        size = float(np.mean(np.diag(covariance)))
        root = np.linalg.cholesky(covariance / size)
        x, y = (solve_triangular(root, a, lower=True) for a in (displacement, force[:, row]))
        fit = regress(x, y, estimator=kind, regressor_noise=spread)
        deviation, freedoms[row], left = _deviation(fit.residual, freedom, estimator)
        # Equal presses do not scatter by their error of rounding.
        deviation = max(deviation, sqrt(float(rounding[row]) * size))
        matrix[row, columns] = fit.values
        known[columns] &= fit.determined
        residual[:, row] = root @ fit.residual
        normal = np.linalg.inv(x.T @ x)
        factor = deviation * np.linalg.cholesky(normal)
        factors[row][np.ix_(columns, np.arange(len(columns)))] = factor
        whitened.append((left, fit.residual / sqrt(size)))
    (left_x, scaled_x), (left_z, scaled_z) = whitened
    norms = float(norm(left_x) * norm(left_z))
    correlation = float(left_x @ left_z) / norms if norms > 0.0 else 0.0
    return MatrixFit(
        matrix=matrix,
        known=known,
        factors=factors,
        correlation=np.array([[1.0, correlation], [correlation, 1.0]]),
        degrees_of_freedom=min(freedoms),
        residual=residual,
        scatter=sqrt(float(scaled_x @ scaled_x + scaled_z @ scaled_z) / (2.0 * freedom)),
        condition=fit.condition,
        systematic=noise.systematic,
        carried=noise.set * _carried(matrix, presses.displacement, chosen, columns),
    )


def _carried(
    matrix: FloatArray, displacement: FloatArray, chosen: IntArray, columns: IntArray
) -> FloatArray:
    """Return the change of K if all of the press before remained at the rest after it."""
    # The zero between two rests has half of it, and the press itself from none to all: the
    # difference is at most half. In turn around the place, this rotates the displacements.
    before = np.vstack([np.zeros(2), displacement[:-1]])[chosen][:, columns]
    share = np.linalg.lstsq(displacement[chosen][:, columns], before, rcond=None)[0].T
    change = np.zeros((2, 2))
    change[:, columns] = 0.5 * matrix[:, columns] @ share
    return change


def _deviation(
    residual: FloatArray, freedom: float, estimator: str
) -> tuple[float, float, FloatArray]:
    # P. J. Huber, "Robust Statistics", 1981, section 7.6; a clipped residual is not free.
    if estimator != 'huber':
        return sqrt(float(residual @ residual) / freedom), freedom, residual
    limit = HUBER_LIMIT * DEVIATION_OVER_MEDIAN * float(np.median(np.abs(residual)))
    left = np.clip(residual, -limit, limit)
    share = float(np.mean(np.abs(residual) <= limit))
    count = len(residual)
    correction = (1.0 + (count - freedom) / count * (1.0 - share) / share) / share
    deviation = correction * sqrt(float(left @ left) / freedom)
    return deviation, max(freedom - count * (1.0 - share), 1.0), left


def principal_estimates(
    fit: MatrixFit,
) -> tuple[ParameterEstimate, ParameterEstimate, ParameterEstimate]:
    """Return larger and smaller principal stiffness [N/m], and direction of the larger [rad]."""
    # If both agree within their errors, they are biased apart: their intervals then include the
    # interval of their mean, and the direction (from x toward z) is undetermined.
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
        name, value = f'principal_stiffness_{number}', mean + sign * radius
        gradient = np.eye(2) / 2.0 + sign * outward
        one = fit.derived(name, f'k_{number}', 'N/m', value, gradient)
        if one.determined and not differ:
            ends = (*one.interval, *middle.interval)
            one = replace(one, interval=(min(ends), max(ends)))
        found.append(one)
    direction, gradient = atan2(shear, half) / 2.0, around / (2.0 * (radius or 1.0))
    direction = direction if differ else nan
    angle = fit.derived('principal_angle', 'phi', 'rad', direction, gradient)
    return found[0], found[1], angle


def _differ(fit: MatrixFit, found: FloatArray, stretch: FloatArray, slide: FloatArray) -> bool:
    """Test at 1 % whether the two principal stiffnesses differ (F test)."""
    (a, _), (b, _), (c, freedom) = (fit.variance_of(g) for g in (stretch, slide, stretch + slide))
    covariance = np.array([[a, (c - a - b) / 2.0], [(c - a - b) / 2.0, b]])
    if np.linalg.det(covariance) <= 0.0:
        return bool(norm(found) > ROUNDING * norm(fit.matrix))
    return bool(found @ np.linalg.solve(covariance, found) / 2.0 > fdtri(2, freedom, 0.99))


def asymmetry(matrix: ArrayLike) -> float:
    """Return the ratio of the norms of the antisymmetric and the symmetric part of a matrix."""
    k = np.asarray(matrix, dtype=np.float64)
    symmetric = float(norm(k + k.T))
    return float(norm(k - k.T)) / symmetric if symmetric else nan


def rotation_estimate(fit: MatrixFit) -> ParameterEstimate:
    """Return the rotation of the force axes against the motion axes that makes K symmetric."""
    k = fit.matrix
    curl, trace = float(k[1, 0] - k[0, 1]), float(k[0, 0] + k[1, 1])
    size = curl**2 + trace**2 or nan
    gradient = (trace * _CURL - curl * np.eye(2)) / size
    return fit.derived('axes_rotation', 'theta', 'rad', atan2(curl, trace), gradient)


def spring_estimates(
    fit: MatrixFit, limit: float
) -> tuple[ParameterEstimate, ParameterEstimate, bool, str]:
    """Return curl, asymmetry, whether its interval is within ``limit`` [1], and a sentence."""
    k = fit.matrix
    curl = fit.derived('curl', 'curl F', 'N/m', float(k[1, 0] - k[0, 1]), _CURL)
    symmetric = (k + k.T) / 2.0
    size = sqrt(2.0) * float(norm(symmetric)) or nan
    gradient = (_CURL - 2.0 * (k[1, 0] - k[0, 1]) / size**2 * symmetric) / size
    value = float(k[1, 0] - k[0, 1]) / size
    spring = fit.derived('spring', '|K_a|/|K_s|', '1', value, gradient)
    if not spring.determined:
        return curl, spring, False, 'undetermined: the presses do not determine the whole matrix'
    _, freedom = fit.variance_of(gradient)
    low, high = _ratio_interval(abs(value), spring.error, freedom)
    spring = replace(spring, value=abs(value), interval=(low, high))
    is_spring, is_zero = high <= limit, curl.interval[0] <= 0.0 <= curl.interval[1]
    verdict = 'a spring' if is_spring else 'not a spring' if low > limit else 'undecided'
    if low > limit:
        angle = rotation_estimate(fit)
        turned = measured(degrees(angle.value), degrees(angle.error))
        verdict += f' unless the axes of force and motion differ by a rotation of {turned} deg'
    between = f'{low:.2%} to {high:.2%}' if high < _LARGE else f'above {low:.2%}'
    words = (
        f'{verdict}: antisymmetric part {spring.value:.2%} of the symmetric, 95 % interval '
        f'{between}, limit {limit:.0%}; curl '
        + ('zero within its error' if is_zero else f'{curl.value:.3g} N/m')
    )
    return curl, spring, is_spring, words


def _ratio_interval(value: float, error: float, freedom: float) -> tuple[float, float]:
    """Return the 95 % interval of a ratio of norms; above 1 from its angle."""
    # The ratio has no finite error where the symmetric part is near zero, and its angle has.
    if value <= 1.0:
        return _unsigned_interval(value, error, freedom)
    low, high = _unsigned_interval(atan(value), error / (1.0 + value**2), freedom)
    return tan(low), tan(min(high, pi / 2.0 - ROUNDING))


def _unsigned_interval(value: float, error: float, freedom: float) -> tuple[float, float]:
    """Return the 95 % interval of the magnitude of a signed quantity."""
    # A magnitude is in the interval if the measured value is among its nearest 95 % of values.
    if error <= ROUNDING * value:
        return value, value
    found = value / error
    farthest = float(stdtrit(freedom, 0.975))

    def excess(size: float) -> float:
        """Probability that a value is nearer to this size than the measurement, minus 95 %."""
        off = abs(size - found)
        near = [off, max(-off, -size), min(-size, off - 2.0 * size), -off - 2.0 * size]
        above, below, mirrored, lowest = stdtr(freedom, near)
        return float(above - below + mirrored - lowest) - 0.95

    low = brentq(excess, 0.0, found) if found > farthest else 0.0
    return low * error, brentq(excess, found, found + 1.01 * farthest) * error
