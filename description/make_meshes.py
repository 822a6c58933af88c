# SPDX-License-Identifier: Apache-2.0
"""
Generate the meshes of the robot description as binary STL.

Run as ``python description/make_meshes.py``; the output is reproducible. Lengths in m, y along the
needle. The needle has length and radius 1: the description scales it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import pairwise
from math import cos, pi, sin
from pathlib import Path
import struct
from typing import Final

#: Number of segments of round parts.
_CORNERS: Final = 16

_Point = tuple[float, float, float]
_Triangle = tuple[_Point, _Point, _Point]


def turned(profile: list[tuple[float, float]]) -> list[_Triangle]:
    """
    Return the surface of revolution of a closed profile about y.

    The profile has radius and y of its corners [m], in the order in which y decreases on the
    outside. The triangles are counterclockwise as seen from outside.
    """
    angles = [2.0 * pi * k / _CORNERS for k in range(_CORNERS + 1)]
    # Close the surface exactly.
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
    # Remove degenerate triangles on the axis.
    return [one for one in triangles if len({*one}) == 3]


def box(low: _Point, high: _Point) -> list[_Triangle]:
    """Return the surface of a box between corners [m], counterclockwise seen from outside."""
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
    """Return a needle from its base at y = 0 to its tip at y = 1."""
    return turned([(0.0, 1.0), (1.0, 0.99), (1.0, 0.0), (0.0, 0.0)])


def base() -> list[_Triangle]:
    """Return the needle holder: a block, and a hub that ends at y = 0."""
    hub = turned([(0.0, 0.0), (0.0025, 0.0), (0.004, -0.015), (0.0, -0.015)])
    return hub + box((-0.02, -0.045, -0.015), (0.02, -0.015, 0.015))


def guide() -> list[_Triangle]:
    """Return the guide tube of the needle, which ends at y = 0."""
    return turned([(0.001, 0.0), (0.003, 0.0), (0.006, -0.006), (0.006, -0.012), (0.001, -0.012)])


#: Function of each mesh by file name.
MESHES: Final[dict[str, Callable[[], list[_Triangle]]]] = {
    'needle': needle,
    'base': base,
    'guide': guide,
}


def stl(triangles: Iterable[_Triangle]) -> bytes:
    """Serialize triangles as binary STL; normals are zero, because viewers compute them."""
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
