# SPDX-License-Identifier: Apache-2.0
"""Segmentations in NRRD and NIfTI, compared with the positions by nibabel and pynrrd."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import permutations, product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_planning import Anatomy, read_anatomy, SegmentationError
import nibabel
import nrrd
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.segmentations import (
    assert_same_positions,
    LPS,
    positions,
    positions_of,
    ROLES,
    write_labels,
    write_nifti,
    write_nrrd,
)  # fmt: skip

#: An image without symmetry: every orientation of it is another one.
IMAGE = np.zeros((4, 5, 6), np.int16)
IMAGE[0, 1, 2] = IMAGE[3, 1, 2] = IMAGE[0, 4, 1] = IMAGE[2, 2, 5] = 1
IMAGE[1:3, 2:5, 0:2] = 2
#: From its voxels to RAS [mm].
AFFINE = np.array([[1.5, 0, 0, -40], [0, 2.0, 0, 7], [0, 0, 3.0, 90], [0, 0, 0, 1.0]])

#: All permutations and reversals of three axes.
ORIENTATIONS = [
    (order, flips) for order in permutations(range(3)) for flips in product((1, -1), repeat=3)
]


def oriented(
    order: tuple[int, ...], flips: tuple[int, ...], affine: np.ndarray = AFFINE
) -> tuple[np.ndarray, np.ndarray]:
    """Return the same image with other axes, and its affine."""
    new = nibabel.orientations.inv_ornt_aff(
        np.column_stack([np.argsort(order), np.array(flips)[np.argsort(order)]]), IMAGE.shape
    )
    values = nibabel.orientations.apply_orientation(
        IMAGE, np.column_stack([np.argsort(order), np.array(flips)[np.argsort(order)]])
    )
    return values, affine @ new


def read(path: Path, labels: Mapping[Any, Any] | None = None) -> Anatomy:
    (anatomy,) = read_anatomy(path, write_labels(path.parent / 'labels.yaml', labels or ROLES))
    return anatomy


def test_positions_are_in_meters_to_the_right_front_and_top(tmp_path: Path) -> None:
    """A voxel 10 mm to the left, 20 mm to the back and 30 mm down, in LPS and in RAS."""
    values = np.zeros((3, 3, 3), np.uint8)
    values[0, 0, 0] = 1
    for path in (
        write_nifti(tmp_path / 'a.nii', values, np.array(
            [[1, 0, 0, -10], [0, 1, 0, -20], [0, 0, 1, -30], [0, 0, 0, 1.0]])),
        write_nrrd(tmp_path / 'a.nrrd', values, np.array(
            [[1, 0, 0, 10], [0, 1, 0, 20], [0, 0, 1, -30], [0, 0, 0, 1.0]])),
    ):  # fmt: skip
        anatomy = read(path, {'a': ROLES[1]})
        assert positions_of(anatomy, 'a') == pytest.approx(np.array([[-0.01, -0.02, -0.03]]))


@pytest.mark.parametrize(('order', 'flips'), ORIENTATIONS)
def test_all_orientations_are_the_same_anatomy(
    order: tuple[int, ...], flips: tuple[int, ...], tmp_path: Path
) -> None:
    """Labels are equal voxel by voxel, since the axes are turned to those of the patient."""
    expected = read(write_nifti(tmp_path / 'a.nii', IMAGE, AFFINE))
    values, affine = oriented(order, flips)
    for path in (
        write_nifti(tmp_path / 'b.nii.gz', values, affine),
        write_nrrd(tmp_path / 'b.nrrd', values, LPS @ affine),
    ):
        anatomy = read(path)
        np.testing.assert_array_equal(anatomy.labels, expected.labels)
        # Single precision of NIfTI, 10 nm at 0.1 m.
        np.testing.assert_allclose(anatomy.to_patient, expected.to_patient, atol=1e-8)
        assert [one.role for one in anatomy.structures.values()] == ['obstacle', 'tissue']


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    shape=st.tuples(*[st.integers(1, 6)] * 3),
    spacing=st.tuples(*[st.floats(0.2, 5.0)] * 3),
    orientation=st.sampled_from(ORIENTATIONS),
    kind=st.sampled_from(['u1', 'i2', 'u2', 'i4', 'f4', 'f8']),
)
def test_positions_are_those_of_nibabel_and_pynrrd(
    seed: int,
    shape: tuple[int, ...],
    spacing: tuple[float, ...],
    orientation: tuple[tuple[int, ...], tuple[int, ...]],
    kind: str,
) -> None:
    """Any rotation, spacing, size and type: the same set of positions for every label."""
    random = np.random.default_rng(seed)
    values = random.integers(0, 3, shape).astype(kind)
    values.flat[0] = 1
    order, flips = orientation
    affine = np.eye(4)
    turn = Rotation.random(random_state=seed % 1000).as_matrix()
    affine[:3, :3] = (turn * spacing)[:, order] * flips
    affine[:3, 3] = random.uniform(-200.0, 200.0, 3)
    labels = {number: one for number, one in ROLES.items() if np.any(values == number)}
    with TemporaryDirectory() as folder:
        nifti = write_nifti(Path(folder, 'a.nii.gz'), values, affine)
        other = write_nrrd(Path(folder, 'a.nrrd'), values, LPS @ affine)
        anatomies = [read(path, labels) for path in (nifti, other)]
        image = nibabel.load(nifti)
        data_of_nibabel = image.get_fdata()
        stored, header = nrrd.read(str(other))
    of_lps = np.eye(4)
    of_lps[:3, :3], of_lps[:3, 3] = header['space directions'].T, header['space origin']
    for number in labels:
        role = ROLES[number]['role']
        for data, matrix in ((data_of_nibabel, image.affine), (stored, LPS @ of_lps)):
            expected = 1e-3 * positions(data == number, matrix)
            for anatomy in anatomies:
                (name,) = (s.name for s in anatomy.structures.values() if s.role == role)
                assert_same_positions(positions_of(anatomy, name), expected)


def test_segments_of_slicer_are_read_by_name(tmp_path: Path) -> None:
    """Two layers that overlap: an obstacle covers tissue, a target too."""
    layers = np.zeros((2, 4, 4, 4), np.uint8)
    layers[0, :3] = 1
    layers[1, 0] = 1
    layers[1, 1] = 2
    fields: dict[str, str] = {}
    for number, (name, layer, value) in enumerate(
        [('Leber', 0, 1), ('Gef__', 1, 1), ('Tumor', 1, 2), ('empty', 1, 3)]
    ):
        given = {'Name': name, 'Layer': layer, 'LabelValue': value}
        fields |= {f'Segment{number}_{key}': str(one) for key, one in given.items()}
    path = write_nrrd(tmp_path / 'a.seg.nrrd', layers, np.eye(4), **fields)
    # pynrrd writes ASCII.
    path.write_bytes(path.read_bytes().replace(b'Gef__', 'Gefäß'.encode()))
    anatomy = read(path, {
        'Leber': {'role': 'tissue'}, 'Tumor': {'role': 'target'},
        'Gefäß': {'role': 'obstacle', 'margin': 0.001},
    })  # fmt: skip
    sizes = {one.name: np.sum(anatomy.labels == n) for n, one in anatomy.structures.items()}
    assert sizes == {'Gefäß': 16, 'Tumor': 16, 'Leber': 16}
    assert positions_of(anatomy, 'Gefäß')[:, 0] == pytest.approx(np.zeros(16))
    assert positions_of(anatomy, 'Tumor')[:, 0] == pytest.approx(np.full(16, -1e-3))


def test_old_segments_of_slicer_are_layers(tmp_path: Path) -> None:
    """Without the fields Layer and LabelValue each segment is a layer."""
    layers = np.zeros((2, 2, 2, 2), np.uint8)
    layers[0, 0], layers[1, 1] = 1, 1
    fields = {'Segment0_Name': 'a', 'Segment1_Name': 'b'}
    path = write_nrrd(tmp_path / 'a.seg.nrrd', layers, np.eye(4), **fields)
    anatomy = read(path, {'a': ROLES[1], 'b': ROLES[2]})
    assert positions_of(anatomy, 'b')[:, 0] == pytest.approx(np.full(4, -1e-3))


def test_segments_of_one_image_need_no_layer(tmp_path: Path) -> None:
    """Segments are told apart by their values alone; a name may have any characters."""
    fields = {'Segment0_Name': 'a: = b', 'Segment0_LabelValue': '2', 'Segment1_Name': 'c\x0bd'}
    anatomy = read(
        write_nrrd(tmp_path / 'a.seg.nrrd', IMAGE, LPS @ AFFINE, **fields),
        {'a: = b': ROLES[2], 'c\x0bd': ROLES[1]},
    )
    sizes = [int(np.sum(anatomy.labels == number)) for number in (1, 2)]
    assert sizes == [int(np.sum(number == IMAGE)) for number in (1, 2)]


@pytest.mark.parametrize('encoding', ['raw', 'gzip', 'bzip2', 'ascii'])
@pytest.mark.parametrize('detached', [False, True])
def test_encodings_of_nrrd_are_the_same(encoding: str, detached: bool, tmp_path: Path) -> None:
    name = 'a.nhdr' if detached else 'a.nrrd'
    path = write_nrrd(tmp_path / name, IMAGE, LPS @ AFFINE, encoding=encoding)
    expected = read(write_nifti(tmp_path / 'b.nii', IMAGE, AFFINE))
    np.testing.assert_array_equal(read(path).labels, expected.labels)


@pytest.mark.parametrize('size', [1, 7, 2**20])
def test_numbers_of_a_text_do_not_depend_on_its_parts(
    size: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A number may continue in the next part."""
    values = IMAGE * np.uint16(1234)
    path = write_nrrd(tmp_path / 'a.nrrd', values, LPS @ AFFINE, encoding='ascii')
    monkeypatch.setattr('needle_planning.segmentation._PART', size)
    labels = {1234: ROLES[1], 2468: ROLES[2]}
    expected = read(write_nifti(tmp_path / 'b.nii', values, AFFINE), labels)
    np.testing.assert_array_equal(read(path, labels).labels, expected.labels)
    # Without the optional byte order, which a text does not have.
    path.write_bytes(path.read_bytes().replace(b'endian: little\n', b''))
    np.testing.assert_array_equal(read(path, labels).labels, expected.labels)


@pytest.mark.parametrize(
    ('fields', 'scale'),
    [
        ({'space units': ['', '', '']}, 1.0),
        ({'space units': ['millimeter'] * 3}, 1.0),
        ({'space units': ['cm'] * 3}, 0.1),
        ({'space': 'left-anterior-superior'}, 1.0),
        ({'space': 'LAS'}, 1.0),
    ],
)
def test_spaces_and_units_of_nrrd(fields: dict[str, Any], scale: float, tmp_path: Path) -> None:
    matrix = (np.diag([-1.0, 1.0, 1.0, 1.0]) if 'space' in fields else LPS) @ AFFINE
    matrix[:3] *= scale
    expected = read(write_nifti(tmp_path / 'b.nii', IMAGE, AFFINE))
    found = read(write_nrrd(tmp_path / 'a.nrrd', IMAGE, matrix, **fields))
    np.testing.assert_allclose(found.to_patient, expected.to_patient, atol=1e-8)
    np.testing.assert_array_equal(found.labels, expected.labels)


def test_last_axis_of_one_component_is_left_out(tmp_path: Path) -> None:
    """With the direction none, as of images with a vector in each voxel."""
    directions = np.vstack([(LPS @ AFFINE)[:3, :3].T, np.full(3, np.nan)])
    path = write_nrrd(
        tmp_path / 'a.nrrd', IMAGE[..., None], LPS @ AFFINE, **{'space directions': directions}
    )
    expected = read(write_nifti(tmp_path / 'b.nii', IMAGE, AFFINE))
    np.testing.assert_array_equal(read(path).labels, expected.labels)


@pytest.mark.parametrize(('name', 'other'), [('a.nii', 'b.nii.gz'), ('a.nii.gz', 'b.nii')])
def test_name_of_nifti_does_not_state_its_compression(
    name: str, other: str, tmp_path: Path
) -> None:
    path = write_nifti(tmp_path / name, IMAGE, AFFINE)
    expected = read(path)
    np.testing.assert_array_equal(read(path.rename(tmp_path / other)).labels, expected.labels)


@pytest.mark.parametrize('count', [1, 16, 512])
def test_zeros_after_the_voxels_of_nifti_are_left_out(count: int, tmp_path: Path) -> None:
    path = write_nifti(tmp_path / 'a.nii', IMAGE, AFFINE)
    expected = read(path)
    path.write_bytes(path.read_bytes() + bytes(count))
    np.testing.assert_array_equal(read(path).labels, expected.labels)


@pytest.mark.parametrize('skip', [0, 7, -1])
def test_skipped_bytes_of_nrrd_are_left_out(skip: int, tmp_path: Path) -> None:
    path = write_nrrd(tmp_path / 'a.nhdr', IMAGE, LPS @ AFFINE, encoding='raw')
    expected = read(path).labels
    (data,) = tmp_path.glob('*.raw')
    data.write_bytes(b'x' * abs(7 if skip else 0) + data.read_bytes())
    path.write_text(path.read_text().replace('encoding', f'byte skip: {skip}\nencoding'))
    np.testing.assert_array_equal(read(path).labels, expected)


@pytest.mark.parametrize(('space', 'matrix'), [('RAS', AFFINE), ('LPS', LPS @ AFFINE),
                                               ('right-anterior-superior', AFFINE)])  # fmt: skip
def test_space_of_nrrd_is_converted(space: str, matrix: np.ndarray, tmp_path: Path) -> None:
    expected = read(write_nifti(tmp_path / 'b.nii', IMAGE, AFFINE))
    anatomy = read(write_nrrd(tmp_path / 'a.nrrd', IMAGE, matrix, space=space))
    np.testing.assert_allclose(anatomy.to_patient, expected.to_patient, atol=1e-8)


@pytest.mark.parametrize('space', ['RAS', 'LPS'])
def test_space_that_a_file_does_not_state_is_in_the_labels(space: str, tmp_path: Path) -> None:
    fields = {'space': None, 'space dimension': 3}
    path = write_nrrd(tmp_path / 'a.nrrd', IMAGE, AFFINE, **fields)
    labels = tmp_path / 'labels.yaml'
    with pytest.raises(SegmentationError, match='add space: LPS or space: RAS to the labels'):
        read_anatomy(path, write_labels(labels, ROLES))
    (anatomy,) = read_anatomy(path, write_labels(labels, ROLES, space=space))
    (other,) = read_anatomy(write_nrrd(path, IMAGE, AFFINE, space=space), labels)
    np.testing.assert_array_equal(anatomy.to_patient, other.to_patient)


def test_sform_and_qform_of_nifti_are_the_same_or_one_of_them(tmp_path: Path) -> None:
    """A file with two is read if they are alike to 0.1 mm; other programs use the other one."""
    turned = AFFINE.copy()
    # The farthest corner is moved by an angle times its distance from the axis, 3 mm and 8 mm.
    turned[:3, :3] = Rotation.from_euler('x', 0.05).as_matrix() @ AFFINE[:3, :3]
    shifted = AFFINE + 5.0 * np.eye(4, k=3)
    image = nibabel.Nifti1Image(IMAGE, AFFINE)
    found = {}
    for sform, qform in ((0, 1), (1, 0)):
        image.set_sform(AFFINE, sform)
        image.set_qform(shifted, qform)
        nibabel.save(image, tmp_path / 'a.nii')
        found[sform, qform] = 1e3 * read(tmp_path / 'a.nii').to_patient[0, 3]
    assert found == pytest.approx({(0, 1): -35.0, (1, 0): -40.0})
    for other, apart in ((shifted, 5.0), (turned, 0.05 * np.hypot(4 * 2.0, 5 * 3.0))):
        image.set_sform(AFFINE, 1)
        image.set_qform(other, 1)
        nibabel.save(image, tmp_path / 'a.nii')
        with pytest.raises(SegmentationError, match='set to 0') as error:
            read(tmp_path / 'a.nii')
        stated = float(str(error.value).partition(' are up to ')[2].partition(' mm')[0])
        # Chord for arc: a part of 0.05**2 / 24 = 1e-4. The message has four digits.
        assert stated == pytest.approx(apart, rel=2e-4, abs=5e-4)
    image.set_qform(AFFINE + 0.05 * np.eye(4, k=3), 1)
    nibabel.save(image, tmp_path / 'a.nii')
    assert 1e3 * read(tmp_path / 'a.nii').to_patient[0, 3] == pytest.approx(-40.0)
    with pytest.raises(SegmentationError, match='has neither sform nor qform'):
        read(write_nifti(tmp_path / 'b.nii', IMAGE, AFFINE, sform=0, qform=0))


@pytest.mark.parametrize(('unit', 'length'), [('mm', 1e-3), ('meter', 1.0), ('micron', 1e-6),
                                              (None, 1e-3)])  # fmt: skip
def test_unit_of_nifti_is_converted(unit: str | None, length: float, tmp_path: Path) -> None:
    image = nibabel.Nifti1Image(IMAGE, AFFINE)
    affine = AFFINE.copy()
    affine[:3] *= 1e-3 / length
    image.set_sform(affine, 1)
    image.header.set_xyzt_units(unit)
    nibabel.save(image, tmp_path / 'a.nii')
    expected = 1e-3 * AFFINE
    # Single precision of NIfTI.
    np.testing.assert_allclose(read(tmp_path / 'a.nii').to_patient[:3], expected[:3], rtol=1e-6)


@pytest.mark.parametrize('big', [False, True])
def test_byte_order_and_version_do_not_matter(big: bool, tmp_path: Path) -> None:
    header = nibabel.Nifti1Header(endianness='>' if big else '<')
    for kind in (nibabel.Nifti1Image, nibabel.Nifti2Image):
        image = kind(IMAGE, AFFINE, kind.header_class.from_header(header))
        image.header.set_data_dtype('>i2' if big else '<i2')
        nibabel.save(image, tmp_path / 'a.nii')
        anatomy = read(tmp_path / 'a.nii')
        assert np.sum(anatomy.labels == 1) == np.sum(IMAGE == 1)


def test_scaled_values_are_those_of_nibabel(tmp_path: Path) -> None:
    """Values that are stored as 0, 1, 2 and scaled by 3, plus 1."""
    path = write_nifti(tmp_path / 'a.nii', IMAGE, AFFINE)
    content = bytearray(path.read_bytes())
    content[112:120] = np.array([3.0, 1.0], '<f4').tobytes()
    path.write_bytes(content)
    assert set(np.unique(nibabel.load(path).get_fdata())) == {1.0, 4.0, 7.0}
    anatomy = read(path, {1: ROLES[2], 4: ROLES[1], 7: ROLES[2]})
    assert len(anatomy.structures) == 3
    assert np.sum(anatomy.labels == 1) == np.sum(IMAGE == 1)


@pytest.mark.parametrize(
    ('labels', 'matrix', 'reason'),
    [
        (np.zeros((2, 2), int), np.eye(4), r'shape \(i, j, k\), got int64 of shape \(2, 2\)'),
        (np.zeros((2, 0, 2), int), np.eye(4), r'got int64 of shape \(2, 0, 2\)'),
        (np.zeros((2, 2, 2)), np.eye(4), 'must be whole numbers'),
        (np.zeros((2, 2, 2), int), np.eye(3), '4 x 4 finite numbers'),
        (np.zeros((2, 2, 2), int), np.eye(4) + np.eye(4, k=-3), 'is singular'),
        (np.zeros((2, 2, 2), int), np.diag([1.0, 0.0, 1.0, 1.0]), 'is singular'),
        (np.zeros((2, 2, 2), int), np.diag([1e200, 1.0, 1.0, 1.0]), 'are not of a patient'),
        (
            np.zeros((2, 2, 2), int),
            np.diag([0.1, 0.1, 0.1, 1.0]) + np.diag([1e-4, 0.0, 0.0], k=1),
            'at most 0.0001 is accept',
        ),
    ],
)
def test_invalid_anatomy_is_rejected(labels: np.ndarray, matrix: np.ndarray, reason: str) -> None:
    with pytest.raises(SegmentationError, match=reason):
        Anatomy(labels=labels, to_patient=matrix, structures={})


@pytest.mark.parametrize('dtype', [np.int16, np.uint16])
def test_scaled_values_are_rounded_to_whole_numbers(dtype: type, tmp_path: Path) -> None:
    """Nibabel scales floats that are saved as integers: 1 is read as 1.00001, for example."""
    image = nibabel.Nifti1Image(IMAGE.astype(np.float64), AFFINE)
    image.set_data_dtype(dtype)
    nibabel.save(image, tmp_path / 'a.nii.gz')
    back = np.asanyarray(nibabel.load(tmp_path / 'a.nii.gz').dataobj)
    assert not np.array_equal(back, IMAGE)
    # Obstacle and tissue have the numbers 1 and 2.
    found = read(tmp_path / 'a.nii.gz')
    whole = nibabel.Nifti1Image(IMAGE, AFFINE)
    nibabel.save(whole, tmp_path / 'b.nii.gz')
    np.testing.assert_array_equal(found.labels, read(tmp_path / 'b.nii.gz').labels)
