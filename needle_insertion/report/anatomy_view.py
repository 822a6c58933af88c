# SPDX-License-Identifier: Apache-2.0
"""Anatomy in 3D with the needle of a plan, for the page of a plan and `needle watch`."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from needle_controller.steering.insertion_plan import Plan
from needle_dynamics.arrays import FloatArray, IntArray
from needle_insertion.report.insertion import evenly
from needle_insertion.report.page import Interactive
from needle_insertion.report.section import legend_of
from needle_insertion.report.surface import Surface, surfaces
from needle_planning.anatomy import Anatomy
from needle_planning.chance import Chance
from needle_planning.clearance import Clearance
from needle_planning.planned_needle import complete_needle
import numpy as np

#: Triangles of all structures, 13 bytes of the page each, and of one structure.
_TRIANGLES: Final = 48_000
_MOST, _LEAST = 12_000, 60
_STRUCTURES: Final = 400  #: Most structures that are drawn; obstacles are first.
_POINTS: Final = 60  #: Points of a needle.
_OUTSIDE: Final = 0.015  #: Length of the needle before the entry point [m].


@dataclass(frozen=True, eq=False)
class AnatomyView(Interactive):
    """Surfaces of all structures, the needle colored by its clearance, and inserted needles."""

    caption: str
    plan: Plan
    anatomies: Sequence[Anatomy]
    chance: Chance | None = None  #: simulated insertions

    @property
    def scripts(self) -> Sequence[str]:
        return 'needle.js', 'anatomy.js', 'anatomy_page.js'

    @property
    def content(self) -> Mapping[str, Any]:
        plan, chance = self.plan, self.chance
        structures, unit = _structures(self.anatomies, plan)
        whole = complete_needle(plan, _OUTSIDE)
        needle = whole[evenly(range(len(whole)), min(_POINTS, len(whole)))]
        clearance = Clearance(self.anatomies, needle, radius=plan.radius)
        return {
            'unit': unit,
            'entry': _rounded(plan.entry),
            'target': _rounded(plan.target),
            'axes': plan.axes.tolist(),
            'structures': structures,
            'needle': {
                'points': _rounded(needle),
                'radius': _rounded(plan.radius),
                'clearance': _rounded(clearance.at(needle)),
            },
            'inserted': [
                {'points': _rounded(line), 'success': bool(chance.values['success'][k])}
                for k, line in enumerate(chance.shafts)
            ]
            if chance is not None
            else [],
        }


def _rounded(lengths: FloatArray | float) -> Any:
    """Return lengths in mm, to 0.01 mm."""
    return (np.round(1e3 * np.asarray(lengths), 2) + 0.0).tolist()


def _structures(anatomies: Sequence[Anatomy], plan: Plan) -> tuple[list[dict[str, Any]], float]:
    """Return the surfaces for the script, and the unit of their coordinates [mm]."""
    legend = legend_of(anatomies, plan.structure)
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
