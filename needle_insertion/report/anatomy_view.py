# SPDX-License-Identifier: Apache-2.0
"""Anatomy in 3D with the needle of a plan, for the page of a plan and `needle watch`."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from needle_dynamics.arrays import FloatArray, IntArray
from needle_insertion.report.insertion import evenly
from needle_insertion.report.page import Interactive
from needle_insertion.report.section import Legend
from needle_insertion.report.surface import Surface, surfaces
from needle_planning.anatomy import Anatomy
from needle_planning.plan import Plan
import numpy as np

#: Triangles of all structures, 13 bytes of the page each, and of one structure.
_TRIANGLES: Final = 48_000
_MOST, _LEAST = 12_000, 60
_STRUCTURES: Final = 400  #: Most structures that are drawn; obstacles are first.
_POINTS: Final = 60  #: Points of a needle.


@dataclass(frozen=True, eq=False)
class AnatomyView(Interactive):
    """Surfaces of all structures, the needle colored by its clearance, and inserted needles."""

    caption: str
    plan: Plan
    anatomies: Sequence[Anatomy]
    legend: Legend
    needle: FloatArray  #: points of the complete needle in patient coordinates [m], shape (k, 3)
    clearances: FloatArray  #: clearance of each point [m], shape (k,)
    inserted: FloatArray  #: inserted needles in patient coordinates [m], shape (m, p, 3)
    success: Sequence[bool]  #: whether each of them succeeds

    @property
    def scripts(self) -> Sequence[str]:
        return 'needle.js', 'anatomy.js', 'anatomy_page.js'

    @property
    def content(self) -> Mapping[str, Any]:
        structures, unit = _structures(self.anatomies, self.legend, self.plan)
        some = evenly(range(len(self.needle)), min(_POINTS, len(self.needle)))
        return {
            'unit': unit,
            'entry': _rounded(self.plan.entry),
            'target': _rounded(self.plan.target),
            'structures': structures,
            'needle': {
                'points': _rounded(self.needle[some]),
                'radius': _rounded(self.plan.radius),
                'clearance': _rounded(self.clearances[some]),
            },
            'inserted': [
                {'points': _rounded(line), 'success': success}
                for line, success in zip(self.inserted, self.success, strict=True)
            ],
        }


def _rounded(lengths: FloatArray | float) -> Any:
    """Return lengths in mm, to 0.01 mm."""
    return (np.round(1e3 * np.asarray(lengths), 2) + 0.0).tolist()


def _structures(
    anatomies: Sequence[Anatomy], legend: Legend, plan: Plan
) -> tuple[list[dict[str, Any]], float]:
    """Return the surfaces for the script, and the unit of their coordinates [mm]."""
    shown = list(enumerate(legend.structures))[:_STRUCTURES]
    most = int(np.clip(_TRIANGLES // max(len(shown), 1), _LEAST, _MOST))
    numbers = {(one.role, one.name): number for number, one in shown}
    found: list[tuple[int, Surface]] = [
        (numbers[one.role, one.name], surface)
        for anatomy in anatomies
        for one, surface in surfaces(anatomy, most)
        if (one.role, one.name) in numbers and len(surface.triangles)
    ]
    # Around the middle of the needle, as in the script.
    middle = 1e3 * (plan.entry + plan.target) / 2.0
    places = [1e3 * surface.points - middle for _, surface in found]
    largest = max((float(np.abs(one).max()) for one in places), default=1.0)
    unit = float(f'{largest / 32_767:.6e}') * (1.0 + 1e-6)
    return [
        {
            'name': legend.structures[number].name,
            'role': legend.structures[number].role,
            'color': legend.colors[number],
            'points': _text(np.rint(points / unit), '<i2'),
            'triangles': _text(surface.triangles, '<u2'),
        }
        for (number, surface), points in zip(found, places, strict=True)
    ], unit


def _text(values: FloatArray | IntArray, kind: str) -> str:
    return base64.b64encode(values.astype(kind).tobytes()).decode('ascii')
