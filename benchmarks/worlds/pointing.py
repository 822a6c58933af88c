# SPDX-License-Identifier: Apache-2.0
"""
Beam whose tip cuts in the direction in which it points, as the front wheel of a bicycle.

The wheel model of a bevel is [Webster2006]_. There the shaft follows the path without any force;
here it bends about the path like the beam of `stiffness_field`, and the guide turns the tip.

References
----------
.. [Webster2006] R. J. Webster, J. S. Kim, N. J. Cowan, G. S. Chirikjian, A. M. Okamura,
   "Nonholonomic modeling of needle steering", International Journal of Robotics Research 25, 2006.

"""

from __future__ import annotations

from benchmarks.worlds.stiffness_field import StiffnessField
from needle_dynamics import FloatArray
import numpy as np


class PointingNeedle(StiffnessField):
    """
    Beam that cuts along the direction of its tip, plus the disturbance of the path.

    The load of the bevel bends the tip, and so turns the path.
    """

    _turned = np.zeros(2)

    def ahead(self) -> FloatArray:
        """Return the point ahead of the tip at the next node [m]."""
        h, inside = self.size, len(self.path) - 1
        # The disturbance turns the path for good.
        self._turned = self._turned + h * self.constants.curvature(h * inside)
        # Second order at the end of the grid.
        slope = (3.0 * self.shape[-1] - 4.0 * self.shape[-2] + self.shape[-3]) / (2.0 * h)
        return np.asarray(self.path[-1] + h * (slope + self._turned))
