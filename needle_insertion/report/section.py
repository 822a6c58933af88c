# SPDX-License-Identifier: Apache-2.0
"""Plane sections of an anatomy: structure and margin at each pixel, and their picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, TYPE_CHECKING

from needle_dynamics.arrays import FloatArray, IntArray
from needle_planning.anatomy import Anatomy, COVERS, ROLES, Structure
from needle_planning.clearance import Clearance, image_frame
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Colors by role, repeated if a role has more structures (Okabe and Ito; tissue is lighter).
_COLORS: Final = {
    'obstacle': ('#d55e00', '#0072b2', '#cc79a7', '#e69f00', '#5a4a8a', '#555555'),
    'target': ('#f0e442', '#d9e67a'),
    'entry': ('#56b4e9', '#9ad4f5'),
    'tissue': ('#f3e6d0', '#e2d3c4', '#e8e8d8', '#d9e2cc'),
}  # fmt: skip
_FREE: Final = '#ffffff'  #: color of voxels without a structure
OUTSIDE_COLOR: Final = '#c4c4c4'  #: color outside the image
MARGIN_COLOR: Final = '#8a2a00'  #: color of the stripes of a margin
_STRIPES: Final = 7  #: distance of the stripes [pixels]
_EDGE: Final = 0.55  #: brightness of the outline of a structure
_FONT: Final = 8.0  #: size of labels [points]
#: Height of a line, and width of a character, as multiples of the size.
_LINE, _CHARACTER = 1.5, 0.62
_LONGEST: Final = 40  #: longest name in a picture [characters]
_TRIES: Final = 6  #: places that are tried for a label
_LEAST_SHARE: Final = 0.34  #: least component of a direction that is named
_BAR: Final = 0.01  #: length of the scale bar [m]


class Plane(NamedTuple):
    """Rectangle in patient coordinates, of square pixels."""

    origin: FloatArray  #: point with the coordinates 0, 0 [m], shape (3,)
    axes: FloatArray  #: unit vectors to the right and up in the picture, rows, shape (2, 3)
    low: FloatArray  #: smallest coordinates [m], shape (2,)
    high: FloatArray  #: largest coordinates [m], shape (2,)
    pixel: float  #: size of a pixel [m]

    @property
    def points(self) -> FloatArray:
        """Centers of the pixels in patient coordinates, rows upward, shape (rows, columns, 3)."""
        count = np.maximum(np.rint((self.high - self.low) / self.pixel).astype(int), 1)
        u, v = (
            low + (np.arange(n) + 0.5) * (high - low) / n
            for low, high, n in zip(self.low, self.high, count, strict=True)
        )
        right, up = self.axes
        return np.asarray(self.origin + u[:, np.newaxis] * right + v[:, None, None] * up)

    @property
    def corners(self) -> FloatArray:
        """Corners in patient coordinates, shape (4, 3)."""
        ends = [(u, v) for u in (self.low[0], self.high[0]) for v in (self.low[1], self.high[1])]
        return np.asarray(self.origin + np.array(ends) @ self.axes)

    def coordinates(self, points: FloatArray) -> FloatArray:
        """Project points in patient coordinates, shape (..., 3), onto the plane, (..., 2)."""
        return np.asarray((points - self.origin) @ self.axes.T)


@dataclass(frozen=True, slots=True, eq=False)
class Legend:
    """Structures of all images of a patient, in the order in which they cover each other."""

    structures: Sequence[Structure]
    colors: Sequence[str]
    names: Sequence[str]  #: names in pictures

    def obstacle(self, name: str) -> tuple[str, str]:
        """Return the color of an obstacle and its name in pictures, grey and '' without a name."""
        for one, color, shown in zip(self.structures, self.colors, self.names, strict=True):
            if (one.role, one.name) == (ROLES[0], name):
                return color, shown
        return '#767676', ''


def legend_of(anatomies: Sequence[Anatomy], first: str = '') -> Legend:
    """Return the structures of images, each once, of obstacles `first` first."""
    every = {(s.role, s.name): s for one in anatomies for s in one.structures.values()}
    ordered = sorted(every.values(), key=lambda s: (COVERS.index(s.role), s.name != first, s.name))
    colors, used = [], dict.fromkeys(_COLORS, 0)
    for one in ordered:
        palette = _COLORS[one.role]
        colors.append(palette[used[one.role] % len(palette)])
        used[one.role] += 1
    return Legend(ordered, colors, _drawable([one.name for one in ordered]))


def _drawable(names: Sequence[str]) -> list[str]:
    """Return names of limited length in characters of the font, else numbers from 1."""
    from matplotlib.font_manager import findfont, get_font

    font = get_font(findfont('DejaVu Sans'))
    return [
        (name if len(name) <= _LONGEST else f'{name[: _LONGEST - 3]}...')
        if all(font.get_char_index(ord(one)) for one in name)
        else f'structure {number}'
        for number, name in enumerate(names, 1)
    ]


def sample(
    anatomies: Sequence[Anatomy], structures: Sequence[Structure], points: FloatArray
) -> IntArray:
    """
    Return the structure at points in patient coordinates, shape (..., 3).

    The number is that in `structures`, -1 without a structure, and -2 outside all images. Where
    images overlap, the first structure counts.
    """
    places = {(one.role, one.name): number for number, one in enumerate(structures)}
    free = len(structures)
    found = np.full(points.shape[:-1], free + 1, dtype=np.int64)
    for anatomy in anatomies:
        frame = image_frame(anatomy)
        index = np.floor(frame.of_patient(points) / frame.spacing + 0.5).astype(np.int64)
        inside = ((index >= 0) & (index < anatomy.labels.shape)).all(axis=-1)
        values, which = np.unique(
            anatomy.labels[tuple(index[inside].T)].astype(np.int64), return_inverse=True
        )
        numbers = np.full(len(values), free)
        for k, value in enumerate(values.tolist()):
            if (one := anatomy.structures.get(value)) is not None:
                numbers[k] = places[one.role, one.name]
        found[inside] = np.minimum(found[inside], numbers[which.ravel()])
    return np.where(found >= free, free - 1 - found, found)


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """Structures and margins in a plane."""

    plane: Plane
    numbers: IntArray  #: see `sample`, shape (rows, columns)
    margin: NDArray[np.bool_]  #: within the margin of an obstacle, same shape

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, lower and upper edge [mm]."""
        (left, low), (right, high) = 1e3 * self.plane.low, 1e3 * self.plane.high
        return float(left), float(right), float(low), float(high)


def section(
    anatomies: Sequence[Anatomy], legend: Legend, clearance: Clearance, radius: float, plane: Plane
) -> Section:
    """Return the section of images; `clearance` is for a needle with the radius [m]."""
    points = plane.points
    numbers = sample(anatomies, legend.structures, points)
    obstacles = sum(one.role == ROLES[0] for one in legend.structures)
    free = (numbers < 0) | (numbers >= obstacles)
    margin = np.zeros(numbers.shape, dtype=np.bool_)
    margin[free] = clearance.at(points[free]) + radius <= 0.0
    return Section(plane, numbers, margin)


def draw_section(axes: Axes, shown: Section, legend: Legend, line: FloatArray) -> None:
    """
    Draw a section with names, patient directions and a scale bar, lengths in mm.

    Labels leave the points `line` of the section free, shape (k, 2) [m].
    """
    from matplotlib.colors import to_rgb

    numbers = shown.numbers
    # The last two have the numbers -2 and -1.
    image = np.array([to_rgb(one) for one in (*legend.colors, OUTSIDE_COLOR, _FREE)])[numbers]
    rows, columns = np.indices(numbers.shape)
    stripes = shown.margin & ((rows + columns) % _STRIPES < 2)
    image[stripes] = to_rgb(MARGIN_COLOR)
    image[_edges(numbers) | _edges(shown.margin)] *= _EDGE
    axes.imshow(image, extent=shown.extent, origin='lower', interpolation='nearest')
    axes.set(xlim=shown.extent[:2], ylim=shown.extent[2:])
    axes.set_aspect('equal')
    labels = _Labels(axes, shown, line)
    labels.directions()
    labels.bar()
    labels.names(legend)


def directions(vector: FloatArray) -> str:
    """Return the patient direction of a unit vector, the largest component first, such as LP."""
    order = np.argsort(-np.abs(vector), kind='stable')
    return ''.join(
        ('LR', 'PA', 'IS')[axis][int(vector[axis] > 0.0)]
        for axis in order
        if abs(vector[axis]) >= _LEAST_SHARE
    )


def halo(width: float = 2.5) -> list[Any]:
    """Return the white outline of a line or text."""
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=width, foreground='white')]


def _edges(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Return the pixels that differ from the next one to the right or upward."""
    found = np.zeros(values.shape, dtype=np.bool_)
    found[:, :-1] = values[:, 1:] != values[:, :-1]
    found[:-1] |= values[1:] != values[:-1]
    return found


class _Labels:
    """Labels of a section, which do not overlap each other or the needle."""

    def __init__(self, axes: Axes, shown: Section, line: FloatArray) -> None:
        figure = axes.figure
        left, right, low, high = shown.extent
        axes.apply_aspect()
        width = axes.get_position().width * figure.get_figwidth() * 72.0  # type: ignore[union-attr]
        #: Size of a character and a line [mm].
        self.size = _FONT * (right - left) / width * np.array([_CHARACTER, _LINE])
        self.axes, self.shown, self.line = axes, shown, 1e3 * line
        self.middle = 0.5 * np.array([left + right, low + high])
        self.taken: list[tuple[FloatArray, FloatArray]] = []

    def put(self, x: float, y: float, text: str, **options: Any) -> None:
        size = self.size * (len(text), 1.0)
        self.taken.append((np.array([x, y]) - 0.5 * size, np.array([x, y]) + 0.5 * size))
        style: dict[str, Any] = {'fontsize': _FONT, 'ha': 'center', 'va': 'center'}
        box = {'boxstyle': 'round,pad=0.15', 'fc': 'w', 'ec': 'none', 'alpha': 0.8}
        # Names may contain a dollar sign.
        self.axes.text(x, y, text, bbox=box, parse_math=False, zorder=6, **(style | options))

    def fits(self, at: FloatArray, text: str) -> bool:
        half = 0.5 * self.size * (len(text), 1.0)
        low, high = at - half, at + half
        ends = np.reshape(self.shown.extent, (2, 2)).T
        if (low < ends[0]).any() or (high > ends[1]).any():
            return False
        if ((self.line >= low - 1.0) & (self.line <= high + 1.0)).all(axis=1).any():
            return False
        return not any(((low < b) & (high > a)).all() for a, b in self.taken)

    def directions(self) -> None:
        left, right, low, high = self.shown.extent
        (x, y), (wide, tall) = self.middle, self.size
        # Below the middle: the needle is there.
        side = y - 0.25 * (high - low)
        over, up = self.shown.plane.axes
        for vector, u, v in (
            (-over, left + 2.0 * wide, side),
            (over, right - 2.0 * wide, side),
            (-up, x, low + 0.7 * tall),
            (up, x, high - 0.7 * tall),
        ):
            self.put(u, v, directions(vector), fontweight='bold', fontsize=_FONT + 2.0)

    def bar(self) -> None:
        _, right, low, _ = self.shown.extent
        length, (wide, tall) = 1e3 * _BAR, self.size
        ends, height = (right - 2.0 * wide - length, right - 2.0 * wide), low + 0.8 * tall
        self.axes.plot(
            ends, (height, height), color='k', lw=3.0, path_effects=halo(5.5), zorder=6,
            solid_capstyle='butt',
        )  # fmt: skip
        self.put(sum(ends) / 2.0, height + 0.8 * tall, f'{length:g} mm')

    def names(self, legend: Legend) -> None:
        """Name each structure where it is widest, if there is place."""
        from scipy.ndimage import distance_transform_edt, find_objects

        left, _, low, _ = self.shown.extent
        pixel = 1e3 * self.shown.plane.pixel
        for number, box in enumerate(find_objects(np.maximum(self.shown.numbers + 1, 0))):
            if box is None:
                continue
            text = legend.names[number]
            mask = (self.shown.numbers[box] == number) & ~self.shown.margin[box]
            inner = distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
            first = np.array([left, low]) + pixel * np.array([box[1].start, box[0].start])
            for _ in range(_TRIES):
                row, column = np.unravel_index(inner.argmax(), inner.shape)
                radius = int(inner[row, column])
                if radius < 2:
                    break
                at = first + pixel * (np.array([column, row]) + 0.5)
                if self.fits(at, text):
                    self.put(at[0], at[1], text)
                    break
                # The next place is not near the present place.
                rows, columns = (slice(max(0, k - radius), k + radius + 1) for k in (row, column))
                inner[rows, columns] = 0.0
