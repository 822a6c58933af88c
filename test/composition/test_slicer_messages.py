"""Targets and needle as OpenIGTLink messages: there and back, and whatever else may come."""

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
from needle_insertion.slicer.frames import Frame, Frames, HEADER, LARGEST
from needle_insertion.slicer.messages import (
    Interpreter,
    is_wanted,
    SHAPE,
    SHAPE_HEADER,
    STATE,
    TARGET,
    TIP,
    TIP_EXPECTED,
)
from needle_insertion.slicer.needle import LINE, MEASURED, MOST_POINTS, NeedleView, Pose, Shape
from needle_insertion.slicer.registration import Registration, rotation_matrix
from needle_insertion.slicer.settings import LinkSettings
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
    """Return messages as pyigtl reads them."""
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
    """Return the one frame of a message."""
    (frame,) = Frames(is_wanted, pytest.fail).take(data)
    return frame


def point(at: Any) -> Any:
    return pyigtl.PointMessage(np.array([at]), names=['F-1'], device_name=TARGET)


def planned(at: Any) -> Any:
    """Return what SmartNeedle's module sends: a list of any name, with target and entry."""
    both = np.array([at, [0.0, 0.0, 0.0]])
    return pyigtl.PointMessage(both, names=[TARGET, 'ENTRY'], device_name='PlanningZ')


def transform(at: Any) -> Any:
    matrix = np.eye(4)
    matrix[:3, 3] = at
    return pyigtl.TransformMessage(matrix, device_name=TARGET)


def string(at: Any) -> Any:
    return pyigtl.StringMessage('; '.join(repr(float(one)) for one in at), device_name=TARGET)


KINDS = [point, planned, transform, string]


# The frame of the images.


@given(registrations, st.lists(vectors, min_size=1, max_size=5))
def test_to_the_images_and_back(registration: Registration, points: list[Any]) -> None:
    """Points return where they were, and keep their distances, in mm."""
    there = registration.to_image(points)
    # 1e-12: a hundred times the rounding of coordinates of some 1 m.
    np.testing.assert_allclose(registration.to_needle(there), points, atol=1e-12)
    distances = np.linalg.norm(np.diff(points, axis=0), axis=1)
    seen = np.linalg.norm(np.diff(there, axis=0), axis=1)
    np.testing.assert_allclose(seen, 1e3 * distances, atol=1e-9)


@given(quaternions(), quaternions(), vectors)
def test_rotations_are_those_of_quaternions(first: Any, second: Any, vector: Any) -> None:
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


def test_the_axes_by_default_and_of_an_example() -> None:
    """By default axes are parallel; the example of the page points into the patient's feet-up."""
    np.testing.assert_allclose(Registration().to_image([1e-3, 2e-3, 3e-3]), [1.0, 2.0, 3.0])
    half = math.sqrt(0.5)
    perineum = Registration(rotation=(half, 0.0, 0.0, half), translation=(0.0, 0.0, -0.08))
    # Into the tissue is superior, its z posterior.
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
def test_an_invalid_registration_is_refused(given_: dict[str, Any], complaint: str) -> None:
    """One line says what is wrong; a quaternion that is rounded to three digits is none."""
    with pytest.raises(ParameterError) as caught:
        Registration(**given_)
    assert complaint in str(caught.value)
    assert '\n' not in str(caught.value)
    Registration(rotation=(0.707, 0.0, 0.0, 0.707))


@pytest.mark.parametrize(
    ('given_', 'complaint'),
    [
        ({'role': 'peer'}, 'role must be one of server, client'),
        ({'host': 'localhost'}, "host must be an IPv4 address such as 127.0.0.1, got 'localhost'"),
        ({'port': 0}, 'port must be finite, >= 1'),
        ({'port': 80.5}, 'port must be a whole number'),
    ],
)
def test_an_invalid_place_is_refused(given_: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ParameterError, match=complaint):
        LinkSettings(**given_)


# Targets.


@given(registrations, targets, st.sampled_from(KINDS))
def test_a_target_arrives_where_it_is(
    registration: Registration, at: Any, kind: Callable[[Any], Any]
) -> None:
    """Whatever message tells it, and wherever the images are."""
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
def test_targets_without_sense_are_refused(
    kind: Callable[[Any], Any], at: list[float], complaint: str
) -> None:
    """Each with one line that says why."""
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
def test_targets_that_are_not_one_are_refused(message: Any, complaint: str) -> None:
    with pytest.raises(MessageError, match=complaint):
        Interpreter(Registration(), REACH).target(framed(message.pack()))


def test_other_points_are_no_target() -> None:
    """Markups that somebody else is told come on the same connection."""
    message = pyigtl.PointMessage(np.ones((3, 3)), names=['a', 'b', 'ENTRY'], device_name='F')
    assert Interpreter(Registration(), REACH).target(framed(message.pack())) is None


@given(
    st.sampled_from(['POINT', 'TRANSFORM', 'STRING']),
    st.binary(max_size=300),
    st.sampled_from([1, 2]),
)
def test_any_body_is_read_or_refused(kind: str, body: bytes, version: int) -> None:
    """Nothing but a MessageError comes of it, whatever a body with a right checksum has."""
    header = HEADER.pack(version, kind.encode(), b'TARGET', 0, 0, len(body), CRC64(body))
    try:
        found = Interpreter(Registration(), REACH).target(framed(header + body))
    except MessageError:
        return
    assert found is None or np.isfinite(found).all()


@given(targets, st.integers(0, 8 * 48 - 1))
def test_a_flipped_bit_is_noticed(at: Any, bit: int) -> None:
    """Pyigtl does not compare checksums: a target that is damaged would be another target."""
    data = bytearray(transform(1e3 * np.array(at)).pack())
    data[HEADER.size + bit // 8] ^= 1 << bit % 8
    with pytest.raises(MessageError, match='damaged'):
        Interpreter(Registration(), REACH).target(framed(bytes(data)))


# The needle.


@given(registrations, st.lists(vectors, min_size=2, max_size=60), quaternions(), st.booleans())
def test_the_needle_is_told(
    registration: Registration, points: list[Any], turn: Any, line: bool
) -> None:
    """Points in their order, in mm, with a line about them; the tip is the last one, turned."""
    shape = Shape(12_345_678_901, np.array(points), np.array(turn), LINE if line else MEASURED)
    interpreter = Interpreter(registration, REACH)
    told, header = received(*interpreter.shape(shape, 7))
    assert (told.device_name, header.device_name) == (SHAPE, SHAPE_HEADER)
    assert told.names == [f'NeedleShapeZ{k}' for k in range(len(points))]
    seen = registration.to_image(points)
    # Rounded to 24 bits: some 1e-4 mm in 1 m.
    np.testing.assert_allclose(told.positions, seen, atol=2e-4)
    about = f'1970-01-01 00:00:12.345;7;{len(points)};image;{shape.source}'
    assert header.string == about
    (tip,) = received(interpreter.tip(shape))
    # A time is in parts of 2^-32 s, 2.3e-10 s, and pyigtl has it as a float.
    assert (tip.device_name, tip.timestamp) == (TIP, pytest.approx(12.345678901, abs=1e-8))
    np.testing.assert_allclose(tip.matrix[:3, 3], seen[-1], atol=2e-4)
    # y of the tip is along the needle: a step along it in the needle's frame.
    ahead = registration.to_image(points[-1] + rotation_matrix(turn)[:, 1])
    np.testing.assert_allclose(1e3 * tip.matrix[:3, 1], ahead - seen[-1], atol=2e-3)
    (expected,) = received(interpreter.tip_expected(Pose(5, np.array(points[0]), shape.turn)))
    assert expected.device_name == TIP_EXPECTED
    np.testing.assert_allclose(expected.matrix[:3, 3], seen[0], atol=2e-4)


def test_the_largest_shape_is_within_what_we_take() -> None:
    """What we send could be sent to us."""
    shape = Shape(0, np.zeros((MOST_POINTS, 3)), np.array([0.0, 0.0, 0.0, 1.0]), MEASURED)
    points, _ = Interpreter(Registration(), REACH).shape(shape, 0)
    assert len(points) - HEADER.size <= LARGEST


@given(st.lists(st.text(max_size=3000), max_size=30), st.integers(-(2**31), 2**62))
def test_any_words_of_the_nodes_are_told(lines: list[str], stamp: int) -> None:
    """Also what is no ASCII, which pyigtl cannot write, and far more than anybody reads."""
    (told,) = received(Interpreter(Registration(), REACH).state(stamp, lines))
    assert told.device_name == STATE
    assert told.string.isascii()
    assert '\n'.join(lines).isascii() <= ('\n'.join(lines)).startswith(told.string)


@given(vectors, st.tuples(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01)))
def test_without_a_shape_it_is_a_line_and_says_so(tip: Any, guide: tuple[float, float]) -> None:
    """From the guide to the tip, with y along it; what is old is not shown."""
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
    # A shape that comes counts, as long as it comes.
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
def test_what_is_no_needle_is_refused(points: Any, turn: Any, complaint: str) -> None:
    """And what was there before stays."""
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


# Bytes.

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
def test_a_stream_may_come_in_any_pieces(cuts: list[int]) -> None:
    """The same messages come out, and those that nobody wants do not."""
    frames = Frames(is_wanted, pytest.fail)
    ends = [0, *sorted(cuts), len(STREAM)]
    found = [one for a, b in pairwise(ends) for one in frames.take(STREAM[a:b])]
    assert [one.kind for one in found] == ['POINT', 'TRANSFORM', 'STRING']
    assert {one.device for one in found} == {TARGET}
    assert all(one.data in STREAM for one in found)


@given(st.binary(min_size=HEADER.size, max_size=500))
def test_what_is_not_openigtlink_is_refused_or_passed_over(data: bytes) -> None:
    """Random bytes end the connection, or are a message that nobody wants."""
    with suppress(MessageError):
        assert Frames(is_wanted, pytest.fail).take(data) == []


def test_what_is_too_large_is_never_stored() -> None:
    """A target of a gigabyte is refused by its header and passed over; more is no message."""
    complaints: list[str] = []
    frames = Frames(is_wanted, complaints.append)
    large = HEADER.pack(1, b'POINT', b'TARGET', 0, 0, 1 << 30, 0)
    assert frames.take(large) == []
    assert complaints == [f'target refused: a POINT message of {1 << 30} bytes, {LARGEST} at most']
    block = bytes(1 << 22)
    for _ in range((1 << 30) // len(block)):
        assert frames.take(block) == []
    after = transform([1.0, 2.0, 3.0]).pack()
    assert [one.data for one in frames.take(after)] == [after]
    assert len(complaints) == 1
    with pytest.raises(MessageError, match='a POINT message of 18446744073709551615 bytes'):
        frames.take(HEADER.pack(1, b'POINT', b'TARGET', 0, 0, 2**64 - 1, 0))


@given(
    st.integers(0, 5) | st.integers(0, 65535),
    st.binary(min_size=12, max_size=12) | st.sampled_from([b'POINT' + bytes(7), b'STATUS' * 2]),
)
def test_names_of_types_are_words(version: int, kind: bytes) -> None:
    """A header of another protocol is not followed."""
    header = struct.pack('>H12s', version, kind) + bytes(HEADER.size - 14)
    name = kind.rstrip(b' \0')
    if version in (1, 2, 3) and name.isascii() and name.decode('latin1').isprintable():
        found = Frames(is_wanted, pytest.fail).take(header)
        assert [one.kind for one in found] == ['POINT'] * (name == b'POINT')
    else:
        with pytest.raises(MessageError):
            Frames(is_wanted, pytest.fail).take(header)


def test_only_the_node_needs_ros_and_only_messages_need_pyigtl() -> None:
    """The rest can be used and tested without them."""
    script = (
        'import sys; sys.modules.update(rclpy=None, pyigtl=None)\n'
        'from needle_insertion.slicer import frames, link, needle, registration, settings\n'
        'del sys.modules["pyigtl"]\n'
        'from needle_insertion.slicer import messages\n'
    )
    subprocess.run([sys.executable, '-c', script], check=True)
