# SPDX-License-Identifier: Apache-2.0
"""Label maps as OpenIGTLink IMAGE messages: written by pyigtl, and damaged ones."""

from __future__ import annotations

from itertools import product
import struct
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_insertion.slicer.image import LARGEST_IMAGE
from needle_insertion.slicer.link import Frame, Frames, HEADER, LARGEST
from needle_insertion.slicer.messages import (
    largest_of_plans,
    largest_target,
    read_segmentation,
    SEGMENTATION,
)
from needle_planning.anatomy import SegmentationError
from needle_planning.voxels import MOST_VOXELS, turned
import numpy as np
import pyigtl
from pyigtl.messages import CRC64
import pytest
from scipy.spatial.transform import Rotation
from support.slicer_anatomy import image_message

#: Fields of the header of an image, and the values of a label map of 2 x 3 x 4 voxels.
IMAGE = struct.Struct('>HBBBB3H12f6H')
SHAPE = 2, 3, 4
VALID = [1, 1, 3, 2, 1, *SHAPE, *np.eye(3).ravel(), 0.0, 0.0, 0.0, 0, 0, 0, *SHAPE]
VOXELS = bytes(range(24))


def packed(content: bytes, version: int = 1, device: str = SEGMENTATION) -> Frame:
    """Return an IMAGE message with a checksum."""
    header = HEADER.pack(version, b'IMAGE', device.encode(), 0, 0, len(content), CRC64(content))
    return Frame('IMAGE', device, header + content)


def changed(**fields: Any) -> bytes:
    """Return the content of a message with other fields, by their index."""
    values = list(VALID)
    for name, value in fields.items():
        values[int(name.removeprefix('at'))] = value
    return IMAGE.pack(*values) + VOXELS


@st.composite
def images(draw: Any) -> tuple[Any, Any, int, bool]:
    """Draw values, the matrix to the patient [mm], the version of the header, and LPS."""
    seed = draw(st.integers(0, 2**32 - 1))
    kind = draw(st.sampled_from(['i1', 'u1', '<i2', '<u2', '<i4', '<u4']))
    rng = np.random.default_rng(seed)
    shape = tuple(draw(st.tuples(*[st.integers(1, 7)] * 3)))
    values = rng.integers(0, 4, shape).astype(kind)
    values[0, 0, 0] = 100
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(random_state=seed).as_matrix() * rng.uniform(0.5, 4.0, 3)
    matrix[:3, 3] = rng.uniform(-200.0, 200.0, 3)
    return values, matrix, draw(st.sampled_from([1, 2])), draw(st.booleans())


@given(images())
def test_label_map_of_pyigtl_has_its_values_and_positions(
    image: tuple[Any, Any, int, bool],
) -> None:
    """Each voxel at its position, for all types, orientations and headers."""
    values, matrix, version, lps = image
    layer = read_segmentation(
        Frame('IMAGE', SEGMENTATION, image_message(values, matrix, version=version, lps=lps))
    )
    # The message has 24 bits: 6e-8 of coordinates below 0.3 m, in sums of four.
    signs = [-1e-3, -1e-3, 1e-3, 1.0] if lps else [1e-3, 1e-3, 1e-3, 1.0]
    expected = np.diag(signs) @ matrix
    again, to_patient = turned(values, expected)
    np.testing.assert_array_equal(layer.values, again)
    np.testing.assert_allclose(layer.to_patient, to_patient, atol=1e-7)
    present = set(np.unique(values).tolist()) - {0}
    single = len(present) == 1
    assert layer.names == {
        one: SEGMENTATION if single else f'{SEGMENTATION}:{one}' for one in present
    }


@pytest.mark.parametrize('kind', ['i2', 'u2', 'i4', 'u4'])
def test_byte_order_of_the_header_is_used(kind: str) -> None:
    """Pyigtl writes little-endian voxels only; the header is always big-endian."""
    number = {'i2': 4, 'u2': 5, 'i4': 6, 'u4': 7}[kind]
    values = np.arange(24).reshape(SHAPE, order='F')
    for order, code in ((1, '>'), (2, '<')):
        head = IMAGE.pack(1, 1, number, order, *VALID[4:])
        layer = read_segmentation(packed(head + values.astype(code + kind).tobytes(order='F')))
        np.testing.assert_array_equal(layer.values, values)


def read_or_reason(content: bytes, version: int = 1) -> Any:
    """Return the layer of a message, or the line of its rejection."""
    try:
        return read_segmentation(packed(content, version))
    except SegmentationError as error:
        return str(error)


def is_line(reason: Any) -> bool:
    return str(reason).startswith('SEGMENTATION: ') and len(str(reason).splitlines()) == 1


@settings(max_examples=300)
@given(st.binary(max_size=200), st.sampled_from([1, 2, 3]))
@pytest.mark.requirement('S-315')
def test_any_content_is_read_or_rejected(content: bytes, version: int) -> None:
    """Also with a valid beginning: one line with the name, and no other error."""
    for body in (content, IMAGE.pack(*VALID) + content):
        found = read_or_reason(body, version)
        assert is_line(found) or found.values.size == 24


@given(st.integers(0, len(VALID) - 1), st.integers(0, 255) | st.floats(width=32))
def test_any_field_of_the_header_is_read_or_rejected(field: int, value: float) -> None:
    """A changed number of voxels, type, orientation or part is no other image."""
    number = value if 8 <= field < 20 else int(value) if 0.0 <= value < 256.0 else 7
    found = read_or_reason(changed(**{f'at{field}': number}))
    assert is_line(found) or (found.values.shape == SHAPE and np.isfinite(found.to_patient).all())


@pytest.mark.parametrize(
    ('body', 'reason'),
    [
        (changed(at0=2), 'has the version 2, a label map has 1'),
        (changed(at1=3), 'has the number of components 3, a label map has 1'),
        (changed(at2=10), 'has voxels of the scalar type 10, a label map has int8, uint8'),
        (changed(at2=99), 'has voxels of the scalar type 99'),
        (changed(at3=0), 'has the byte order 0, a label map has 1 or 2'),
        (changed(at4=7), 'has the coordinates 7, a label map has 1 or 2'),
        (changed(at5=0), 'has 0 x 3 x 4 voxels'),
        (changed(at5=2048, at6=2048, at7=2048), f'at most {MOST_VOXELS} are read'),
        (changed(at8=float('nan')), 'the orientation must be 4 x 4 finite numbers'),
        (changed(at8=0.0), 'the orientation is singular'),
        (changed(at9=1.0), 'axes of the voxels have a cosine of'),
        (changed(at20=1), 'is a part of an image: send the whole image'),
        (changed(at23=1), 'is a part of an image: send the whole image'),
        (changed()[:-1], 'is truncated: it has 23 of 24 bytes'),
        (changed() + b'1', 'has more than the 24 bytes of its voxels'),
        (changed()[:70], 'is truncated: it has 70 of the 72 bytes of its header'),
        (changed(at2=2)[:-1] + b'\xff', 'has the value -1: a segmentation has whole numbers'),
        (IMAGE.pack(*VALID) + bytes(24), 'has no labeled voxel'),
    ],
)
def test_invalid_label_map_is_one_line(body: bytes, reason: str) -> None:
    with pytest.raises(SegmentationError) as caught:
        read_segmentation(packed(body))
    assert str(caught.value).startswith('SEGMENTATION: ')
    assert reason in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    'extended',
    [b'', bytes(11), struct.pack('>HHII', 12, 0, 1000, 0), struct.pack('>HHII', 500, 0, 0, 0)],
)
def test_invalid_extended_header_is_one_line(extended: bytes) -> None:
    with pytest.raises(SegmentationError, match='extended header'):
        read_segmentation(packed(extended + changed() * bool(len(extended) > 11), version=2))


@given(st.integers(0, 8 * (IMAGE.size + len(VOXELS)) - 1))
@pytest.mark.requirement('S-315')
def test_flipped_bit_of_an_image_is_detected(bit: int) -> None:
    """A damaged label map would be another anatomy."""
    data = bytearray(packed(changed()).data)
    data[HEADER.size + bit // 8] ^= 1 << bit % 8
    with pytest.raises(SegmentationError, match='damaged: its checksum is wrong'):
        read_segmentation(Frame('IMAGE', SEGMENTATION, data))


def test_damage_after_the_first_part_of_a_large_image_is_detected() -> None:
    """The checksum is computed in parts of 1 MiB."""
    values = np.ones((128, 128, 128), dtype=np.uint8)
    data = bytearray(image_message(values, np.eye(4)))
    assert read_segmentation(Frame('IMAGE', SEGMENTATION, data)).values.all()
    data[-1] = 2
    with pytest.raises(SegmentationError, match='damaged'):
        read_segmentation(Frame('IMAGE', SEGMENTATION, data))


# Stream.


@given(st.data())
def test_large_images_are_split_independently_of_chunks(data: Any) -> None:
    """Between targets, and with other images, which are skipped."""
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    values = rng.integers(1, 9, (60, 50, 40)).astype(np.uint8)
    image = image_message(values, np.eye(4))
    assert len(image) > LARGEST
    other = pyigtl.ImageMessage(values, device_name='CT').pack()
    text = pyigtl.StringMessage('1 2 3', device_name='TARGET').pack()
    stream = b''.join([text, image, other, image, text])
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    frames, found = Frames(largest_of_plans), []
    for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        found += frames.take(stream[a:b])
    assert [bytes(one.data) for one in found] == [text, image, image, text]
    assert not frames.is_large
    assert not frames.lost()


def test_image_is_accepted_by_name_and_size() -> None:
    """Without labels none is stored; a larger one is rejected by its header."""
    assert largest_target('IMAGE', SEGMENTATION) == largest_of_plans('IMAGE', 'CT') == 0
    for kind, device in product(['POINT', 'STRING', 'TRANSFORM', 'IMAGE'], ['TARGET', 'a']):
        assert largest_of_plans(kind, device) == largest_target(kind, device)
    frames = Frames(largest_of_plans)
    size = LARGEST_IMAGE + 1
    (frame,) = frames.take(HEADER.pack(1, b'IMAGE', b'SEGMENTATION', 0, 0, size, 0))
    assert frame.error == f'a IMAGE message of {size} bytes, {LARGEST_IMAGE} at most'
    with pytest.raises(SegmentationError, match=f'SEGMENTATION: {frame.error}'):
        read_segmentation(frame)
    assert not frames.is_large


@pytest.mark.parametrize('part', [HEADER.size, 0.3, 0.999])
@pytest.mark.parametrize('size', [5, 50])
def test_image_without_its_end_is_refused(part: float, size: int) -> None:
    """Also one that is not larger than a target."""
    image = image_message(np.ones((size, size, size), np.uint8), np.eye(4))
    end = int(part) if part > 1.0 else int(part * len(image))
    frames = Frames(largest_of_plans)
    assert frames.take(image[:end]) == []
    (frame,) = frames.lost()
    reason = f'SEGMENTATION: connection lost, {end} of {len(image)} bytes received'
    with pytest.raises(SegmentationError, match=reason):
        read_segmentation(frame)
