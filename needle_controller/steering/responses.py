r"""
What the tip does for all that may happen, in each of the tissues that may be true.

At given depths the tip is linear in the positions of the guide, in its tilt, in the load of the
bevel, and in the loads with which the path strays from what is expected:

.. math:: z_k = \sum_j A_{kj} b_j + H_k \theta

with positions :math:`b_j` of the guide in the steps, and unknown constants
:math:`\theta`: origin and turn of the sensor's frame, tilt, bevel, and a curvature of the path
at each depth, with straight lines between. A and H depend on the bending length and on the skin,
and so there is one of them for each of a grid of these: the hypotheses. What is between two of
them is two more unknown constants, with how A changes from one to the next.

Both planes have the same, so that everything is a complex number, x + i z. At a roll
:math:`\varphi` the bevel pushes along :math:`i e^{-i \varphi}`.
"""

from __future__ import annotations

from dataclasses import replace
from math import ceil, pi
from typing import Final

from needle_controller.compiled.steering import Responses
from needle_controller.steering.belief import SteeringBelief
from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.cut import insert
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.needle import empty_cut, steered
from needle_dynamics.steering.parameters import SteeringParameters, turning_load, with_lengths
from needle_ros.errors import ParameterError
import numpy as np
from numpy.typing import ArrayLike

#: Constants of `NeedleParameters` and of `SteeringParameters` that count here; what nobody knows
#: is of the belief.
OF_NEEDLE: Final = (
    'length', 'youngs_modulus', 'area_moment', 'tissue_stiffness', 'layer_depths',
    'layer_stiffnesses',
)  # fmt: skip
OF_STEERING: Final = ('free_length', 'skin_stiffness', 'bevel_load')

#: Hypotheses of the bending length and of the skin.
_LENGTHS, _SKINS = 13, 4

#: The grid goes so much farther than the spread.
_BEYOND: Final = 1.1

#: Longest element [m]: good to a few micrometers.
_ELEMENT: Final = 1.25e-3

#: Standard deviation of what is anywhere within a cell of the grid.
_EVEN: Final = 12.0**-0.5


class SteeringModel:
    """
    Responses of the tip at the ends of the steps, one for each hypothesis.

    Parameters
    ----------
    needle : NeedleParameters
        Needle and tissue as they are believed.
    steering : SteeringParameters
        What they have beyond; path noise and bevel are those of the belief.
    depths : array_like, shape (n + 1,)
        Depths at which the tip is looked at [m], increasing; the first one is reached straight.
    belief : SteeringBelief, optional
        How far all that may be wrong.
    together : bool
        Whether the guide goes evenly with the depth, to be at the position of a step at its end;
        else it moves there while the needle rests, and stays while the needle goes in.

    Attributes
    ----------
    depths : ndarray, shape (n + 1,)
        The depths [m].
    belief : SteeringBelief
        As given.
    lengths, skins : ndarray, shape (h,)
        Bending length and skin of each hypothesis, over the believed ones.
    guide : ndarray, shape (h, n + 1, n)
        Shift of the tip at each depth per position of the guide in each step.
    causes : ndarray, shape (h, n + 1, 5 + n)
        The same per origin [m], turn of the frame [rad], tilt, load of the bevel [N] without
        roll, and curvature of the path at each depth [1/m].
    bevel : ndarray, shape (h, n + 1, n + 1)
        The same per load of the bevel [N] on the skin, and in each step.
    elastic : ndarray, shape (h, n + 1)
        What a load of the bevel on the resting tip adds at once [m/N].
    guide_load, causes_load, bevel_load : ndarray, shape (h, n, n), (h, n, 5 + n), (h, n, n + 1)
        What the guide feels [N] when it is where it shall be in each step, of the same.
    push : float
        Believed load of the bevel, along z at zero roll [N].
    between : ndarray, shape (2, h, n + 1, n)
        Change of `guide` from one hypothesis to the next in bending length, and in skin.
    prior : ndarray, shape (7 + n, 7 + n)
        Covariance of the causes, before anything is seen, and of the places between two
        hypotheses.
    responses : Responses
        All responses, as compiled functions take them.

    Raises
    ------
    ParameterError
        If the depths do not increase, or the needle does not reach so deep.

    """

    def __init__(
        self,
        needle: NeedleParameters,
        steering: SteeringParameters,
        depths: ArrayLike,
        belief: SteeringBelief | None = None,
        *,
        together: bool = False,
    ) -> None:
        at = np.array(depths, dtype=np.float64)
        if at.ndim != 1 or len(at) < 2 or not np.isfinite(at).all() or (np.diff(at) <= 0.0).any():
            raise ParameterError(
                'depths must be numbers that increase, two at least, got '
                f'{np.array2string(at, threshold=6)} m'
            )
        reach = needle.length - steering.free_length
        if not (at[0] >= 0.0 and at[-1] <= reach):
            raise ParameterError(
                f'depths must be in [0, {reach:g}] m, the length of the needle without its free '
                f'length, got {at[0]:g} to {at[-1]:g} m'
            )
        self.depths, self.belief = at, belief or SteeringBelief()
        self._together = together
        width = _BEYOND * self.belief.spread
        lengths = np.geomspace(1.0 - width, 1.0 + width, _LENGTHS if width else 1)
        skins = np.ones(1)
        if width and steering.skin_stiffness > 0.0:
            skins = np.linspace(1.0 - width, 1.0 + width, _SKINS)
        self.lengths, self.skins = (grid.ravel() for grid in np.meshgrid(lengths, skins))
        pairs = zip(self.lengths.tolist(), self.skins.tolist(), strict=True)
        found = [self._respond(needle, steering, *pair) for pair in pairs]
        (
            self.guide, self.causes, self.bevel, self.elastic,
            self.guide_load, self.causes_load, self.bevel_load,
        ) = map(np.array, zip(*found, strict=True))  # fmt: skip
        self.push = max(steering.bevel_load)
        grid = self.guide.reshape(len(skins), len(lengths), *self.guide.shape[1:])
        self.between = np.array(
            [
                (np.gradient(grid, axis=axis) if grid.shape[axis] > 1 else 0.0 * grid).reshape(
                    self.guide.shape
                )
                for axis in (1, 0)
            ]
        )
        b = self.belief
        size = 7 + self.steps
        self.prior = np.diag(
            np.array([b.offset, b.frame, b.tilt, b.bevel, *[0.0] * (size - 6), _EVEN, _EVEN]) ** 2
        )
        apart = np.abs(at[:, np.newaxis] - at) / b.path_noise_length
        self.prior[4:-2, 4:-2] = b.path_noise / (2.0 * b.path_noise_length) * np.exp(-apart)
        self.responses = Responses(
            self.guide, self.causes, self.bevel, self.elastic,
            self.guide_load, self.causes_load, self.bevel_load, self.between,
            _sums_from(self.guide[:, -1], self.steps + 1),
            _sums_from(self.bevel[:, -1], self.steps + 3),
        )  # fmt: skip

    @property
    def steps(self) -> int:
        """Number of steps n."""
        return len(self.depths) - 1

    def _respond(
        self, needle: NeedleParameters, steering: SteeringParameters, length: float, skin: float
    ) -> tuple[FloatArray, ...]:
        """Insert a needle once for each cause."""
        n, at = self.steps, self.depths
        smallest = float(np.diff(at).min())
        wanted = smallest / ceil(smallest / _ELEMENT - 1e-9)
        # Of layers with different loads of the bevel their ratio is believed.
        most = max(steering.bevel_load)
        loads = tuple(one / most for one in steering.bevel_load) if most else (1.0,)
        beyond = replace(steering, element=wanted, bevel_load=loads, path_noise=0.0)
        other, beyond = with_lengths(needle, beyond, length, skin)
        base = steered(other, beyond)
        reach = at[-1] + steering.free_length
        runs = 3 * n + 3
        # First the guide, then the needle.
        poses = np.zeros((runs, 2 * n + 1, 6))
        poses[:, ::2, 0], poses[:, 1::2, 0] = at, at[:-1]
        for k in range(n):
            first = 2 * k + (2 if self._together else 1)
            poses[k, first : first + 2, 1] = 1.0
        poses[n, :, 2] = 1.0
        # A bevel that pushes along z in one step, and along x in all others.
        bevels = slice(n + 1, 2 * n + 2)
        poses[bevels, :, 5] = 0.5 * pi
        poses[n + 1, 0, 5] = 0.0
        for k in range(n):
            poses[n + 2 + k, 2 * k + 1 : 2 * k + 3, 5] = 0.0
        layers = np.zeros((runs, 3, len(base.starts)))
        layers[:, 0], layers[:, 1] = base.starts, base.stiffness
        layers[bevels, 2] = base.bevel
        cells = ceil(reach / base.element) + 2
        middle = (np.arange(cells) + 0.5) * base.element
        turning = np.array([turning_load(base.ei, other.tissue.stiffness(y)) for y in middle])
        wander = np.zeros((runs, cells, 2))
        hats = [np.interp(middle, at, one) for one in np.eye(n + 1)]
        wander[2 * n + 2 :, :, 0] = hats * turning
        numbers = [base.ei, base.element, base.skin, 0.0, 0.0, reach]
        tips, felt = np.empty((2, runs, 2 * n + 1, 2))
        insert(
            np.array([[*numbers, steering.free_length]]),
            layers,
            base.element,
            wander,
            poses,
            np.arange(runs),
            empty_cut(reach, base.element, len(base.starts)),
            tips,
            felt,
        )

        def sorted_by_cause(
            found: FloatArray, origin: FloatArray, turn: FloatArray
        ) -> tuple[FloatArray, FloatArray, FloatArray]:
            x, bevel = found[:, :, 0].T, found[bevels, :, 1].T
            causes = [origin, turn, x[:, n], bevel.sum(axis=1), *x[:, 2 * n + 2 :].T]
            return x[:, :n], np.array(causes).T, bevel

        # A bevel that is turned at rest moves the tip at once.
        rests = np.arange(n)
        own = tips[n + 2 + rests, :, 1]
        elastic = own[rests, 2 * rests + 1] - own[rests, 2 * rests]
        # The sensor has no part in what the guide feels.
        none = np.zeros(n)
        return (
            *sorted_by_cause(tips[:, ::2], np.ones(n + 1), at),
            np.append(elastic, elastic[-1]),
            *sorted_by_cause(felt[:, 2 if self._together else 1 :: 2], none, none),
        )


def _sums_from(values: FloatArray, count: int) -> FloatArray:
    """Return the sums of absolute values from each column on, shape (h, count): 0 beyond."""
    found = np.zeros((len(values), count))
    found[:, : values.shape[1]] = np.abs(values)[:, ::-1].cumsum(axis=1)[:, ::-1]
    return found
