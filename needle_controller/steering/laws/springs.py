# SPDX-License-Identifier: Apache-2.0
"""
Steering law of Glozman and Shoham: the inverse of a beam on springs that pull it to the axis.

Written from the publication [Glozman2007]_, without the code of its authors.

References
----------
.. [Glozman2007] D. Glozman, M. Shoham, "Image-guided robotic flexible needle steering", IEEE
   Transactions on Robotics 23, 2007.

"""

from dataclasses import replace
from typing import Final

from needle_controller.steering.law import GuideLaw
from needle_controller.steering.responses import SteeringModel
from needle_dynamics.arrays import FloatArray
from needle_dynamics.steering.needle import SteeredNeedle
import numpy as np

_LEAST: Final = 1e-3  #: Least response of the springs that is inverted.


class SpringsLaw(GuideLaw):
    """Follow a straight line to the target by the inverse of a beam on springs; see `GuideLaw`."""

    def prepare(self, model: SteeringModel) -> None:
        # A path without bevel and noise is straight: it coincides with the axis.
        straight = replace(model.steering, bevel_load=(0.0,), path_noise=0.0)
        self._responses = []
        for depth in self.depths.tolist():
            needle = SteeredNeedle(model.needle, straight)
            needle.move(depth=depth)
            self._responses.append(float(needle.authority[0, 0]))

    def choose(self, tip: FloatArray, at: int) -> FloatArray:
        now, then = self._responses[at], self._responses[self.step + 1]
        if abs(then) < _LEAST:
            return self.guides[-1]
        wanted = self.target * self.depths[self.step + 1] / self.depths[-1]
        # The unmodeled deflection is assumed constant.
        return np.asarray((wanted - (tip - now * self.guides[at])) / then)
