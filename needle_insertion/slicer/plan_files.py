# SPDX-License-Identifier: Apache-2.0
"""Files of a plan for 3D Slicer: markups (JSON) and a model (VTK), without pyigtl."""

from __future__ import annotations

from collections.abc import Sequence
import json
from pathlib import Path
from typing import Any, Final, NamedTuple

from needle_controller.steering.insertion_plan import Plan
from needle_dynamics.arrays import FloatArray, IntArray
from needle_insertion.report.insertion import evenly
from needle_insertion.slicer.needle import MILLIMETERS
from needle_planning.anatomy import Anatomy
from needle_planning.clearance import Clearance
from needle_planning.planned_needle import complete_needle
from needle_planning.voxels import SPACES
from needle_ros.files import write_whole
import numpy as np

#: Coordinates of the files, stated in each: those in which 3D Slicer writes its own files.
SPACE: Final = 'LPS'

#: Files of a folder.
CURVE: Final = 'needle.mrk.json'
POINTS: Final = 'points.mrk.json'
MODEL: Final = 'needle.vtk'

_SCHEMA: Final = (
    'https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/'
    'Schema/markups-schema-v1.0.3.json#'
)
_OUTSIDE: Final = 0.03  #: Length of the model before the entry point [m].
_APART: Final = 4e-3  #: Distance of the points of a curve [m].
_RINGS: Final = 1.5e-3  #: Distance of the rings of a model [m].
_SIDES: Final = 12  #: Sides of a tube.


class PlannedShape(NamedTuple):
    """Needle of a plan in the images; coordinates are in mm, RAS."""

    curve: FloatArray  #: from the entry point to the tip, shape (n, 3)
    rings: FloatArray  #: axis of the model, from outside the skin to the tip, shape (r, 3)
    points: FloatArray  #: points of the model, 12 of each ring and both ends, shape (12 r + 2, 3)
    triangles: IntArray  #: counterclockwise seen from outside, shape (m, 3)


def planned_shape(plan: Plan) -> PlannedShape:
    """Return curve and model of the needle; `ParameterError` if it is not that of the plan."""
    line = MILLIMETERS * complete_needle(plan)
    long = MILLIMETERS * complete_needle(plan, _OUTSIDE)
    rings = _sampled(long, MILLIMETERS * _RINGS)
    points, triangles = _tube(rings, MILLIMETERS * plan.radius)
    return PlannedShape(_sampled(line, MILLIMETERS * _APART), rings, points, triangles)


def _sampled(line: FloatArray, apart: float) -> FloatArray:
    length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    return np.array(evenly(line.tolist(), min(len(line), max(2, round(length / apart) + 1))))


def _tube(line: FloatArray, radius: float) -> tuple[FloatArray, IntArray]:
    """Return points and triangles of a tube with closed ends around a line, shape (r, 3)."""
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    # The needle is nearly straight: one direction across all rings.
    first = np.eye(3)[np.abs(along[0]).argmin()]
    side = first - (along @ first)[:, np.newaxis] * along
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    angles = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    around = np.cos(angles)[:, np.newaxis] * side[:, np.newaxis]
    around = around + np.sin(angles)[:, np.newaxis] * np.cross(along, side)[:, np.newaxis]
    rings = (line[:, np.newaxis] + radius * around).reshape(-1, 3)
    k = np.arange(_SIDES)
    low = _SIDES * np.arange(len(line) - 1)[:, np.newaxis]
    a, b = low + k, low + (k + 1) % _SIDES
    sides = np.stack([[a, b, b + _SIDES], [a, b + _SIDES, a + _SIDES]], axis=0)
    start, end = len(rings), len(rings) + 1
    last = len(rings) - _SIDES
    ends = [
        *zip([start] * _SIDES, np.roll(k, -1).tolist(), k.tolist(), strict=True),
        *zip([end] * _SIDES, (last + k).tolist(), (last + np.roll(k, -1)).tolist(), strict=True),
    ]
    triangles = np.concatenate([np.moveaxis(sides, 1, -1).reshape(-1, 3), np.array(ends)])
    return np.concatenate([rings, line[[0, -1]]]), triangles


def write_slicer(plan: Plan, anatomies: Sequence[Anatomy], folder: Path) -> list[Path]:
    """
    Write a plan for 3D Slicer: curve, entry and target, and model; lengths in mm.

    Parameters
    ----------
    plan : Plan
        Plan.
    anatomies : sequence of Anatomy
        Images of the plan; the model has its clearance to their obstacles.
    folder : Path
        Existing folder; files of the same names are replaced.

    Returns
    -------
    list of Path
        Written files.

    """
    shape = planned_shape(plan)
    axis = shape.rings / MILLIMETERS
    clearances = Clearance(anatomies, axis, radius=plan.radius).at(axis)
    ends = MILLIMETERS * np.stack([plan.entry, plan.target])
    content = {
        CURVE: _markups('Curve', 'planned needle', shape.curve, ()),
        POINTS: _markups('Fiducial', 'plan', ends, ('ENTRY', 'TARGET')),
        MODEL: _model(shape, MILLIMETERS * clearances),
    }
    for name, text in content.items():
        write_whole(folder / name, text.encode())
    return [folder / name for name in content]


def _in_file(points: FloatArray) -> FloatArray:
    return np.asarray(points * SPACES[SPACE] + 0.0)


def _markups(kind: str, name: str, points: FloatArray, labels: Sequence[str]) -> str:
    controls: list[dict[str, Any]] = [
        {
            'id': str(number),
            'label': labels[number - 1] if labels else f'{name}-{number}',
            'position': [round(value, 4) for value in position],
            'selected': True,
            'locked': True,
            'visibility': True,
            'positionStatus': 'defined',
        }
        for number, position in enumerate(_in_file(points).tolist(), 1)
    ]
    markup = {
        'type': kind,
        'name': name,
        'coordinateSystem': SPACE,
        'coordinateUnits': 'mm',
        'locked': True,
        'labelFormat': '%N-%d',
        'controlPoints': controls,
    }
    return json.dumps({'@schema': _SCHEMA, 'markups': [markup]}, indent=1) + '\n'


def _model(shape: PlannedShape, clearances: FloatArray) -> str:
    """Return a polygonal model in the legacy format of VTK, with the clearance of each point."""
    points, triangles = _in_file(shape.points), shape.triangles
    # The mirrored triangles keep their outer side.
    if np.prod(SPACES[SPACE]) < 0.0:
        triangles = triangles[:, ::-1]
    each = np.concatenate([np.repeat(clearances, _SIDES), clearances[[0, -1]]])
    return '\n'.join(
        [
            '# vtk DataFile Version 3.0',
            f'needle_insertion, lengths in mm. SPACE={SPACE}',
            'ASCII',
            'DATASET POLYDATA',
            f'POINTS {len(points)} float',
            *(' '.join(f'{value:.4f}' for value in point) for point in points.tolist()),
            f'POLYGONS {len(triangles)} {4 * len(triangles)}',
            *(f'3 {a} {b} {c}' for a, b, c in triangles.tolist()),
            f'POINT_DATA {len(points)}',
            'SCALARS clearance_mm float 1',
            'LOOKUP_TABLE default',
            *(f'{value:.3f}' for value in each.tolist()),
            '',
        ]
    )
