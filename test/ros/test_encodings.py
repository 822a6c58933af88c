# SPDX-License-Identifier: Apache-2.0
"""
Reading of CDR: every valid encoding of every type of the contract.

`encoded` is an independent encoder, written from the rules of CDR (XCDR1, aligned to the size of a
number) and XCDR2 (aligned to at most four bytes, with sizes before arrays of strings or messages).
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
import struct
from typing import Any

from hypothesis import given, HealthCheck, settings, strategies
from needle_identification import RecordingError
from needle_identification.bags.messages import deserialize
from needle_identification.bags.topics import BagTopic
from needle_ros import wire
from needle_ros.contract import TOPICS
from needle_ros.errors import MessageError
import numpy as np
import pytest
from rclpy.serialization import serialize_message
from rosbags.interfaces import Nodetype
from support.samples import STORE

#: Types of the contract, and the others of which motions are read from bags.
TYPES = sorted({topic.type_name for topic in TOPICS} | set(wire.TYPES))
MARKER, TRANSFORMS = 'visualization_msgs/msg/Marker', 'tf2_msgs/msg/TFMessage'
TEXT, EMPTY = 'std_msgs/msg/String', 'std_msgs/msg/Empty'

#: struct format by the name of a base type.
FORMATS = {
    'bool': '?', 'byte': 'B', 'char': 'B', 'octet': 'B', 'int8': 'b', 'uint8': 'B', 'int16': 'h',
    'uint16': 'H', 'int32': 'i', 'uint32': 'I', 'int64': 'q', 'uint64': 'Q', 'float32': 'f',
    'float64': 'd',
}  # fmt: skip

#: Letters of several bytes in UTF-8; no NUL, which ends a string.
TEXTS = strategies.text(
    strategies.characters(exclude_characters='\0', exclude_categories=['Cs']), max_size=6
)


def values(desc: Any) -> strategies.SearchStrategy[Any]:
    """Generate values of a field: numbers with NaN and infinities, texts, dicts and lists."""
    kind, inner = desc
    if kind == Nodetype.NAME:
        return message_values(inner)
    if kind == Nodetype.BASE:
        name = inner[0]
        if name == 'string':
            return TEXTS
        if name == 'bool':
            return strategies.booleans()
        if name.startswith('float'):
            return strategies.floats(width=32 if name == 'float32' else 64)
        size = 8 * struct.calcsize(FORMATS[name])
        low = -(2 ** (size - 1)) if FORMATS[name].islower() else 0
        return strategies.integers(low, low + 2**size - 1)
    element, length = inner
    least, most = (length, length) if kind == Nodetype.ARRAY else (0, 2)
    return strategies.lists(values(element), min_size=least, max_size=most)


def message_values(type_name: str) -> strategies.SearchStrategy[Any]:
    if type_name == EMPTY:
        # The byte of an empty message is not a field.
        return strategies.just({'structure_needs_at_least_one_member': 0})
    return strategies.fixed_dictionaries(
        {name: values(desc) for name, desc in STORE.fielddefs[type_name][1]}
    )


class Encoder:
    """Encoder of values, big (``>``) or little (``<``) endian, aligned to at most `widest`."""

    def __init__(self, order: str, widest: int) -> None:
        self.body, self._order, self._widest = bytearray(), order, widest

    def number(self, form: str, value: Any) -> None:
        size = struct.calcsize(form)
        self.body += bytes(-len(self.body) % min(size, self._widest))
        self.body += struct.pack(self._order + form, value)

    def field(self, desc: Any, value: Any) -> None:
        kind, inner = desc
        if kind == Nodetype.NAME:
            for name, field in STORE.fielddefs[inner][1]:
                self.field(field, value[name])
        elif kind == Nodetype.BASE and inner[0] == 'string':
            text = value.encode() + b'\0'
            self.number('I', len(text))
            self.body += text
        elif kind == Nodetype.BASE:
            self.number(FORMATS[inner[0]], value)
        else:
            element, _ = inner
            is_plain = element[0] == Nodetype.BASE and element[1][0] != 'string'
            if self._widest == 4 and not is_plain:
                self.number('I', 0)
            begin = len(self.body)
            if kind == Nodetype.SEQUENCE:
                self.number('I', len(value))
            for one in value:
                self.field(element, one)
            if self._widest == 4 and not is_plain:
                size = struct.pack(f'{self._order}I', len(self.body) - begin)
                self.body[begin - 4 : begin] = size


def encoded(type_name: str, value: Any, kind: int, options: int = 0) -> bytes:
    """Encode a message with an encapsulation kind (0, 1: CDR; 6, 7: XCDR2)."""
    encoder = Encoder('<' if kind % 2 else '>', 8 if kind < 2 else 4)
    encoder.field((Nodetype.NAME, type_name), value)
    return struct.pack('>HH', kind, options) + bytes(encoder.body)


def filled(type_name: str, value: Any) -> Any:
    """Build the message of rclpy."""
    package, _, name = type_name.split('/')
    message = getattr(import_module(f'{package}.msg'), name)()
    for field, desc in STORE.fielddefs[type_name][1]:
        if type_name != EMPTY:
            setattr(message, field, _field(desc, value[field]))
    return message


def _field(desc: Any, value: Any) -> Any:
    kind, inner = desc
    if kind == Nodetype.NAME:
        return filled(inner, value)
    if kind == Nodetype.BASE:
        return bytes([value]) if inner[0] in ('byte', 'octet') else value
    return [_field(inner[0], one) for one in value]


def plain(desc: Any, value: Any) -> Any:
    """Convert a message of rosbags to values."""
    kind, inner = desc
    if kind == Nodetype.NAME:
        return {
            name: plain(field, getattr(value, name)) for name, field in STORE.fielddefs[inner][1]
        }
    if kind == Nodetype.BASE:
        # rosbags reads a byte as a signed number.
        return value % 256 if inner[0] in ('byte', 'octet') else value
    return [plain(inner[0], one) for one in value]


def numbers(desc: Any, value: Any) -> list[float]:
    """List the floating-point numbers of a field, in order."""
    kind, inner = desc
    if kind == Nodetype.NAME:
        fields = STORE.fielddefs[inner][1]
        return [one for name, field in fields for one in numbers(field, value[name])]
    if kind == Nodetype.BASE:
        return [value] if inner[0].startswith('float') else []
    return [one for part in value for one in numbers(inner[0], part)]


def same(found: Sequence[float], expected: Sequence[float]) -> bool:
    """Compare to the bit, also NaN."""
    return np.array(found, dtype=float).tobytes() == np.array(expected, dtype=float).tobytes()


def check(type_name: str, value: Any, data: bytes) -> None:
    """Every reader of the type returns the values."""
    if data[1] < 2:
        read = plain((Nodetype.NAME, type_name), deserialize(BagTopic('/topic', type_name), data))
        assert encoded(type_name, read, 1) == encoded(type_name, value, 1)
    if type_name in wire.TYPES:
        check_wire(type_name, value, data)
    if type_name == TEXT:
        assert wire.read_string(data) == value['data']
    if type_name == MARKER:
        name, points = wire.read_line(data)
        assert name == value['ns']
        expected = [[point[axis] for axis in 'xyz'] for point in value['points']]
        assert same(points.ravel().tolist(), [one for point in expected for one in point])


def check_wire(type_name: str, value: Any, data: bytes) -> None:
    """Read a single message, a message by a foreign template, and a batch."""
    stamp = value['header']['stamp']
    expected = numbers((Nodetype.NAME, type_name), value)
    for template in (wire.Template.of(data, type_name), None):
        reading = template.read(data) if template else wire.MessageReader(type_name).read(data)
        assert reading is not None
        assert reading.stamp == stamp['sec'] * 10**9 + stamp['nanosec']
        assert (reading.frame, reading.names) == (
            value['header']['frame_id'],
            tuple(value.get('name', ())),
        )
        assert same([one for part in reading.values for one in part], expected)

    def every(template: wire.Template) -> list[int]:
        return [begin + 8 * k for begin, length in template.arrays for k in range(length)]

    batch = np.frombuffer(b'\xff' + data + data + b'\xff', dtype=np.uint8)
    begins = np.array([1, 1 + len(data)])
    read = wire.decode(batch, begins, begins + len(data), type_name, every, len(expected))
    assert (read.invalid, len(read.used)) == (0, 2)
    assert all(same(row, expected) for row in read.values.tolist())


def test_every_type_of_the_contract_is_known() -> None:
    assert not [name for name in TYPES if name not in STORE.fielddefs]


@pytest.mark.parametrize('type_name', [name for name in TYPES if name != TRANSFORMS])
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=strategies.data())
def test_messages_of_rclpy_are_read(type_name: str, data: strategies.DataObject) -> None:
    """With the padding that rclpy adds (uninitialized) and with a shorter one."""
    value = data.draw(message_values(type_name))
    message = serialize_message(filled(type_name, value))
    check(type_name, value, message)
    exact = encoded(type_name, value, 1)
    assert len(message) >= len(exact)
    check(type_name, value, message[: len(exact)])


@pytest.mark.parametrize('type_name', TYPES)
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=strategies.data(), kind=strategies.sampled_from([0, 1, 6, 7]))
def test_both_byte_orders_are_read(type_name: str, data: strategies.DataObject, kind: int) -> None:
    """The options of the encapsulation do not matter, nor does padding to four bytes."""
    value = data.draw(message_values(type_name))
    message = encoded(type_name, value, kind, data.draw(strategies.integers(0, 2**16 - 1)))
    check(type_name, value, message + bytes(data.draw(strategies.integers(0, 3))))


def rejected(type_name: str, data: bytes) -> list[str]:
    """Return the error of each reader of the type."""
    found = []
    with pytest.raises(RecordingError) as error:
        deserialize(BagTopic('/topic', type_name), data)
    found.append(str(error.value))
    readers: list[Any] = []
    if type_name in wire.TYPES:
        readers = [wire.MessageReader(type_name).read, lambda d: wire.Template.of(d, type_name)]
        batch = np.frombuffer(data, dtype=np.uint8)
        ends = np.array([len(data)])
        read = wire.decode(batch, ends * 0, ends, type_name, lambda _template: [-1], 1)
        assert (read.invalid, len(read.used)) == (1, 0)
        found.append(read.fault)
    elif type_name == TEXT:
        readers = [wire.read_string]
    for reader in readers:
        with pytest.raises(MessageError) as fault:
            reader(data)
        found.append(str(fault.value))
    assert not [one for one in found if '\n' in one]
    return found


@pytest.mark.parametrize('type_name', TYPES)
@settings(max_examples=2, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=strategies.data(), little=strategies.booleans())
def test_messages_truncated_anywhere_are_rejected(
    type_name: str, data: strategies.DataObject, little: bool
) -> None:
    value = data.draw(message_values(type_name))
    message = encoded(type_name, value, int(little))
    for size in range(len(message)):
        assert rejected(type_name, message[:size])


@settings(max_examples=5, deadline=None)
@given(value=message_values(MARKER))
def test_truncated_lines_are_rejected(value: Any) -> None:
    """Colors and what follows the points are not read."""
    encoder = Encoder('<', 8)
    for name, field in STORE.fielddefs[MARKER][1]:
        encoder.field(field, value[name])
        if name == 'points':
            break
    message = encoded(MARKER, value, 1)
    for size in range(4 + len(encoder.body)):
        with pytest.raises(MessageError, match=r'which is not CDR|ends after'):
            wire.read_line(message[:size])


@pytest.mark.parametrize('type_name', TYPES)
@pytest.mark.parametrize('kind', [2, 3, 8, 9, 10, 11, 0x0100, 0xFFFF])
def test_other_encapsulations_are_rejected(type_name: str, kind: int) -> None:
    """Parameter lists, XCDR2 with member headers, and unknown kinds."""
    begin = struct.pack('>HH', kind, 0)
    found = rejected(type_name, begin + bytes(400))
    assert all(f'begins with {begin.hex(" ")}' in one for one in found)
    assert all('00 01' in one for one in found)
