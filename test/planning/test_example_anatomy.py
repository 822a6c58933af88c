# SPDX-License-Identifier: Apache-2.0
"""The synthetic segmentation of examples/liver: its content, and a straight path in it."""

from __future__ import annotations

from pathlib import Path
import runpy

from needle_planning import Anatomy, read_anatomy
import nrrd
import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, map_coordinates
from support.segmentations import positions_of

EXAMPLES = Path(__file__).parents[2] / 'examples'
FILE = EXAMPLES / 'liver/liver.seg.nrrd'


@pytest.fixture(scope='module')
def anatomy() -> Anatomy:
    (one,) = read_anatomy(FILE, EXAMPLES / 'liver/labels.yaml')
    return one


def test_script_writes_the_shipped_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same voxels and header; the compressed bytes depend on the version of zlib."""
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(EXAMPLES / 'anatomy.py'), run_name='__main__')
    (values, header), (shipped, other) = (nrrd.read(str(f)) for f in ('liver.seg.nrrd', FILE))
    np.testing.assert_array_equal(values, shipped)
    assert str(header) == str(other)
    assert FILE.stat().st_size < 50_000


def test_structures_are_where_the_script_puts_them(anatomy: Anatomy) -> None:
    """The tumor is 62 mm to the right of the origin, 12 mm in front and 10 mm above it."""
    tumor = positions_of(anatomy, 'tumor').mean(0)
    # The hepatic vein covers no part of it; a voxel is 2 mm.
    assert tumor == pytest.approx([0.062, 0.012, 0.010], abs=1e-3)
    assert positions_of(anatomy, 'entry')[:, 0].min() > 0.1
    body = positions_of(anatomy, 'body')
    # Half axes of the skin of 150 mm and 90 mm.
    assert np.all((body[:, 0] / 0.150) ** 2 + (body[:, 1] / 0.090) ** 2 < 1.0)


def test_some_straight_paths_are_free(anatomy: Anatomy) -> None:
    """Between a tenth and a half of the entries: the search has something to find and to avoid."""
    clearance = np.full(anatomy.labels.shape, np.inf)
    for label, one in anatomy.structures.items():
        if one.role == 'obstacle':
            distance = distance_transform_edt(anatomy.labels != label, sampling=2e-3)
            clearance = np.minimum(clearance, distance - one.margin)
    tumor = positions_of(anatomy, 'tumor').mean(0)
    entries = positions_of(anatomy, 'entry')
    lines = tumor + (entries - tumor)[:, None] * np.linspace(0.0, 1.0, 80)[:, None]
    indices = (lines - anatomy.to_patient[:3, 3]) / 2e-3
    smallest = map_coordinates(clearance, np.moveaxis(indices, -1, 0), order=1).min(1)
    assert 0.1 < np.mean(smallest > 0.0) < 0.5
