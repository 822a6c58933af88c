# SPDX-License-Identifier: Apache-2.0
"""
Steering law of Bernardes et al.: tip motion is a matrix times the motion of guide and depth.

Written from the publication [Bernardes2023]_, without the code of its authors.

References
----------
.. [Bernardes2023] M. C. Bernardes, P. Moreira, L. Mareschal, C. Tempany, K. Tuncali, N. Hata,
   J. Tokuda, "Data-driven adaptive needle insertion assist for transperineal prostate
   interventions", Physics in Medicine and Biology 68(10), 2023, doi:10.1088/1361-6560/accefa.

"""

from math import sin
from typing import Final

from needle_controller.steering.law import GuideLaw
from needle_controller.steering.responses import SteeringModel
from needle_dynamics.arrays import FloatArray
from needle_dynamics.steering.needle import SteeredNeedle
from needle_ros.errors import ParameterError
import numpy as np
from scipy.optimize import lsq_linear

_ALPHA: Final = 0.65  #: Fraction of a prediction error that corrects the matrix.
_FIXED_BELOW: Final = 0.02  #: Depth [m] from which tissue holds the needle, and the guide moves.


class BroydenLaw(GuideLaw):
    """
    A matrix from motions of guide and depth to motions of the tip, corrected after each step.

    Each step minimizes the distance of the tip from the target, as predicted by the matrix. The
    source has a horizon of four steps; without a cost of motion its first step is the same for any
    horizon. Two changes against the source: the first matrix is from a simulated insertion of
    the nominal needle, and the guide is fixed until tissue holds the needle. Near the skin the tip
    moves with the guide, deeper against it, and a wrong sign drives the guide to its limit,
    without any further correction.

    Parameters as for `GuideLaw`; ``guide_limit`` must not be 0.
    """

    def prepare(self, model: SteeringModel) -> None:
        """Compute the first matrix from a simulated insertion."""
        limit = self.limits.guide_limit
        if limit == 0.0:
            raise ParameterError('guide_limit cannot be 0: nothing would move')
        self._matrix = np.zeros((2, 3))  #: derivatives of x, z of the tip by guide x, z and depth
        self._before: tuple[FloatArray, FloatArray] | None = None
        earlier = SteeredNeedle(model.needle, model.steering)
        for k, depth in enumerate(self.depths.tolist()):
            guide = 0.5 * limit * np.array([sin(2.0 * k), sin(3.0 * k)])
            earlier.move(depth=depth, guide=guide.tolist())
            self._learn(earlier.tip[[0, 2]], np.array([*guide, depth]))
        self._before = None

    def _learn(self, tip: FloatArray, at: FloatArray) -> None:
        """Correct the matrix by a tip [m] at a position of guide and depth [m], shape (3,)."""
        if self._before is not None:
            tip_before, at_before = self._before
            moved = at - at_before
            off = (tip - tip_before) - self._matrix @ moved
            self._matrix += _ALPHA * np.outer(off, moved) / (moved @ moved)
        self._before = tip.copy(), at

    def choose(self, tip: FloatArray, at: int) -> FloatArray:
        guide, depth = self.guides[at], self.depths[at]
        self._learn(tip, np.array([*guide, depth]))
        if depth < _FIXED_BELOW:
            return self.guides[-1]
        ahead = self.depths[self.step + 1] - depth
        limit = self.limits.guide_limit
        across, along = self._matrix[:, :2], self._matrix[:, 2]
        wanted = self.target - tip - along * ahead + across @ guide
        return np.asarray(lsq_linear(across, wanted, (-limit, limit)).x)
