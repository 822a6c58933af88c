# SPDX-License-Identifier: Apache-2.0
"""
Conversion between OpenIGTLink messages and the quantities of the ROS interface.

Lengths of the messages are in mm, in the frame of the images (RAS in 3D Slicer); lengths of the
nodes are in m, in ``needle_entry``; a `Registration` transforms between them. Device names are
those used by SmartNeedle (trajcontrol, and its module of 3D Slicer), where it defines a name:
docs/howto/slicer.md.
"""

from collections.abc import Iterable
from contextlib import suppress
from datetime import datetime, timedelta, timezone
import re
import struct
from typing import Any, Final

from needle_dynamics.arrays import FloatArray
from needle_insertion.slicer.image import LARGEST_IMAGE, read_image
from needle_insertion.slicer.link import Frame, HEADER, LARGEST
from needle_insertion.slicer.needle import EntryPose, MILLIMETERS, Registration, Shape
from needle_insertion.slicer.plan_files import PlannedShape
from needle_planning.anatomy import SegmentationError
from needle_planning.voxels import Layer
from needle_ros.errors import MessageError
from needle_ros.timing import NANOSECONDS
import numpy as np
from pyigtl.messages import (
    CRC64,
    MessageBase,
    PointMessage,
    PolyDataMessage,
    StringMessage,
    TransformMessage,
)

#: Name of the target: a point name in any POINT message, or a device name.
TARGET: Final = 'TARGET'
SEGMENTATION: Final = 'SEGMENTATION'  #: device name of a label map
#: Messages that are accepted, in words.
ACCEPTED: Final = (
    f'a target is a point named {TARGET} in a POINT, or a POINT, TRANSFORM, POSITION or STRING of '
    f'the device {TARGET}; with planning.labels, a label map is an IMAGE of the device '
    f'{SEGMENTATION}'
)
#: Types that may be meant as a target or as a label map.
TYPES: Final = 'POINT', 'TRANSFORM', 'POSITION', 'STRING', 'IMAGE'

#: Device names of transmitted messages.
SHAPE: Final = 'NeedleShapeZ'
SHAPE_HEADER: Final = 'NeedleShapeHeader'
TIP: Final = 'NeedleTip'
TIP_EXPECTED: Final = 'NeedleTipExpected'
STATE: Final = 'NeedleState'
PLAN: Final = 'NeedlePlan'
PLAN_MODEL: Final = 'NeedlePlanModel'
PLAN_STATE: Final = 'NeedlePlanState'

#: Tolerance of a target on the skin, for 32-bit numbers and manual input [m].
_ROUNDING: Final = 1e-4

#: Sizes of the extended header, of entries and texts of metadata; number of the message.
_EXTENDED: Final = struct.Struct('>HHII')

#: Position, and size of the body with the orientation: none, three or four numbers [bytes].
_POSITION: Final = struct.Struct('>3f')
_POSITION_SIZES: Final = 12, 24, 28

_RIGID: Final = 1e-3  #: tolerance of the rotation in a TRANSFORM

_STRING: Final = struct.Struct('>HH')  #: encoding of a STRING, and size of its text [bytes]

_PART: Final = 1 << 20  #: part of a body whose checksum is computed at once [bytes]

_LONGEST_STATE: Final = 8000  #: longest state [characters]; the length of a STRING has 16 bits

_EPOCH: Final = datetime(1970, 1, 1, tzinfo=timezone.utc)

_BETWEEN: Final = re.compile(r'[\s,;]+')  #: separators of the numbers of a STRING

#: Exceptions of pyigtl for bodies that do not match their type.
_NOT_UNDERSTOOD: Final = (struct.error, ValueError, TypeError, IndexError)


def largest_target(kind: str, device: str) -> int:
    """Return the largest body of a message that can contain a target [bytes], 0 for others."""
    named = device == TARGET and kind in ('TRANSFORM', 'POSITION', 'STRING')
    is_target = kind == 'POINT' or named
    return LARGEST if is_target else 0


def largest_of_plans(kind: str, device: str) -> int:
    """Return the largest body of a target or a segmentation [bytes], 0 for others."""
    is_image = (kind, device) == ('IMAGE', SEGMENTATION)
    return LARGEST_IMAGE if is_image else largest_target(kind, device)


class Interpreter:
    """Converter of targets, up to `reach` [m] from the entry point, and of needle shapes."""

    def __init__(self, registration: Registration, reach: float) -> None:
        self._registration, self._reach = registration, reach

    def target(self, frame: Frame) -> FloatArray | None:
        """Return the target in ``needle_entry`` [m] or None; `MessageError` if it is invalid."""
        at = target_in_images(frame)
        if at is None:
            return None
        point = self._registration.to_needle(at)
        distance = float(np.linalg.norm(point))
        if not distance <= self._reach:
            raise MessageError(
                f'{_millimeters(at)} is {MILLIMETERS * distance:.6g} mm from the entry point, '
                f'reach is {MILLIMETERS * self._reach:g} mm; check the registration'
            )
        if point[1] < -_ROUNDING:
            raise MessageError(
                f'{_millimeters(at)} is {-MILLIMETERS * point[1]:.6g} mm outside of the tissue; '
                'check the registration'
            )
        return point

    def shape(self, shape: Shape, number: int) -> list[bytes]:
        """Return a POINT message with the shape, from guide to tip, and its STRING header."""
        time = _seconds(shape.stamp)
        count = len(shape.points)
        points = PointMessage(
            self._registration.to_image(shape.points),
            names=[f'{SHAPE}{k}' for k in range(count)],
            timestamp=time,
            device_name=SHAPE,
        )
        moment = (_EPOCH + timedelta(seconds=time)).strftime('%Y-%m-%d %H:%M:%S.%f')[:-3]
        words = (moment, str(number), str(count), 'image', shape.source)
        header = StringMessage(';'.join(words), timestamp=time, device_name=SHAPE_HEADER)
        return [points.pack(), header.pack()]

    def tip(self, shape: Shape) -> bytes:
        """Return the pose of the tip as a TRANSFORM message, with y along the needle."""
        return self._pose(TIP, EntryPose(shape.stamp, shape.points[-1], shape.turn))

    def tip_expected(self, pose: EntryPose) -> bytes:
        """Return the predicted pose of the tip as a TRANSFORM message."""
        return self._pose(TIP_EXPECTED, pose)

    def _pose(self, device: str, pose: EntryPose) -> bytes:
        matrix = self._registration.pose_to_image(pose.position, pose.turn)
        message = TransformMessage(matrix, timestamp=_seconds(pose.stamp), device_name=device)
        return bytes(message.pack())

    def state(self, stamp: int, lines: Iterable[str], device: str = STATE) -> bytes:
        """Return the states of the nodes, one line per node, as a STRING message; time in ns."""
        # pyigtl cannot encode other characters: it catches the wrong exception.
        text = '\n'.join(lines).encode('ascii', 'replace').decode()[:_LONGEST_STATE]
        message = StringMessage(text, timestamp=_seconds(stamp), device_name=device)
        return bytes(message.pack())


def target_in_images(frame: Frame) -> FloatArray | None:
    """Return the target in the frame of the images [mm] or None; `MessageError` if invalid."""
    found = _position(frame) if frame.kind == 'POSITION' else _coordinates(_message(frame))
    if found is None:
        return None
    at = np.array(found, dtype=np.float64)
    if at.shape != (3,) or not np.isfinite(at).all():
        raise MessageError(f'it must be three finite numbers, got {at.tolist()}')
    return at


def read_segmentation(frame: Frame) -> Layer:
    """Return the label map of an IMAGE message; `NeedleError` with its device if it is invalid."""
    try:
        body = _checked_body(frame)
        version, *_ = HEADER.unpack(frame.data[: HEADER.size])
        return read_image(_content(version, body), frame.device)
    except (MessageError, SegmentationError) as error:
        raise SegmentationError(f'{frame.device}: {error}') from error


def plan_messages(shape: PlannedShape, stamp: int) -> list[bytes]:
    """Return the needle of a plan as POINT and as POLYDATA, already in the images; time in ns."""
    time = _seconds(stamp)
    points = PointMessage(
        shape.curve,
        names=[f'{PLAN}{k}' for k in range(len(shape.curve))],
        timestamp=time,
        device_name=PLAN,
    )
    corners = np.insert(shape.triangles, 0, 3, axis=1).ravel()
    model = PolyDataMessage(
        points=shape.points, polygons=corners, timestamp=time, device_name=PLAN_MODEL
    )
    return [points.pack(), model.pack()]


def _millimeters(at: FloatArray) -> str:
    return f'({", ".join(f"{one:.6g}" for one in at.tolist())}) mm'


def _checked_body(frame: Frame) -> memoryview:
    """Return the body of a message; pyigtl does not verify the checksum."""
    if frame.error:
        raise MessageError(frame.error)
    body, checksum = memoryview(frame.data)[HEADER.size :], 0
    # In parts, between which other threads run.
    for start in range(0, len(body), _PART):
        checksum = CRC64(bytes(body[start : start + _PART]), checksum)
    if HEADER.unpack(frame.data[: HEADER.size])[-1] != checksum:
        raise MessageError('the message is damaged: its checksum is wrong')
    return body


def _content(version: int, body: memoryview) -> memoryview:
    """Return a body without its extended header and metadata, which version 2 has."""
    if version < 2:
        return body
    if len(body) < _EXTENDED.size:
        raise MessageError(f'has no extended header in {len(body)} bytes')
    size, entries, texts, _ = _EXTENDED.unpack(body[: _EXTENDED.size])
    end = len(body) - entries - texts
    if not _EXTENDED.size <= size <= end:
        raise MessageError(
            f'has {len(body)} bytes, with an extended header of {size} and metadata of '
            f'{entries + texts} bytes'
        )
    return body[size:end]


def _message(frame: Frame) -> Any:
    header, body = bytes(frame.data[: HEADER.size]), _checked_body(frame)
    try:
        fields = MessageBase.parse_header(header)
        content = bytes(_content(fields['header_version'], body))
        if frame.kind == 'STRING':
            _check_string(content)
        message = MessageBase.create_message(fields['message_type'])
        # pyigtl does not check the extended header, which is left out here.
        message.unpack({**fields, 'header_version': 1}, content)
    except _NOT_UNDERSTOOD as error:
        raise MessageError(f'the body of {frame.kind} cannot be read: {error}') from error
    return message


def _check_string(content: bytes) -> None:
    """Check encoding and size of a STRING; pyigtl reads a part, or less than stated."""
    encoding, size = _STRING.unpack_from(content)
    if encoding not in (MessageBase.IANA_CHARACTER_SET_ASCII, MessageBase.IANA_CHARACTER_SET_UTF8):
        raise MessageError(f'its encoding {encoding} is neither ASCII nor UTF-8')
    if size != (there := len(content) - _STRING.size):
        raise MessageError(f'it states {size} bytes of text, and has {there}')


def _position(frame: Frame) -> tuple[float, ...]:
    """Return the coordinates of a POSITION, which pyigtl reads in another format."""
    body = _checked_body(frame)
    version, *_ = HEADER.unpack(frame.data[: HEADER.size])
    content = _content(version, body)
    if len(content) not in _POSITION_SIZES:
        sizes = ', '.join(map(str, _POSITION_SIZES))
        raise MessageError(f'a POSITION has one of {sizes} bytes, got {len(content)}')
    return _POSITION.unpack_from(content)


@np.errstate(all='ignore')
def _check_rigid(matrix: FloatArray) -> None:
    """Raise `MessageError` unless a matrix is a rotation, without scale and reflection."""
    turn = matrix[:3, :3]
    if not np.isfinite(turn).all():
        raise MessageError('the matrix of a TRANSFORM must be finite')
    if not (np.abs(turn.T @ turn - np.eye(3)).max() <= _RIGID and np.linalg.det(turn) > 0.0):
        sizes = ', '.join(f'{one:.4g}' for one in np.linalg.norm(turn, axis=0))
        raise MessageError(
            f'the matrix of a TRANSFORM must be a rotation to {_RIGID:g}, got columns of length '
            f'{sizes} and the determinant {np.linalg.det(turn):.4g}: remove scale and reflection'
        )


def _coordinates(message: Any) -> Any:
    """Return the coordinates of the target in a message, None without a target."""
    if isinstance(message, TransformMessage):
        _check_rigid(message.matrix)
        return message.matrix[:3, 3]
    if isinstance(message, StringMessage):
        # Python reads 8_0 as 80, and digits of other scripts.
        if message.string.isascii() and '_' not in message.string:
            with suppress(ValueError):
                return [float(word) for word in _BETWEEN.split(message.string.strip())]
        raise MessageError(f'it must be three numbers, got {message.string!r}')
    places = dict(enumerate(message.positions))
    named = [k for k, name in enumerate(message.names) if name == TARGET]
    if not named and message.device_name == TARGET:
        # A list with this name and a point with any name.
        named = list(places)
    elif not named:
        return None
    if len(named) != 1:
        raise MessageError(
            f'one point must be named {TARGET}, or alone in the list {TARGET}; got {len(named)}'
        )
    return places[named[0]]


def _seconds(stamp: int) -> float:
    """Return a time [s] within the range of the header, which has 32 bits for the seconds."""
    return min(max(stamp, 0), (1 << 32) * NANOSECONDS - NANOSECONDS) / NANOSECONDS
