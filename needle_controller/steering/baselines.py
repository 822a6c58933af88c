"""
Published steering methods as baselines, with the interface of `SteeringController`.

`Broyden` follows [Bernardes2023]_: tip motion is a matrix times the motion of guide and depth, and
the matrix is corrected after each step. `Springs` follows [Glozman2007]_: the inverse of a beam on
springs that pull it to the axis. `RollTowards` follows [Rucker2013]_: a fixed guide, and a bevel
that is turned towards the target. All are written from the publications, without the code of their
authors.

References
----------
.. [Bernardes2023] M. C. Bernardes, P. Moreira, L. Mareschal, C. Tempany, K. Tuncali, N. Hata,
   J. Tokuda, "Data-driven adaptive needle insertion assist for transperineal prostate
   interventions", Physics in Medicine and Biology 68(10), 2023, doi:10.1088/1361-6560/accefa.
.. [Glozman2007] D. Glozman, M. Shoham, "Image-guided robotic flexible needle steering", IEEE
   Transactions on Robotics 23, 2007.
.. [Rucker2013] D. C. Rucker, J. Das, H. B. Gilbert, P. J. Swaney, M. I. Miga, N. Sarkar,
   R. J. Webster, "Sliding mode control of steerable needles", IEEE Transactions on Robotics
   29(5), 2013.

"""

from __future__ import annotations

from math import atan2, pi, remainder, sin, tau
from typing import Final

from needle_controller.steering.controller import GuideSetpoint
from needle_dynamics.arrays import FloatArray
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.needle import SteeredNeedle
from needle_dynamics.steering.parameters import SteeringParameters
from needle_dynamics.steering.reference_models import springs
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import lsq_linear

#: Fraction of a prediction error that corrects the matrix of Broyden.
_ALPHA: Final = 0.65

#: Depth at which tissue holds the needle [m].
_HELD: Final = 0.02

#: Least response of the springs that is inverted.
_LEAST: Final = 1e-3


class OpenLoop:
    """
    A fixed guide.

    Parameters
    ----------
    depths : array_like, shape (n + 1,)
        Depths of the tip measurements [m].
    target : array_like, shape (2,)
        Target position of the tip at the last depth, x and z [m].
    position_limit : float
        Largest position of the guide along each axis [m].

    """

    def __init__(self, depths: ArrayLike, target: ArrayLike, position_limit: float = 6e-3) -> None:
        self.depths, self.target = np.array(depths), np.array(target)
        self.limit = position_limit
        self.step = 0
        self.guide = np.zeros(2)
        self.roll = 0.0

    def next(self, tip: FloatArray | None) -> GuideSetpoint:
        """Process a tip measurement, x and z [m], or None; return guide and roll of the step."""
        if tip is not None and self.step < len(self.depths) - 1:
            self.guide = np.clip(self._choose(tip), -self.limit, self.limit)
        self.step += 1
        x, z = self.guide.tolist()
        return GuideSetpoint(x, z, self.roll)

    def _choose(self, _tip: FloatArray) -> FloatArray:
        return self.guide


class Broyden(OpenLoop):
    """
    A matrix from motions of guide and depth to motions of the tip, corrected after each step.

    Each step minimizes the distance of the tip from the target, as predicted by the matrix. The
    source has a horizon of four steps; without a cost of motion its first step is the same for any
    horizon. Two changes against the source: the first matrix is from a simulated insertion of
    the nominal needle, and the guide is fixed until tissue holds the needle. Near the skin the tip
    moves with the guide, deeper against it, and a wrong sign drives the guide to its limit,
    without any further correction.

    Needle, tissue and steering constants are nominal; other parameters as for `OpenLoop`.
    """

    def __init__(
        self,
        needle: NeedleParameters,
        steering: SteeringParameters,
        depths: ArrayLike,
        target: ArrayLike,
        position_limit: float = 6e-3,
    ) -> None:
        super().__init__(depths, target, position_limit)
        #: Derivatives of x and z of the tip by x and z of the guide and the depth.
        self._matrix = np.zeros((2, 3))
        self._before: tuple[FloatArray, FloatArray] | None = None
        earlier = SteeredNeedle(needle, steering)
        for k, depth in enumerate(self.depths.tolist()):
            guide = 0.5 * position_limit * np.array([sin(2.0 * k), sin(3.0 * k)])
            earlier.move(depth=depth, guide=guide.tolist())
            self._learn(earlier.tip[[0, 2]], np.array([*guide, depth]))
        self._before = None

    def _learn(self, tip: FloatArray, at: FloatArray) -> None:
        if self._before is not None:
            seen, was = self._before
            moved = at - was
            off = (tip - seen) - self._matrix @ moved
            self._matrix += _ALPHA * np.outer(off, moved) / (moved @ moved)
        self._before = tip.copy(), at

    def _choose(self, tip: FloatArray) -> FloatArray:
        depth = self.depths[self.step]
        self._learn(tip, np.array([*self.guide, depth]))
        if depth < _HELD:
            return self.guide
        ahead = self.depths[self.step + 1] - depth
        across, along = self._matrix[:, :2], self._matrix[:, 2]
        wanted = self.target - tip - along * ahead + across @ self.guide
        return np.asarray(lsq_linear(across, wanted, (-self.limit, self.limit)).x)


class Springs(OpenLoop):
    """
    The inverse of a beam on springs, along a straight line to the target.

    Needle, tissue and steering constants are nominal; other parameters as for `OpenLoop`.
    """

    def __init__(
        self,
        needle: NeedleParameters,
        steering: SteeringParameters,
        depths: ArrayLike,
        target: ArrayLike,
        position_limit: float = 6e-3,
    ) -> None:
        super().__init__(depths, target, position_limit)
        self._responses = [
            float(springs(needle, steering, float(depth))[0][0, 0]) for depth in self.depths
        ]

    def _choose(self, tip: FloatArray) -> FloatArray:
        now, then = self._responses[self.step : self.step + 2]
        if abs(then) < _LEAST:
            return self.guide
        wanted = self.target * self.depths[self.step + 1] / self.depths[-1]
        # The unmodeled deflection is assumed constant.
        return np.asarray((wanted - (tip - now * self.guide)) / then)


class RollTowards(OpenLoop):
    """
    A bevel that is turned to push towards the target, along the present heading of the tip.

    In the source the needle rotates continuously, with a rate that grows with the distance of the
    target from the bending plane; in steps this is a turn into that plane. The heading of the tip
    is computed from two measurements. At zero roll the bevel pushes along z. Parameters as for
    `OpenLoop`.
    """

    def __init__(self, depths: ArrayLike, target: ArrayLike, position_limit: float = 6e-3) -> None:
        super().__init__(depths, target, position_limit)
        self._before: tuple[float, FloatArray] | None = None

    def _choose(self, tip: FloatArray) -> FloatArray:
        depth = float(self.depths[self.step])
        before, self._before = self._before, (depth, tip)
        if before is not None:
            heading = (tip - before[1]) / (depth - before[0])
            x, z = (self.target - tip) - heading * (self.depths[-1] - depth)
            # At a roll of phi the bevel pushes along (sin phi, cos phi).
            self.roll += remainder(0.5 * pi - atan2(z, x) - self.roll, tau)
        return self.guide
