# SPDX-License-Identifier: Apache-2.0
"""Files and messages of a plan for 3D Slicer: coordinates, published formats, and surfaces."""

from __future__ import annotations

from collections import Counter
import json
from pathlib import Path
import struct
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_dynamics import FloatArray
from needle_dynamics.arrays import IntArray
from needle_insertion.cli import main
from needle_insertion.slicer import plan_files
from needle_insertion.slicer.link import HEADER
from needle_insertion.slicer.messages import PLAN, plan_messages, PLAN_MODEL
from needle_planning import read_plan
from needle_ros.errors import ParameterError
import numpy as np
from pyigtl.messages import CRC64, MessageBase
import pytest
from scipy.spatial.transform import Rotation
from support.anatomies import plan_of

LIVER = Path(__file__).parents[2] / 'examples' / 'liver'
SIGNS = {'RAS': (1.0, 1.0, 1.0), 'LPS': (-1.0, -1.0, 1.0)}


def volume(points: FloatArray, triangles: IntArray) -> float:
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    return float(np.einsum('ij,ij->', a - points[0], np.cross(b - points[0], c - points[0])) / 6.0)


def read_markups(text: str) -> tuple[dict[str, Any], FloatArray]:
    """Check the rules of the published schema 1.0.3; return the markup and its points, RAS."""
    document = json.loads(text)
    assert {'@schema', 'markups'} <= document.keys()
    assert document['@schema'].endswith('/markups-schema-v1.0.3.json#')
    # 3D Slicer reads the first markup of a file.
    (markup,) = document['markups']
    kinds = 'Fiducial', 'Line', 'Angle', 'Curve', 'ClosedCurve', 'Plane', 'ROI'
    assert markup['type'] in kinds
    assert markup['coordinateSystem'] in SIGNS
    assert markup['coordinateUnits'] in ('mm', 'um')
    types = {'name': str, 'locked': bool, 'labelFormat': str}
    assert all(type(markup[key]) is of for key, of in types.items())
    types = {'id': str, 'label': str, 'selected': bool, 'locked': bool, 'visibility': bool}
    for control in markup['controlPoints']:
        assert all(type(control[key]) is of for key, of in types.items())
        assert control['positionStatus'] in ('undefined', 'preview', 'defined')
        assert len(control['position']) == 3
        assert all(type(value) is float for value in control['position'])
    numbers = [control['id'] for control in markup['controlPoints']]
    assert len(set(numbers)) == len(numbers)
    points = np.array([control['position'] for control in markup['controlPoints']])
    return markup, points * SIGNS[markup['coordinateSystem']]


def read_model(text: str) -> tuple[FloatArray, IntArray, FloatArray]:
    """Read a legacy VTK file; return points in its own coordinates, triangles, and scalars."""
    head, title, kind, dataset, *lines = text.splitlines()
    assert head.startswith('# vtk DataFile Version ')
    # Longer titles are cut by readers; 3D Slicer reads the coordinates from here.
    assert len(title) < 256
    assert 'SPACE=LPS' in title
    assert (kind, dataset) == ('ASCII', 'DATASET POLYDATA')
    words = iter(' '.join(lines).split())

    def take(count: int) -> list[str]:
        return [next(words) for _ in range(count)]

    assert next(words) == 'POINTS'
    count = int(next(words))
    assert next(words) == 'float'
    points = np.array(take(3 * count), dtype=np.float64).reshape(-1, 3)
    assert next(words) == 'POLYGONS'
    faces, size = map(int, take(2))
    polygons = np.array(take(size), dtype=np.int64).reshape(faces, 4)
    assert (polygons[:, 0] == 3).all()
    assert take(2) == ['POINT_DATA', str(count)]
    assert take(4) == ['SCALARS', 'clearance_mm', 'float', '1']
    assert take(2) == ['LOOKUP_TABLE', 'default']
    scalars = np.array(list(words), dtype=np.float64)
    assert len(scalars) == count
    return points, polygons[:, 1:], scalars


@settings(deadline=None, max_examples=100)
@given(st.integers(0, 10**6), st.integers(2, 40))
def test_tube_is_closed_with_the_radius_of_the_needle(seed: int, count: int) -> None:
    """In any direction, outside outward, and after a round trip through the file."""
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=seed).as_matrix()
    bow = np.stack([np.linspace(0.0, 80.0, count), *rng.normal(0.0, 0.02, (2, count))], axis=1)
    line, radius = bow @ turn + rng.normal(0.0, 100.0, 3), float(rng.uniform(0.2, 2.0))
    points, triangles = plan_files._tube(line, radius)
    away = np.linalg.norm(points[:-2].reshape(count, -1, 3) - line[:, np.newaxis], axis=2)
    np.testing.assert_allclose(away, radius, rtol=1e-12)
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
    edges = Counter(map(tuple, ends.tolist()))
    assert set(edges.values()) == {1}
    assert all((b, a) in edges for a, b in edges)
    # A polygon of twelve sides has 0.955 of the area of its circle; the bow is small.
    expected = 0.955 * np.pi * radius**2 * 80.0
    assert volume(points, triangles) == pytest.approx(expected, rel=0.01)
    shape = plan_files.PlannedShape(line, line, points, triangles)
    found, same, scalars = read_model(plan_files._model(shape, np.arange(float(count))))
    # Written to 0.0001 mm.
    np.testing.assert_allclose(found * SIGNS['LPS'], points, atol=5.1e-5)
    assert volume(found, same) == pytest.approx(expected, rel=0.01)
    np.testing.assert_array_equal(scalars[:-2].reshape(count, -1)[:, 0], np.arange(count))


@settings(deadline=None, max_examples=100)
@given(st.lists(st.tuples(*[st.floats(-1e3, 1e3)] * 3), min_size=1, max_size=9))
def test_markups_have_the_coordinates_of_the_points(points: list[tuple[float, ...]]) -> None:
    text = plan_files._markups('Curve', 'a "name"', np.array(points), ())
    markup, found = read_markups(text)
    assert markup['name'] == 'a "name"'
    # Written to 0.0001 mm.
    np.testing.assert_allclose(found, points, atol=5.1e-5)


@settings(deadline=None, max_examples=10)
@given(st.integers(0, 10**6))
def test_shape_of_a_straight_plan_is_its_line(seed: int) -> None:
    """In any direction, from the entry point to the target; messages have the same coordinates."""
    rng = np.random.default_rng(seed)
    direction = Rotation.random(random_state=seed).as_matrix()[0]
    plan = plan_of(rng.normal(0.0, 0.1, 3), direction)
    shape = plan_files.planned_shape(plan)
    np.testing.assert_allclose(shape.curve[0], 1e3 * plan.entry, atol=1e-6)
    np.testing.assert_allclose(shape.curve[-1], 1e3 * plan.target, atol=1e-6)
    # Outside of the skin, in the direction of the insertion.
    assert (shape.rings[0] - 1e3 * plan.entry) @ direction < -10.0
    curve, model = plan_messages(shape, 5 * 10**9)
    for data in (curve, model):
        assert HEADER.unpack(data[: HEADER.size])[-1] == CRC64(data[HEADER.size :])
    fields = MessageBase.parse_header(curve[: HEADER.size])
    points = MessageBase.create_message('POINT')
    points.unpack(fields, curve[HEADER.size :])
    assert (fields['device_name'], points.names[-1]) == (PLAN, f'{PLAN}{len(shape.curve) - 1}')
    # Messages have 24 bits.
    np.testing.assert_allclose(points.positions, shape.curve, atol=1e-4)
    fields = MessageBase.parse_header(model[: HEADER.size])
    assert (fields['message_type'], fields['device_name']) == ('POLYDATA', PLAN_MODEL)
    # The header of POLYDATA: numbers and sizes in bytes.
    body = model[HEADER.size :]
    count, *rest = struct.unpack('>10I', body[:40])
    polygons = len(shape.triangles)
    assert rest == [0, 0, 0, 0, polygons, 16 * polygons, 0, 0, 0]
    at = np.frombuffer(body[40 : 40 + 12 * count], '>f4').reshape(-1, 3)
    np.testing.assert_allclose(at, shape.points, atol=1e-4)
    faces = np.frombuffer(body[40 + 12 * count :], '>u4').reshape(-1, 4)
    assert (faces[:, 0] == 3).all()
    np.testing.assert_array_equal(faces[:, 1:], shape.triangles)


def test_needle_that_differs_from_the_plan_is_one_line() -> None:
    plan = plan_of(np.zeros(3), np.array([0.0, 0.0, -1.0]), displaced=1e-3)
    with pytest.raises(ParameterError, match='is not the one of the plan: its tip ends') as error:
        plan_files.planned_shape(plan)
    assert len(str(error.value).splitlines()) == 1


def test_command_writes_the_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """They have the entry point, the target and the clearance of the plan."""
    folder, file = tmp_path / 'new' / 'slicer', tmp_path / 'plan.yaml'
    words = ['plan', str(LIVER / 'liver.seg.nrrd'), '--labels', str(LIVER / 'labels.yaml')]
    words += ['--target', '62mm,12mm,10mm', '--straight', '--resolution', '2mm']
    assert main([*words, '--slicer', str(folder), '-o', str(file)]) == 0
    written = [line for line in capsys.readouterr().out.splitlines() if line.startswith('wrote')]
    names = ['needle.mrk.json', 'points.mrk.json', 'needle.vtk']
    assert written == [f'wrote {one}' for one in [file, *(folder / name for name in names)]]
    plan = read_plan(file)
    markup, points = read_markups((folder / 'points.mrk.json').read_text())
    assert markup['type'] == 'Fiducial'
    assert [one['label'] for one in markup['controlPoints']] == ['ENTRY', 'TARGET']
    # Files are written to 0.0001 mm.
    np.testing.assert_allclose(points, 1e3 * np.stack([plan.entry, plan.target]), atol=5.1e-5)
    markup, curve = read_markups((folder / 'needle.mrk.json').read_text())
    assert markup['type'] == 'Curve'
    np.testing.assert_allclose(curve[[0, -1]], points, atol=1e-3)
    model, _, clearances = read_model((folder / 'needle.vtk').read_text())
    # The last point of the model is the tip.
    np.testing.assert_allclose(model[-1] * SIGNS['LPS'], points[1], atol=1e-3)
    # The rings are up to 0.75 mm from the least clearance, which changes as the distance.
    assert clearances.min() == pytest.approx(1e3 * plan.clearance, abs=0.8)


def test_folder_that_cannot_be_written_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'file').write_text('')
    words = ['plan', str(LIVER / 'liver.seg.nrrd'), '--labels', str(LIVER / 'labels.yaml')]
    words += ['--target', '62mm,12mm,10mm', '--slicer', str(tmp_path / 'file')]
    assert main(words) == 2
    assert 'is not a folder' in capsys.readouterr().err
