# SPDX-License-Identifier: Apache-2.0
"""Targets and needle as OpenIGTLink messages: round trip, and invalid messages."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from itertools import pairwise
import math
import struct
import subprocess
import sys
from typing import Any

from hypothesis import assume, given
from hypothesis import strategies as st
from needle_insertion.slicer.link import Frame, Frames, HEADER, LARGEST
from needle_insertion.slicer.messages import (
    Interpreter,
    largest_target,
    SHAPE,
    SHAPE_HEADER,
    STATE,
    TARGET,
    TIP,
    TIP_EXPECTED,
)
from needle_insertion.slicer.needle import (
    EntryPose,
    LINE,
    MEASURED,
    MOST_POINTS,
    NeedleView,
    Registration,
    rotation_matrix,
    Shape,
)
from needle_ros.errors import MessageError, ParameterError
import numpy as np
import pyigtl
from pyigtl.messages import CRC64, MessageBase
import pytest

REACH = 0.3

places = st.floats(-0.15, 0.15)
depths = st.floats(0.0, 0.2)
targets = st.tuples(places, depths, places)
vectors = st.tuples(*[st.floats(-0.5, 0.5)] * 3)


@st.composite
def quaternions(draw: Any) -> tuple[float, ...]:
    """Draw x, y, z, w of norm 1."""
    given_ = np.array(draw(st.tuples(*[st.floats(-1.0, 1.0)] * 4)))
    norm = np.linalg.norm(given_)
    assume(norm > 0.1)
    return tuple((given_ / norm).tolist())


registrations = st.builds(Registration, rotation=quaternions(), translation=vectors)


def received(*messages: bytes) -> list[Any]:
    """Parse messages with pyigtl."""
    found = []
    for data in messages:
        fields = MessageBase.parse_header(data[: HEADER.size])
        message = MessageBase.create_message(fields['message_type'])
        message.unpack(fields, data[HEADER.size :])
        assert fields['body_size'] == len(data) - HEADER.size
        assert HEADER.unpack(data[: HEADER.size])[-1] == CRC64(data[HEADER.size :])
        found.append(message)
    return found


def framed(data: bytes) -> Frame:
    """Return the frame of a message."""
    (frame,) = Frames(largest_target).take(data)
    return frame


def point(at: Any) -> Any:
    return pyigtl.PointMessage(np.array([at]), names=['F-1'], device_name=TARGET)


def planned(at: Any) -> Any:
    """Return a point list as sent by SmartNeedle's module: any name, with target and entry."""
    both = np.array([at, [0.0, 0.0, 0.0]])
    return pyigtl.PointMessage(both, names=[TARGET, 'ENTRY'], device_name='PlanningZ')


def transform(at: Any) -> Any:
    matrix = np.eye(4)
    matrix[:3, 3] = at
    return pyigtl.TransformMessage(matrix, device_name=TARGET)


def string(at: Any) -> Any:
    return pyigtl.StringMessage('; '.join(repr(float(one)) for one in at), device_name=TARGET)


def position(at: Any) -> Any:
    """Return a POSITION of the protocol; pyigtl has another format of it."""

    class Position(pyigtl.TransformMessage):
        def _pack_content(self) -> bytes:
            self._message_type = 'POSITION'
            return struct.pack('>7f', *np.array(at, np.float32), 0.0, 0.0, 0.0, 1.0)

    return Position(device_name=TARGET)


KINDS = [point, planned, transform, string, position]


# Frame of the images.


@given(registrations, st.lists(vectors, min_size=1, max_size=5))
def test_registration_is_invertible_and_isometric(
    registration: Registration, points: list[Any]
) -> None:
    """Points return to their positions, and distances are conserved, in mm."""
    there = registration.to_image(points)
    # 1e-12: a hundred times the rounding of coordinates of about 1 m.
    np.testing.assert_allclose(registration.to_needle(there), points, atol=1e-12)
    distances = np.linalg.norm(np.diff(points, axis=0), axis=1)
    seen = np.linalg.norm(np.diff(there, axis=0), axis=1)
    np.testing.assert_allclose(seen, 1e3 * distances, atol=1e-9)


@given(quaternions(), quaternions(), vectors)
def test_rotation_matrices_match_quaternions(first: Any, second: Any, vector: Any) -> None:
    """They are proper, and the product of quaternions is the product of matrices."""
    (a, b, c, d), (x, y, z, w) = first, second
    product = [
        d * x + a * w + b * z - c * y,
        d * y - a * z + b * w + c * x,
        d * z + a * y - b * x + c * w,
        d * w - a * x - b * y - c * z,
    ]
    one, two = rotation_matrix(first), rotation_matrix(second)
    np.testing.assert_allclose(one @ one.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(one) > 0.0
    np.testing.assert_allclose(rotation_matrix(product), one @ two, atol=1e-14)


def test_default_and_example_registration_axes() -> None:
    """Axes are parallel by default; the insertion axis of the example is superior."""
    np.testing.assert_allclose(Registration().to_image([1e-3, 2e-3, 3e-3]), [1.0, 2.0, 3.0])
    half = math.sqrt(0.5)
    perineum = Registration(rotation=(half, 0.0, 0.0, half), translation=(0.0, 0.0, -0.08))
    # The insertion direction is superior, z posterior.
    np.testing.assert_allclose(
        perineum.to_image([[0.0, 0.1, 0.0], [0.0, 0.0, 0.01]]),
        [[0.0, 0.0, 20.0], [0.0, -10.0, -80.0]],
        atol=1e-12,
    )


@pytest.mark.parametrize(
    ('given_', 'complaint'),
    [
        ({'rotation': (0.0, 0.0, 0.0, 0.0)}, 'rotation must be a quaternion x, y, z, w of norm 1'),
        ({'rotation': (0.5, 0.5, 0.0, 0.0)}, 'of norm 0.7'),
        ({'rotation': (0.0, 0.0, 1.0)}, 'rotation must have 4 numbers'),
        ({'rotation': (math.nan, 0.0, 0.0, 1.0)}, 'rotation must be finite'),
        ({'translation': (0.0, 100.0, 0.0)}, 'translation must be finite, >= -10 and <= 10 m'),
        ({'translation': (0.0,)}, 'translation must have 3 numbers'),
    ],
)
def test_invalid_registration_is_rejected(given_: dict[str, Any], complaint: str) -> None:
    """With one line; a quaternion rounded to three digits is valid."""
    with pytest.raises(ParameterError) as caught:
        Registration(**given_)
    assert complaint in str(caught.value)
    assert '\n' not in str(caught.value)
    Registration(rotation=(0.707, 0.0, 0.0, 0.707))


# Targets.


@given(registrations, targets, st.sampled_from(KINDS))
def test_target_is_converted_to_needle_frame(
    registration: Registration, at: Any, kind: Callable[[Any], Any]
) -> None:
    """From any message type and with any registration."""
    message = kind(registration.to_image(at)).pack()
    found = Interpreter(registration, REACH).target(framed(message))
    # Messages have 24 bits: 6e-8 of a meter at most, in each of three coordinates.
    np.testing.assert_allclose(found, at, atol=2e-7)


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize(
    ('at', 'complaint'),
    [
        ([math.nan, 10.0, 0.0], 'three finite numbers'),
        ([0.0, math.inf, 0.0], 'three finite numbers'),
        ([0.0, 400.0, 0.0], r'\(0, 400, 0\) mm is 400 mm from the entry point, reach is 300 mm'),
        ([1e30, 10.0, 0.0], 'from the entry point'),
        ([0.0, -20.0, 0.0], '20 mm outside of the tissue'),
    ],
)
def test_implausible_targets_are_rejected(
    kind: Callable[[Any], Any], at: list[float], complaint: str
) -> None:
    """Each with one line that gives the reason."""
    with pytest.raises(MessageError, match=complaint) as caught:
        Interpreter(Registration(), REACH).target(framed(kind(at).pack()))
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    ('message', 'complaint'),
    [
        (pyigtl.StringMessage('deep inside', device_name=TARGET), 'must be three numbers'),
        (pyigtl.StringMessage('1 2', device_name=TARGET), 'must be three finite numbers'),
        (pyigtl.PointMessage(np.zeros((2, 3)), device_name=TARGET), 'got 2'),
        (
            pyigtl.PointMessage(np.zeros((2, 3)), names=[TARGET, TARGET], device_name='a'),
            'one point must be named TARGET',
        ),
    ],
)
def test_messages_without_single_target_are_rejected(message: Any, complaint: str) -> None:
    with pytest.raises(MessageError, match=complaint):
        Interpreter(Registration(), REACH).target(framed(message.pack()))


def packed(kind: str, body: bytes, version: int = 1) -> Frame:
    """Return the frame of a message with a valid checksum."""
    head = HEADER.pack(version, kind.encode(), TARGET.encode(), 0, 0, len(body), CRC64(body))
    return framed(head + body)


@pytest.mark.parametrize(
    ('size', 'text', 'complaint'),
    [
        (400, '4 80 -2', 'STRING cannot be read: it states 400 bytes of text, and has 7'),
        (5, '4 80 -20', 'STRING cannot be read: it states 5 bytes of text, and has 8'),
        (8, '4 8_0 -2', "it must be three numbers, got '4 8_0 -2'"),
        (7, '4 \u0668 80', "it must be three numbers, got '4 "),
    ],
)
def test_ambiguous_text_is_rejected(size: int, text: str, complaint: str) -> None:
    """It would be another target."""
    body = struct.pack('>HH', 106, size) + text.encode()
    with pytest.raises(MessageError) as caught:
        Interpreter(Registration(), REACH).target(packed('STRING', body))
    assert complaint in str(caught.value)


@pytest.mark.parametrize(
    ('kind', 'version', 'body', 'complaint'),
    [
        ('POINT', 2, bytes(4), 'has no extended header in 4 bytes'),
        ('POINT', 2, struct.pack('>HHII', 12, 9, 9, 0), 'has 12 bytes, with an extended header'),
        ('TRANSFORM', 3, struct.pack('>HHII', 99, 0, 0, 0), 'an extended header of 99 and met'),
        ('STRING', 1, struct.pack('>HH', 9, 0), 'its encoding 9 is neither ASCII nor UTF-8'),
    ],
)
def test_unreadable_body_has_its_reason(
    kind: str, version: int, body: bytes, complaint: str
) -> None:
    with pytest.raises(MessageError) as caught:
        Interpreter(Registration(), REACH).target(packed(kind, body, version))
    assert f'the body of {kind} cannot be read: ' in str(caught.value)
    assert complaint in str(caught.value)


@pytest.mark.parametrize('size', [12, 24, 28])
def test_position_has_no_or_any_orientation(size: int) -> None:
    body = struct.pack('>3f', 4.0, 80.0, -2.0) + bytes(size - 12)
    found = Interpreter(Registration(), REACH).target(packed('POSITION', body))
    np.testing.assert_allclose(found, [4e-3, 0.08, -2e-3], atol=1e-8)
    with pytest.raises(MessageError, match=f'one of 12, 24, 28 bytes, got {size + 1}'):
        Interpreter(Registration(), REACH).target(packed('POSITION', body + bytes(1)))


@given(quaternions(), st.floats(1.002, 1e3) | st.floats(1e-3, 0.998), st.integers(0, 2))
def test_transform_with_scale_or_reflection_is_rejected(
    turn: Any, scale: float, axis: int
) -> None:
    """A rotation is accepted; the lengths of its columns and its determinant are stated."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation_matrix(turn), (4.0, 80.0, -2.0)
    interpreter = Interpreter(Registration(), REACH)

    def target(factor: float) -> Any:
        given_ = matrix.copy()
        given_[:3, axis] *= factor
        message = pyigtl.TransformMessage(given_, device_name=TARGET)
        return interpreter.target(framed(message.pack()))

    np.testing.assert_allclose(target(1.0), [4e-3, 0.08, -2e-3], atol=1e-7)
    for factor in (scale, -scale, -1.0):
        with pytest.raises(MessageError, match=r'must be a rotation to 0\.001, got columns of'):
            target(factor)
    with pytest.raises(MessageError, match='the matrix of a TRANSFORM must be finite'):
        target(math.nan)


@pytest.mark.parametrize('kind', KINDS)
def test_target_with_extended_header_and_metadata(kind: Callable[[Any], Any]) -> None:
    message = kind([4.0, 80.0, -2.0])
    message.header_version, message.metadata = 2, {'key': 'value'}
    found = Interpreter(Registration(), REACH).target(framed(message.pack()))
    np.testing.assert_allclose(found, [4e-3, 0.08, -2e-3], atol=1e-8)


def test_points_with_other_names_are_ignored() -> None:
    """Markups for other receivers use the same connection."""
    message = pyigtl.PointMessage(np.ones((3, 3)), names=['a', 'b', 'ENTRY'], device_name='F')
    assert Interpreter(Registration(), REACH).target(framed(message.pack())) is None


@pytest.mark.requirement('S-166')
@given(
    st.sampled_from(['POINT', 'TRANSFORM', 'POSITION', 'STRING']),
    st.binary(max_size=300),
    st.sampled_from([1, 2]),
)
def test_any_body_is_parsed_or_rejected(kind: str, body: bytes, version: int) -> None:
    """Any body with a valid checksum raises MessageError only."""
    header = HEADER.pack(version, kind.encode(), b'TARGET', 0, 0, len(body), CRC64(body))
    try:
        found = Interpreter(Registration(), REACH).target(framed(header + body))
    except MessageError:
        return
    assert found is None or np.isfinite(found).all()


@given(targets, st.integers(0, 8 * 48 - 1))
def test_checksum_detects_flipped_bit(at: Any, bit: int) -> None:
    """Pyigtl does not verify checksums: a damaged target would be another target."""
    data = bytearray(transform(1e3 * np.array(at)).pack())
    data[HEADER.size + bit // 8] ^= 1 << bit % 8
    with pytest.raises(MessageError, match='damaged'):
        Interpreter(Registration(), REACH).target(framed(bytes(data)))


# Needle.


@given(registrations, st.lists(vectors, min_size=2, max_size=60), quaternions(), st.booleans())
def test_shape_and_tip_are_encoded(
    registration: Registration, points: list[Any], turn: Any, line: bool
) -> None:
    """Points in order, in mm, with a header; the tip is the last point with orientation."""
    shape = Shape(12_345_678_901, np.array(points), np.array(turn), LINE if line else MEASURED)
    interpreter = Interpreter(registration, REACH)
    told, header = received(*interpreter.shape(shape, 7))
    assert (told.device_name, header.device_name) == (SHAPE, SHAPE_HEADER)
    assert told.names == [f'NeedleShapeZ{k}' for k in range(len(points))]
    seen = registration.to_image(points)
    # Rounded to 24 bits: about 1e-4 mm in 1 m.
    np.testing.assert_allclose(told.positions, seen, atol=2e-4)
    about = f'1970-01-01 00:00:12.345;7;{len(points)};image;{shape.source}'
    assert header.string == about
    (tip,) = received(interpreter.tip(shape))
    # Times have a resolution of 2^-32 s, 2.3e-10 s, and are floats in pyigtl.
    assert (tip.device_name, tip.timestamp) == (TIP, pytest.approx(12.345678901, abs=1e-8))
    np.testing.assert_allclose(tip.matrix[:3, 3], seen[-1], atol=2e-4)
    # y of the tip is along the needle: a step in this direction in the needle's frame.
    ahead = registration.to_image(points[-1] + rotation_matrix(turn)[:, 1])
    np.testing.assert_allclose(1e3 * tip.matrix[:3, 1], ahead - seen[-1], atol=2e-3)
    (expected,) = received(interpreter.tip_expected(EntryPose(5, np.array(points[0]), shape.turn)))
    assert expected.device_name == TIP_EXPECTED
    np.testing.assert_allclose(expected.matrix[:3, 3], seen[0], atol=2e-4)


def test_largest_shape_is_within_size_limit() -> None:
    """Transmitted shapes are within the limit for received messages."""
    shape = Shape(0, np.zeros((MOST_POINTS, 3)), np.array([0.0, 0.0, 0.0, 1.0]), MEASURED)
    points, _ = Interpreter(Registration(), REACH).shape(shape, 0)
    assert len(points) - HEADER.size <= LARGEST


@given(st.lists(st.text(max_size=3000), max_size=30), st.integers(-(2**31), 2**62))
def test_any_node_state_is_encoded(lines: list[str], stamp: int) -> None:
    """Also non-ASCII text, which pyigtl cannot encode, and very long text."""
    (told,) = received(Interpreter(Registration(), REACH).state(stamp, lines))
    assert told.device_name == STATE
    assert told.string.isascii()
    assert '\n'.join(lines).isascii() <= ('\n'.join(lines)).startswith(told.string)


@given(vectors, st.tuples(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01)))
def test_shape_without_measurement_is_marked_line(tip: Any, guide: tuple[float, float]) -> None:
    """From the guide to the tip, with y along it; outdated measurements are not used."""
    view = NeedleView()
    assert view.shape(0.0) is None
    view.take_tip(5, tip, 0.0)
    assert view.shape(0.0) is None
    view.take_guide(guide[0], guide[1], 0.5)
    shape = view.shape(0.9)
    assert (shape.stamp, shape.source) == (5, LINE)
    np.testing.assert_array_equal(shape.points, [(guide[0], 0.0, guide[1]), tip])
    way = np.subtract(*shape.points[::-1])
    length = np.linalg.norm(way)
    np.testing.assert_allclose(length * rotation_matrix(shape.turn)[:, 1], way, atol=1e-7)
    assert view.shape(1.1) is None
    # A measured shape has priority until its timeout.
    view.take_poses(6, [[0.0, 0.0, 0.0], [0.0, 0.1, 0.0]], [0.0, 0.0, 0.0, 1.0], 1.0)
    assert view.shape(1.1).source == MEASURED
    view.take_tip(7, tip, 3.0)
    view.take_guide(guide[0], guide[1], 3.0)
    assert view.shape(3.0).source == LINE


@pytest.mark.parametrize(
    ('points', 'turn', 'complaint'),
    [
        ([[0.0, 0.1, 0.0]], [0.0, 0.0, 0.0, 1.0], 'it has 1 poses'),
        ([], [], 'it has 0 poses'),
        (np.zeros((MOST_POINTS + 1, 3)), [0.0, 0.0, 0.0, 1.0], f'2 to {MOST_POINTS}'),
        ([[0.0, math.nan, 0.0]] * 2, [0.0, 0.0, 0.0, 1.0], 'a position is not within 10 m'),
        ([[0.0, 1e300, 0.0]] * 2, [0.0, 0.0, 0.0, 1.0], 'a position is not within 10 m'),
        ([[0.0, 0.1, 0.0]] * 2, [0.0, 0.0, 0.0, 0.0], 'of norm 0'),
    ],
)
def test_invalid_needle_poses_are_rejected(points: Any, turn: Any, complaint: str) -> None:
    """The previous state is kept."""
    view = NeedleView()
    with pytest.raises(MessageError, match=complaint):
        view.take_poses(0, points, turn, 0.0)
    assert view.shape(0.0) is None
    nowhere = [math.nan] * 3
    with pytest.raises(MessageError):
        view.take_tip(0, nowhere, 0.0)
    with pytest.raises(MessageError):
        view.take_expected(0, nowhere, [0.0, 0.0, 0.0, 1.0])
    with pytest.raises(MessageError):
        view.take_guide(math.inf, 0.0, 0.0)
    assert view.expected is None


# Stream.

STREAM = b''.join(
    one.pack()
    for one in (
        point([1.0, 2.0, 3.0]),
        pyigtl.TransformMessage(device_name='Probe'),
        pyigtl.StringMessage('x' * 500, device_name='Words'),
        transform([4.0, 5.0, 6.0]),
        pyigtl.ImageMessage(np.zeros((4, 30, 30), dtype=np.uint8), device_name=TARGET),
        string([7.0, 8.0, 9.0]),
    )
)


@given(st.lists(st.integers(0, len(STREAM)), max_size=20))
def test_stream_is_split_independently_of_chunks(cuts: list[int]) -> None:
    """All wanted messages are returned, and unwanted messages are skipped."""
    frames = Frames(largest_target)
    ends = [0, *sorted(cuts), len(STREAM)]
    found = [one for a, b in pairwise(ends) for one in frames.take(STREAM[a:b])]
    assert [one.kind for one in found] == ['POINT', 'TRANSFORM', 'STRING']
    assert {one.device for one in found} == {TARGET}
    assert all(one.data in STREAM for one in found)


@given(st.binary(min_size=HEADER.size, max_size=500))
def test_random_bytes_are_rejected_or_skipped(data: bytes) -> None:
    """Random bytes are an error or an unwanted message."""
    with suppress(MessageError):
        assert Frames(largest_target).take(data) == []


@pytest.mark.requirement('S-166')
def test_oversized_messages_are_skipped_without_storage() -> None:
    """A target of a gigabyte is rejected by its header and skipped; a larger size is an error."""
    frames = Frames(largest_target)
    large = HEADER.pack(1, b'POINT', b'TARGET', 0, 0, 1 << 30, 0)
    (frame,) = frames.take(large)
    assert (frame.data, frame.error) == (b'', f'a POINT message of {1 << 30} bytes, 65536 at most')
    with pytest.raises(MessageError, match=frame.error):
        Interpreter(Registration(), REACH).target(frame)
    block = bytes(1 << 22)
    for _ in range((1 << 30) // len(block)):
        assert frames.take(block) == []
    after = transform([1.0, 2.0, 3.0]).pack()
    assert [one.data for one in frames.take(after)] == [after]
    with pytest.raises(MessageError, match='a POINT message of 18446744073709551615 bytes'):
        frames.take(HEADER.pack(1, b'POINT', b'TARGET', 0, 0, 2**64 - 1, 0))


def test_only_node_requires_ros_and_only_messages_require_pyigtl() -> None:
    """The other modules import without them."""
    script = (
        'import sys; sys.modules.update(rclpy=None, pyigtl=None)\n'
        'from needle_insertion.slicer import link, needle\n'
        'del sys.modules["pyigtl"]\n'
        'from needle_insertion.slicer import messages\n'
    )
    subprocess.run([sys.executable, '-c', script], check=True)
