# SPDX-License-Identifier: Apache-2.0
"""Roles of labels, and the anatomy that they make of segmentations."""

from __future__ import annotations

from math import isnan
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_planning import read_anatomy, SegmentationError
from needle_planning.labels import read_labels
from needle_ros.errors import ParameterError
import numpy as np
import pytest
from support.segmentations import (
    LPS,
    positions_of,
    ROLES,
    write_labels,
    write_nifti,
    write_nrrd,
)  # fmt: skip
import yaml

AFFINE = np.diag([2.0, 2.0, 2.0, 1.0])

COMPLETE = """
structures:
  liver: {role: tissue, stiffness: 20kPa, spread: 3e-1, source: a paper}
  vein: {role: obstacle, margin: 2e-3}
  7: {name: aorta, role: obstacle, margin: 5mm}
  tumor: {role: target}
  skin: {role: entry}
others: {role: tissue}
space: LPS
spacing: 0.5mm
"""


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / 'labels.yaml'
    path.write_text(text, 'utf-8')
    return path


def blocks(count: int) -> np.ndarray:
    """Return an image with labels from 1, each with four voxels."""
    values = np.zeros((count + 2, 2, 2), np.uint8)
    values[1:-1] = np.arange(1, count + 1)[:, None, None]
    return values


def test_structures_are_in_the_order_of_their_rank(tmp_path: Path) -> None:
    """Obstacles by margin, target, entry, tissue, others; lengths in m."""
    labels = read_labels(written(tmp_path, COMPLETE))
    found = [(one.name, one.role, one.margin) for one in labels.structures.values()]
    assert found == [
        ('aorta', 'obstacle', 0.005), ('vein', 'obstacle', 0.002), ('tumor', 'target', 0.0),
        ('skin', 'entry', 0.0), ('liver', 'tissue', 0.0), ('others', 'tissue', 0.0),
    ]  # fmt: skip
    liver = labels.structures[labels.numbers['liver']]
    assert (liver.stiffness, liver.spread, liver.source) == (2e4, 0.3, 'a paper')
    assert isnan(labels.structures[labels.others].stiffness)
    assert (labels.grid.space, labels.grid.spacing) == ('LPS', 5e-4)


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        ('', 'labels have the keys structures, others, space, spacing'),
        ('structures: [', 'is not YAML'),
        ('structures: {}', 'structures must have 1 to 254 labels'),
        ('structure: {}', "unknown parameter 'structure'; did you mean 'structures'"),
        ('structures: {1: obstacle}', 'structures: 1 must have a role'),
        ('structures: {1: {role: vessel}}', 'must be one of obstacle, tissue, target, entry'),
        ('structures: {1: {margin: 1mm}}', 'must be one of obstacle, tissue, target, entry'),
        ('structures: {1: {role: obstacle}}', 'is an obstacle and must have a margin'),
        ('structures: {1: {role: obstacle, margn: 1}}', "did you mean 'structures: 1.margin'"),
        ('structures: {1: {role: obstacle, margin: -1}}', 'structures: 1.margin must be'),
        ('structures: {1: {role: obstacle, margin: 1 inch}}', 'unit of m, cm, mm, um'),
        ('structures: {1: {role: obstacle, margin: 2}}', '2 m, .* write 2mm for 2 mm'),
        ('structures: {1: {role: tissue, stiffness: 20}}', r'20 N/m\^2, .* write 20kPa for'),
        ('structures: {1: {role: obstacle, margin: .nan}}', 'structures: 1.margin must be finite'),
        ('structures: {1: {role: obstacle, margin: 1, stiffness: 1}}', 'not of the role obstacle'),
        ('structures: {1: {role: tissue, margin: 1}}', 'not of the role tissue; valid: role,'),
        ('structures: {1: {role: tissue, spread: 1}}', 'has a spread or a source, but no stiff'),
        ('structures: {1: {role: tissue, stiffness: 0}}', r'1\.stiffness must be finite, > 0'),
        ('structures: {1: {role: tissue}}', 'structures has no obstacle'),
        ('structures: {0: {role: tissue}}', 'a label is a number from 1 to 65535 or a name'),
        ('structures: {-3: {role: tissue}}', 'a label is a number from 1 to 65535 or a name'),
        ('structures: {70000: {role: tissue}}', 'a label is a number from 1 to 65535 or a name'),
        ('structures: {1.5: {role: tissue}}', 'a label is a number from 1 to 65535 or a name'),
        ('structures: {yes: {role: tissue}}', 'got True; write a name in quotes'),
        ('structures: {[1]: {role: tissue}}', 'is not YAML|a label is a number'),
        ('structures: {1: {role: obstacle, margin: 0, name: a}, a: {role: tissue}}',
         'structures: 2 of them have the name a'),
        ('{structures: {others: {role: obstacle, margin: 0}}, others: {role: tissue}}',
         'structures: 2 of them have the name others'),
        ('{structures: {1: {role: obstacle, margin: 0}}, space: LAI}', 'RAS, LPS, LAS, got'),
        ('{structures: {1: {role: obstacle, margin: 0}}, spacing: 0}', 'spacing must be finite'),
        ('{structures: {1: {role: obstacle, margin: 0}}, others: tissue}', 'others must have a'),
    ],
)  # fmt: skip
def test_invalid_labels_are_rejected_in_one_line(text: str, reason: str, tmp_path: Path) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ParameterError, match=reason) as error:
        read_labels(path)
    assert str(error.value).startswith(str(path))
    assert '\n' not in str(error.value)


@pytest.mark.parametrize('content', [None, b'\xff\xfe'])
def test_unreadable_labels_are_rejected(content: bytes | None, tmp_path: Path) -> None:
    path = tmp_path / 'labels.yaml'
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ParameterError, match=r'No such file|is not text'):
        read_labels(path)


def test_names_cannot_control_a_terminal(tmp_path: Path) -> None:
    text = '{structures: {"a\\e[2J": {role: obstacle, margin: 1mm}}}'
    assert read_labels(written(tmp_path, text)).structures[1].name == 'a?[2J'


def test_long_labels_are_rejected_before_they_are_read(tmp_path: Path) -> None:
    path = tmp_path / 'labels.yaml'
    with path.open('wb') as stream:
        stream.truncate(2**33)
    with pytest.raises(ParameterError, match='has more than 1048576 characters'):
        read_labels(path)


#: Scalars of YAML, with those that labels may have.
SCALARS = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
    | st.sampled_from(['obstacle', 'tissue', '2mm', '1e-3', 'RAS', 3, 0.3])
)  # fmt: skip
ENTRIES = st.dictionaries(
    st.sampled_from(['role', 'name', 'margin', 'stiffness', 'spread', 'source']) | SCALARS,
    SCALARS | st.lists(SCALARS, max_size=2),
    max_size=4,
)


@settings(max_examples=300)
@given(
    st.dictionaries(
        st.sampled_from(['structures', 'others', 'space', 'spacing']) | SCALARS,
        SCALARS | ENTRIES | st.dictionaries(SCALARS, SCALARS | ENTRIES, max_size=3),
        max_size=4,
    ),
    ENTRIES,
)
def test_labels_are_read_or_rejected(document: dict[Any, Any], entry: dict[Any, Any]) -> None:
    """Documents of any content, and of valid content with one random structure."""
    for one in (document, {'structures': {1: ROLES[1], 'a': entry}}):
        with TemporaryDirectory() as folder:
            path = Path(folder, 'labels.yaml')
            path.write_text(yaml.safe_dump(one), 'utf-8')
            try:
                labels = read_labels(path)
            except ParameterError as error:
                line = str(error)
            else:
                assert set(labels.numbers.values()) <= set(labels.structures)
                line = ', '.join(found.name for found in labels.structures.values())
        assert line.isprintable()


@pytest.mark.parametrize(
    ('structures', 'others', 'reason'),
    [
        ({1: ROLES[1]}, {}, 'labels without a role: a:2; add them to structures'),
        ({1: ROLES[1], 2: ROLES[2], 3: ROLES[2]}, {},
         r'structures: 3 is in no segmentation; there are a:1, a:2'),
        ({1: ROLES[1], '2': ROLES[2]}, {}, 'without a role: a:2; .*write 2 without quotes'),
        ({1: ROLES[1], '2': ROLES[2]}, {'others': ROLES[2]}, 'write 2 without quotes'),
        ({1: ROLES[1], 2: ROLES[2], 'liver': ROLES[2]}, {}, 'liver is in no segmentation'),
        ({1: ROLES[1], 'a:1': ROLES[2]}, {}, "label 1 has two roles in structures, as 1 and as"),
    ],
)  # fmt: skip
def test_labels_that_do_not_fit_the_file_are_rejected(
    structures: dict[Any, Any], others: dict[str, Any], reason: str, tmp_path: Path
) -> None:
    path = write_nifti(tmp_path / 'a.nii', blocks(2), AFFINE)
    with pytest.raises(ParameterError, match=reason):
        read_anatomy(path, write_labels(tmp_path / 'labels.yaml', structures, **others))


def test_labels_without_a_role_have_that_of_others(tmp_path: Path) -> None:
    path = write_nifti(tmp_path / 'a.nii', blocks(30), AFFINE)
    labels = write_labels(tmp_path / 'labels.yaml', {'a:4': ROLES[1]}, others={'role': 'tissue'})
    (anatomy,) = read_anatomy(path, labels)
    assert [one.name for one in anatomy.structures.values()] == ['a:4', 'others']
    assert [int(np.sum(anatomy.labels == number)) for number in anatomy.structures] == [4, 4 * 29]


def test_many_labels_without_a_role_are_listed_in_part(tmp_path: Path) -> None:
    path = write_nifti(tmp_path / 'a.nii', blocks(30), AFFINE)
    labels = write_labels(tmp_path / 'labels.yaml', {'a:4': ROLES[1]})
    with pytest.raises(ParameterError, match='a:18 and 19 others; add them'):
        read_anatomy(path, labels)


def test_file_with_one_label_has_the_name_of_the_file(tmp_path: Path) -> None:
    """As in folders with a mask for each structure; masks on the same grid are one anatomy."""
    vessel, liver = np.zeros((2, 6, 6, 6), np.uint8)
    vessel[2] = 1
    liver[1:4] = 1
    paths = [
        write_nifti(tmp_path / 'liver.nii.gz', liver, AFFINE),
        # The same grid with other axes, by another library.
        write_nrrd(tmp_path / 'vessel.nrrd', vessel[::-1].T, LPS @ AFFINE @ np.array(
            [[0, 0, -1, 5], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])),
    ]  # fmt: skip
    labels = write_labels(tmp_path / 'labels.yaml', {'liver': ROLES[2], 'vessel': ROLES[1]})
    for order in (paths, paths[::-1]):
        (anatomy,) = read_anatomy(order, labels)
        assert set(positions_of(anatomy, 'vessel')[:, 0]) == {0.004}
        assert set(positions_of(anatomy, 'liver')[:, 0]) == {0.002, 0.006}
    with pytest.raises(ParameterError, match='structures: 1 is in 2 layers or files: use a name'):
        read_anatomy(paths, write_labels(labels, {1: ROLES[1]}))


def test_files_on_other_grids_are_anatomies_of_their_own(tmp_path: Path) -> None:
    """Nothing is resampled."""
    shifted = AFFINE.copy()
    shifted[0, 3] = 0.01
    paths = [
        write_nifti(tmp_path / 'bone.nii', blocks(1), AFFINE),
        write_nifti(tmp_path / 'skin.nii', blocks(1), shifted),
        write_nifti(tmp_path / 'vessel.nii', np.ones((1, 1, 1), np.uint8), AFFINE),
    ]
    labels = write_labels(
        tmp_path / 'labels.yaml', {'bone': ROLES[1], 'vessel': ROLES[1], 'skin': {'role': 'entry'}}
    )
    anatomies = read_anatomy(paths, labels)
    assert [[one.name for one in a.structures.values()] for a in anatomies] == [
        ['bone'], ['skin'], ['vessel']
    ]  # fmt: skip
    assert positions_of(anatomies[1], 'skin')[0, 0] == pytest.approx(2.01e-3)


@pytest.mark.parametrize('role', ['target', 'entry'])
def test_region_inside_of_an_obstacle_is_rejected(role: str, tmp_path: Path) -> None:
    inner, outer = np.zeros((2, 4, 4, 4), np.uint8)
    inner[1:3, 1:3, 1:3] = outer[:, 1:3, 1:3] = 1
    paths = [
        write_nifti(tmp_path / 'inner.nii', inner, AFFINE),
        write_nifti(tmp_path / 'outer.nii', outer, AFFINE),
    ]
    labels = write_labels(tmp_path / 'labels.yaml', {'inner': {'role': role}, 'outer': ROLES[1]})
    with pytest.raises(ParameterError, match=f'{role} inner is inside of other structures'):
        read_anatomy(paths, labels)


def test_no_file_is_rejected(tmp_path: Path) -> None:
    labels = write_labels(tmp_path / 'labels.yaml', ROLES)
    with pytest.raises(ParameterError, match='at least one segmentation'):
        read_anatomy([], labels)


def test_number_of_voxels_of_all_grids_is_limited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Grids of 12 voxels each, with a smaller limit."""
    paths = [
        write_nifti(tmp_path / f'{k}.nii', blocks(1), AFFINE + 1e-2 * k * np.eye(4, k=3))
        for k in range(3)
    ]
    labels = write_labels(tmp_path / 'labels.yaml', {'0': ROLES[1]}, others={'role': 'tissue'})
    assert len(read_anatomy(paths, labels)) == 3
    monkeypatch.setattr('needle_planning.labels.MOST_VOXELS', 17)
    assert len(read_anatomy(paths[:2], labels)) == 2
    with pytest.raises(SegmentationError, match='the grids have more than 34 voxels'):
        read_anatomy(paths, labels)
