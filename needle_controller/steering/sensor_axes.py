# SPDX-License-Identifier: Apache-2.0
r"""
Evidence of exchanged or reversed axes, from the response of the tip to the guide.

A law that steers by a sensor with reversed axes moves the guide the wrong way, and explains the
measurements by a path that wanders. The signs and the order of the two axes have eight cases
:math:`T`. With the response :math:`p_k` of the tip to the guide at a point of the grid, and a
covariance C of all other causes, the whitened measurements z leave

.. math:: s_T = |z|^2 + |p|^2 - 2 \, \mathrm{Re} \langle T p, z \rangle,

so that two products are enough for all cases: T is a turn by a multiple of a quarter, alone or
after a reflection. The scale of C is unknown, with an inverse gamma prior: the likelihood is a
Student distribution [Gelman2013]_, which is robust to needles, tissue and sensors that differ from
the model. It is summed over the points of the grid, because the sign of the response depends on
bending length and skin. The formulas are in docs/steering.md.

References
----------
.. [Gelman2013] A. Gelman et al., "Bayesian Data Analysis", 3rd ed., chapter 3, 2013.

"""

from math import sqrt
from typing import Final

from needle_controller.steering.law import SteeringFaultError
from needle_controller.steering.responses import BEVEL, DRIFT_LENGTH, SteeringModel
from needle_dynamics.arrays import ComplexArray, FloatArray
from needle_ros.quantities import SIGNED_PAIRS
import numpy as np

#: Factors of `SIGNED_PAIRS`.
_TURNS: Final = np.array([1.0, 1.0j, -1.0, -1.0j])

#: Logarithm of the likelihood ratio of a case to the right axes that stops the needle: 1150
#: needles in the worlds of docs/steering.md stay below 12.
_STOP: Final = 18.0
_FREEDOM: Final = 4.0  #: Degrees of freedom of the prior of the scale.
_WIDER: Final = 5.0  #: Deviations of origin, frame, tilt and bevel, relative to the prior ones.


class SensorAxes:
    """Test of the axes of the tip sensor of a steered needle."""

    def __init__(self, model: SteeringModel) -> None:
        beams = np.flatnonzero(~model.rolled[: len(model.responses.guide)])
        self._responses = model.responses.guide[beams]
        self._covariance = _covariance(model, int(beams[len(beams) // 2]))
        self._at: list[int] = []  # depth numbers of the measurements
        #: Rows that whiten the measurements, and sums over whitened measurements and responses.
        self._whitening = np.zeros((0, 0))
        self._tips = np.zeros(0, dtype=np.complex128)
        self._shifts = np.zeros((len(beams), 0), dtype=np.complex128)
        self._squares = np.zeros(len(beams))
        self._products = np.zeros((2, len(beams)), dtype=np.complex128)

    def check(self, at: int, tip: complex, guide: ComplexArray, variance: float) -> None:
        """
        Add a measurement of the tip, x + i z [m], at a depth number; raise for wrong axes.

        ``guide`` is the position of the guide in each step [m], ``variance`` the variance of the
        measurement along each axis [m^2].
        """
        row = self._covariance[at, self._at]
        known = self._whitening @ row
        left = sqrt(max(self._covariance[at, at] - known @ known, 0.0) + variance)
        new = np.append(-known @ self._whitening, 1.0) / left
        self._whitening = np.vstack([np.pad(self._whitening, ((0, 0), (0, 1))), new])
        self._at.append(at)
        shifts = self._responses[:, at, :at] @ guide[:at]
        shift = (shifts - self._shifts @ known) / left
        seen = (tip - known @ self._tips) / left
        self._tips, self._shifts = np.append(self._tips, seen), np.c_[self._shifts, shift]
        self._squares += abs(seen) ** 2 + np.abs(shift) ** 2
        self._products += seen * np.array([shift.conj(), shift])
        gained = 2.0 * np.real(_TURNS.conj()[:, np.newaxis] * self._products[:, np.newaxis])
        rest = np.maximum(self._squares - gained, 0.0).reshape(len(SIGNED_PAIRS), -1)
        logs = -0.5 * (2 * len(self._at) + _FREEDOM) * np.log1p(rest / _FREEDOM)
        evidence = np.logaddexp.reduce(logs, axis=1)
        case = int(evidence.argmax())
        if evidence[case] - evidence[0] > _STOP:
            x, z = SIGNED_PAIRS[case]
            raise SteeringFaultError(
                f'the tip responds to the guide as if the sensor measured {x} as x and {z} as z: '
                'axes or signs of tip or guide are wrong'
            )


def _covariance(model: SteeringModel, point: int) -> FloatArray:
    """Return the covariance of the tips (n + 1, n + 1) by all but the guide [m^2]."""
    of, tips = model.state_prior, model.steps + 1
    apart = np.abs(model.depths[:, np.newaxis] - model.depths)
    bevel = model.responses.causes[point, :, BEVEL]
    push = max(model.push, model.prior.bevel)
    return np.asarray(
        _WIDER**2 * (of.known[point, :, :tips] + push**2 * np.outer(bevel, bevel))
        + of.noises.max() * of.wandering[point, :, :tips]
        + model.prior.drift**2 * np.exp(-apart / DRIFT_LENGTH)
    )
