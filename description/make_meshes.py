"""
Make the meshes that the robot description draws, as binary STL.

Run as ``python description/make_meshes.py``; the same files come out each time. Lengths in m, y
along the needle. The needle has length and radius 1: the description scales it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import pairwise
from math import cos, pi, sin
from pathlib import Path
import struct
from typing import Final

#: Corners of what is round.
_CORNERS: Final = 16

_Point = tuple[float, float, float]
_Triangle = tuple[_Point, _Point, _Point]


def turned(profile: list[tuple[float, float]]) -> list[_Triangle]:
    """
    Return the surface that a closed outline makes when it is turned about y.

    Parameters
    ----------
    profile : list of (float, float)
        Radius and y of its corners [m], in the order in which y falls on the outside.

    Returns
    -------
    list of triangles
        Their corners, counterclockwise as seen from outside.

    """
    angles = [2.0 * pi * k / _CORNERS for k in range(_CORNERS + 1)]
    # The last is the first, to the last bit.
    angles[-1] = 0.0
    triangles = []
    for (r, y), (q, z) in pairwise([*profile, profile[0]]):
        for a, b in pairwise(angles):
            corners = [
                (radius * cos(angle), height, radius * sin(angle))
                for radius, height, angle in ((r, y, a), (r, y, b), (q, z, b), (q, z, a))
            ]
            first, second, third, fourth = corners
            triangles += [(first, second, third), (first, third, fourth)]
    # On the axis a side has no length.
    return [one for one in triangles if len({*one}) == 3]


def box(low: _Point, high: _Point) -> list[_Triangle]:
    """
    Return the surface of a box.

    Parameters
    ----------
    low, high : (float, float, float)
        Opposite corners [m].

    Returns
    -------
    list of triangles
        Their corners, counterclockwise as seen from outside.

    """
    triangles = []
    for axis in range(3):
        after, last = (axis + 1) % 3, (axis + 2) % 3
        for side, end in ((low, 0), (high, 1)):
            corners = []
            for u, v in ((0, 0), (1, 0), (1, 1), (0, 1)):
                corner = [0.0, 0.0, 0.0]
                corner[axis] = side[axis]
                corner[after] = (low, high)[u][after]
                corner[last] = (low, high)[v][last]
                corners.append((corner[0], corner[1], corner[2]))
            first, second, third, fourth = corners if end else corners[::-1]
            triangles += [(first, second, third), (first, third, fourth)]
    return triangles


def needle() -> list[_Triangle]:
    """
    Return a needle from its base at y = 0 to its tip at y = 1.

    Returns
    -------
    list of triangles
        A rod with a point.

    """
    return turned([(0.0, 1.0), (1.0, 0.99), (1.0, 0.0), (0.0, 0.0)])


def base() -> list[_Triangle]:
    """
    Return what carries the needle: a block, and the hub that ends at the base.

    Returns
    -------
    list of triangles
        Behind y = 0.

    """
    hub = turned([(0.0, 0.0), (0.0025, 0.0), (0.004, -0.015), (0.0, -0.015)])
    return hub + box((-0.02, -0.045, -0.015), (0.02, -0.015, 0.015))


def guide() -> list[_Triangle]:
    """
    Return the tube that guides the needle, which ends at y = 0.

    Returns
    -------
    list of triangles
        Behind y = 0.

    """
    return turned([(0.001, 0.0), (0.003, 0.0), (0.006, -0.006), (0.006, -0.012), (0.001, -0.012)])


#: What makes each mesh, by the name of its file.
MESHES: Final[dict[str, Callable[[], list[_Triangle]]]] = {
    'needle': needle,
    'base': base,
    'guide': guide,
}


def stl(triangles: Iterable[_Triangle]) -> bytes:
    """
    Write triangles as binary STL.

    Parameters
    ----------
    triangles : iterable of triangles
        Their corners.

    Returns
    -------
    bytes
        Content of the file. Normals are zero: who draws it computes them.

    """
    facets = [
        struct.pack('<12fH', 0.0, 0.0, 0.0, *(x for corner in corners for x in corner), 0)
        for corners in triangles
    ]
    head = b'needle_insertion, description/make_meshes.py'.ljust(80)
    return b''.join([head, struct.pack('<I', len(facets)), *facets])


if __name__ == '__main__':
    for name, make in MESHES.items():
        path = Path(__file__).resolve().parent / 'meshes' / f'{name}.stl'
        path.write_bytes(stl(make()))
