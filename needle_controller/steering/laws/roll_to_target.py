# SPDX-License-Identifier: Apache-2.0
"""
Steering law of Rucker et al.: a fixed guide, and a bevel that is turned towards the target.

Written from the publication [Rucker2013]_, without the code of its authors.

References
----------
.. [Rucker2013] D. C. Rucker, J. Das, H. B. Gilbert, P. J. Swaney, M. I. Miga, N. Sarkar,
   R. J. Webster, "Sliding mode control of steerable needles", IEEE Transactions on Robotics
   29(5), 2013.

"""

from math import atan2, pi, remainder, tau

from needle_controller.steering.law import GuideLaw
from needle_controller.steering.responses import SteeringModel
from needle_dynamics.arrays import FloatArray
from needle_ros.errors import ParameterError


class RollToTargetLaw(GuideLaw):
    """
    A bevel that is turned to push towards the target, along the present heading of the tip.

    In the source the needle rotates continuously, with a rate that grows with the distance of the
    target from the bending plane; in steps this is a turn into that plane. The heading of the tip
    is computed from two measurements. At zero roll the bevel pushes along z. Parameters as for
    `GuideLaw`; ``turns`` must not be 0.
    """

    def prepare(self, _model: SteeringModel) -> None:
        if self.turns == 0:
            raise ParameterError('turns cannot be 0: nothing would move')
        self._before: tuple[float, FloatArray] | None = None

    def choose(self, tip: FloatArray, at: int) -> FloatArray:
        depth = float(self.depths[at])
        before, self._before = self._before, (depth, tip)
        if before is not None and self.turns:
            heading = (tip - before[1]) / (depth - before[0])
            x, z = (self.target - tip) - heading * (self.depths[-1] - depth)
            # At a roll of phi the bevel pushes along (sin phi, cos phi).
            self.roll += remainder(0.5 * pi - atan2(z, x) - self.roll, tau)
            self.turns -= 1
        return self.guides[-1]
