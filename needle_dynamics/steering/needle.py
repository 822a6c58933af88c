# SPDX-License-Identifier: Apache-2.0
"""Needle that cuts its path, moved by guide, roll and insertion depth."""

from math import ceil, exp, isfinite, sqrt
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray, floats
from needle_dynamics.compiled.beam import SpringSupports
from needle_dynamics.compiled.cut import correlate, GuidePose, move_boxed, start
from needle_dynamics.compiled.cutting_needle import (
    Cut,
    CuttingNeedle,
    DEEPEST,
    DEPTH,
    FREE,
    guide_response,
    LAST,
    place,
    ROLL,
    set_free,
    solve_shape,
    Steered,
    TIP_ROLL,
)
from needle_dynamics.display import Displayed
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.parameters import (
    by_layer,
    longest_element,
    longest_insertion,
    noise_cell,
    SteeringParameters,
    turning_load,
)
from needle_ros.errors import ParameterError
from needle_ros.settings import checked, is_whole
import numpy as np
from numpy.typing import ArrayLike

_SPARE: Final = 2  #: nodes per element of the needle: a restarted path uses an additional node


class NeedleShape(NamedTuple):
    """Shape of the needle from the guide at -L0 to the tip."""

    depths: FloatArray  #: distance from the entry point [m], shape (k,)
    deflections: FloatArray  #: deflections in x and z [m], shape (k, 2)
    slopes: FloatArray  #: derivatives of the deflections in y, shape (k, 2)


class NeedlePath(NamedTuple):
    """Path cut by the tip."""

    depths: FloatArray  #: distance from the entry point [m], shape (k,)
    deflections: FloatArray  #: path position in x and z [m], shape (k, 2)


class Placement(NamedTuple):
    """Position of guide, needle and tissue."""

    #: Position [m] and tilt of the guide in x and z.
    guide: tuple[float, float]
    tilt: tuple[float, float]
    roll: float  #: roll of the base [rad]
    tissue: FloatArray  #: displacement of the tissue with its path in x, y and z [m], shape (3,)


def steered(
    needle: NeedleParameters, steering: SteeringParameters, wander: FloatArray | None = None
) -> Steered:
    """Return constants for compiled functions; ``wander`` (cells, 2) is of `wandering` [N]."""
    tissue = needle.tissue
    longest_insertion(needle, steering)
    if needle.friction_law != 'coulomb':
        raise ParameterError(
            f'friction_law must be coulomb for a steered needle, got {needle.friction_law!r}'
        )
    if needle.swelling != 0.0:
        raise ParameterError(f'swelling must be 0 for a steered needle, got {needle.swelling:g}')
    return Steered(
        ei=needle.bending_stiffness,
        element=longest_element(needle, steering),
        skin=steering.skin_stiffness,
        twist=1.0 / steering.torsional_stiffness,
        turning=steering.torsional_friction,
        length=needle.length,
        starts=np.array(tissue.starts),
        stiffness=np.array(tissue.stiffnesses),
        bevel=by_layer('bevel_load', steering.bevel_load, len(tissue.starts)),
        cell=noise_cell(steering),
        wander=np.zeros((0, 2)) if wander is None else wander,
    )


def wandering(needle: NeedleParameters, steering: SteeringParameters, seed: int) -> FloatArray:
    """Draw the lateral tip loads in x and z [N] of the path noise, shape (cells, 2)."""
    # A load F turns the path of a long needle by F lambda / (E I) per length. Loads correlated
    # over a length turn it at random: the variance of its direction grows with its length.
    if not is_whole(seed) or seed < 0:
        raise ParameterError(f'seed must be an integer >= 0, got {seed!r}')
    if steering.path_noise == 0.0:
        return np.zeros((0, 2))
    cell = noise_cell(steering)
    depths = np.arange(ceil(needle.length / cell) + 2) * cell
    keep = exp(-cell / steering.path_noise_length)
    turns = np.random.default_rng(seed).standard_normal((len(depths), 2))
    turns[1:] *= sqrt(1.0 - keep * keep)
    correlate(turns, keep)
    ei, tissue = needle.bending_stiffness, needle.tissue
    loads = np.array([turning_load(ei, k) for k in tissue.stiffnesses])
    layers = np.searchsorted(tissue.starts, depths, side='right') - 1
    size = sqrt(steering.path_noise / (2.0 * steering.path_noise_length))
    return np.asarray(size * turns * loads[layers, np.newaxis])


def empty_cut(length: float, element: float, layers: int) -> Cut:
    """Allocate the state of a needle (lengths in m); ``start`` initializes it."""
    rows = _SPARE * (ceil(length / element) + layers) + 3
    shapes = (), (), (3,), (2, 2), (2, 2), (2, 3)
    return Cut(
        springs=SpringSupports(*(np.zeros((rows, *shape)) for shape in shapes)),
        guide=np.zeros((2, 2)),
        pose=np.zeros(5),
        entry=np.zeros(2),
        tip=np.zeros((2, 2)),
        load=np.zeros(2),
        counts=np.zeros(2, dtype=np.int64),
    )


class SteeredNeedle(Displayed):
    """
    Needle between guide and tip that cuts its path; lateral bending is quasi-static.

    The beam in each plane minimizes its energy: bending, tissue around the path, skin, and the
    lateral load of the bevel. While the tip moves beyond its greatest depth it cuts, and
    the path ends at the tip. On withdrawal and reinsertion the needle follows this path. The beam
    is linear: valid up to slopes of about 0.3, see ``shape.slopes``.

    Parameters
    ----------
    needle : NeedleParameters
        Needle and tissue.
    steering : SteeringParameters, optional
        Additional constants of a steered needle.
    guide : array_like, shape (2,)
        Position of the guide in x and z when the tip touches the skin [m].
    tilt : array_like, shape (2,)
        Tilt of the guide (slope of the needle at the guide) in x and z.
    roll : float
        Roll of the needle, right-handed about y [rad]; at 0 the bevel pushes the tip along z.
    seed : int
        Seed of the path noise.

    Examples
    --------
    >>> from needle_dynamics import NeedleParameters, SteeredNeedle, SteeringParameters
    >>> soft = NeedleParameters.preset('phantom', tissue_stiffness=2e4)
    >>> needle = SteeredNeedle(soft, SteeringParameters(bevel_load=(0.5,)))
    >>> needle.move(depth=0.1)
    >>> print(f'{1e3 * needle.tip[2]:.2f} mm')
    5.93 mm

    At this depth the tip moves opposite to the guide:

    >>> print(f'{needle.authority[0, 0]:.2f}')
    -0.26

    """

    def __init__(
        self,
        needle: NeedleParameters,
        steering: SteeringParameters | None = None,
        *,
        guide: ArrayLike = (0.0, 0.0),
        tilt: ArrayLike = (0.0, 0.0),
        roll: float = 0.0,
        seed: int = 0,
    ) -> None:
        from needle_dynamics.compiled.boxed import Boxed

        self.needle = needle
        self.steering = steering or SteeringParameters()
        self._constants = steered(needle, self.steering, wandering(needle, self.steering, seed))
        self._cut = empty_cut(needle.length, self._constants.element, len(self._constants.starts))
        self._boxed = Boxed(CuttingNeedle(self._constants, self._cut))
        self._placement = Placement(
            _pair('guide', guide), _pair('tilt', tilt), checked('roll', roll), np.zeros(3)
        )
        start(self._constants, self._cut, self._pose(0.0), self.steering.free_length)

    def __repr__(self) -> str:
        x, y, z = (1e3 * self.tip).tolist()
        return f'<SteeredNeedle: tip at x {x:.3f}, depth {y:.2f}, z {z:.3f} mm>'

    def columns(self) -> dict[str, FloatArray]:
        depths, (x, z), (slope_x, slope_z) = (one.T for one in self.shape)
        return {
            'depth [m]': depths,
            'deflection_x [m]': x,
            'deflection_z [m]': z,
            'slope_x [1]': slope_x,
            'slope_z [1]': slope_z,
        }

    def _pose(self, depth: float) -> GuidePose:
        """Return the pose in the frame of the tissue."""
        (x, z), (tilt_x, tilt_z), roll, shift = self._placement
        return GuidePose(depth - shift[1], x - shift[0], tilt_x, z - shift[2], tilt_z, roll)

    def move(
        self,
        *,
        depth: float | None = None,
        guide: ArrayLike | None = None,
        tilt: ArrayLike | None = None,
        roll: float | None = None,
        tissue: ArrayLike | None = None,
    ) -> None:
        """
        Move to a depth of the tip [m], and guide position [m], tilt and roll [rad], if given.

        Guide and roll change linearly with the depth. To move the guide before the insertion, call
        this method twice. ``tissue`` is the displacement of the tissue with its path in x, y and z
        [m], which precedes the motion. ParameterError if a value is not valid.
        """
        to = self.depth if depth is None else checked('depth', depth)
        placement = self.checked(guide, tilt, roll, tissue)
        lowest, reach = placement.tissue[1], self.needle.length - self.steering.free_length
        if not lowest <= to <= reach:
            raise ParameterError(
                f'depth must be in [{lowest:g}, {reach:g}] m, the length of the needle '
                f'minus its free length, got {to!r} m'
            )
        self.bring(to, placement)

    def bring(self, depth: float, placement: Placement) -> None:
        """Move to a depth of the tip [m] within reach, and a placement of `checked`."""
        shift, before = placement.tissue, self._placement
        if shift is not before.tissue and (shift != before.tissue).any():
            here = self.depth
            self._placement = before._replace(tissue=shift)
            free = self.steering.free_length + float(shift[1])
            if free != self._cut.pose[FREE]:
                set_free(self._constants, self._cut, free)
            move_boxed(self._boxed, self._pose(here))
        self._placement = placement
        move_boxed(self._boxed, self._pose(depth))

    def checked(
        self,
        guide: ArrayLike | None,
        tilt: ArrayLike | None,
        roll: float | None,
        tissue: ArrayLike | None,
    ) -> Placement:
        """Check arguments of `move`, and return them with the present values for None."""
        now = self._placement
        if guide is None and tilt is None and roll is None and tissue is None:
            return now
        shift = now.tissue if tissue is None else floats('tissue', tissue, (3,))
        if self.steering.free_length + shift[1] < 0.0 or self.depth < shift[1]:
            raise ParameterError(f'tissue must stay between guide and tip, got {shift[1]:g} m')
        return Placement(
            now.guide if guide is None else _pair('guide', guide),
            now.tilt if tilt is None else _pair('tilt', tilt),
            now.roll if roll is None else checked('roll', roll),
            shift,
        )

    @property
    def depth(self) -> float:
        """Depth s of the tip [m]."""
        return float(self._cut.pose.item(DEPTH) + self._placement.tissue.item(1))

    @property
    def deepest(self) -> float:
        """Greatest depth reached, at the end of the path [m]."""
        return float(self._cut.pose[DEEPEST] + self._placement.tissue[1])

    @property
    def tip(self) -> FloatArray:
        """Tip position in x, y and z [m]; shape (3,)."""
        # Numbers of Python are faster than single elements of arrays.
        ((x, _), (z, _)), shift = self._cut.tip.tolist(), self._placement.tissue.tolist()
        return np.array([x + shift[0], self.depth, z + shift[2]])

    @property
    def guide(self) -> FloatArray:
        """Position of the guide in x and z [m]; shape (2,)."""
        return np.array(self._placement.guide)

    @property
    def roll(self) -> float:
        """Roll of the base [rad]."""
        return float(self._cut.pose[ROLL])

    @property
    def tip_roll(self) -> float:
        """Roll of the tip, which lags the roll of the base by the windup [rad]."""
        return float(self._cut.pose[TIP_ROLL])

    @property
    def load(self) -> FloatArray:
        """Lateral load on the tip in x and z [N]; shape (2,)."""
        return self._cut.load.copy()

    @property
    def compliance(self) -> FloatArray:
        """Tip deflection [m] and slope per lateral force [N] and moment [N m]; shape (2, 2)."""
        c00, c01, c11 = place(self._constants, self._cut)
        return np.array([[c00, c01], [c01, c11]])

    @property
    def authority(self) -> FloatArray:
        """Deflection [m] and slope of the resting tip per guide position [m] and tilt; (2, 2)."""
        found = np.empty((2, 2))
        guide_response(self._constants, self._cut, found)
        return found

    @property
    def path(self) -> NeedlePath:
        """Path cut by the tip, at its nodes and its end."""
        c = self._cut
        s, last = c.springs, int(c.counts[LAST])
        depths, values = s.depths[: last + 1], s.path[: last + 1, :, 0]
        rest = c.pose[DEEPEST] - s.depths[last]
        if rest > 0.0:
            p = s.path[last]
            end = p[:, 0] + rest * (p[:, 1] + 0.5 * rest * p[:, 2])
            depths, values = np.append(depths, c.pose[DEEPEST]), np.vstack([values, end])
        return NeedlePath(
            depths + self._placement.tissue[1], values + self._placement.tissue[[0, 2]]
        )

    def _solve(self) -> tuple[int, FloatArray, FloatArray]:
        found, load = np.empty((len(self._cut.springs.depths), 2, 2)), np.empty((2, 2))
        last = solve_shape(self._boxed, found, load)
        return last, found[: last + 1], load

    @property
    def shape(self) -> NeedleShape:
        """Shape of the needle from the guide to the tip, at its nodes."""
        c = self._cut
        last, found, _ = self._solve()
        whole = np.concatenate([c.guide[np.newaxis], found, c.tip[np.newaxis]])
        whole[:, :, 0] += self._placement.tissue[[0, 2]]
        depths = np.concatenate([[-c.pose[FREE]], c.springs.depths[: last + 1], [c.pose[DEPTH]]])
        return NeedleShape(depths + self._placement.tissue[1], whole[:, :, 0], whole[:, :, 1])

    @property
    def guide_load(self) -> FloatArray:
        """Reaction of the needle on the guide in x and z: forces [N], moments [N m]; (2, 2)."""
        return self._solve()[2].T


def inserted_shape(needle: SteeredNeedle, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return deflections [m] and slopes of a needle at points of the inserted part, (k, 2)."""
    depths, deflections, slopes = needle.shape
    # Cubic between two nodes; the exact shape deviates with the fourth power of their distance.
    i = np.clip(np.searchsorted(depths, points, side='right') - 1, 0, len(depths) - 2)
    h = (depths[i + 1] - depths[i])[:, np.newaxis]
    # A tip at a node repeats its depth.
    t = np.divide((points - depths[i])[:, np.newaxis], h, out=np.zeros_like(h), where=h > 0.0)
    a, b, u, v = deflections[i], deflections[i + 1], h * slopes[i], h * slopes[i + 1]
    bend, twist = 3.0 * (b - a) - 2.0 * u - v, 2.0 * (a - b) + u + v
    values = a + t * (u + t * (bend + t * twist))
    turns = np.divide(
        u + t * (2.0 * bend + 3.0 * t * twist), h, out=slopes[i].copy(), where=h > 0.0
    )
    return values, turns


def _pair(name: str, values: ArrayLike) -> tuple[float, float]:
    # The usual arguments, without the cost of arrays.
    if isinstance(values, (tuple, list)) and len(values) == 2:
        x, z = values
        if isinstance(x, float) and isinstance(z, float) and isfinite(x) and isfinite(z):
            return x, z
    x, z = floats(name, values, (2,)).tolist()
    return x, z
