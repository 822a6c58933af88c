# SPDX-License-Identifier: Apache-2.0
"""Parsing and serialization of CDR messages, compared with rosbags."""

from __future__ import annotations

from collections.abc import Sequence
import struct

from hypothesis import given, settings, strategies
from needle_ros import wire
from needle_ros.errors import MessageError, ShapeError
from needle_ros.wire import Template
import numpy as np
from numpy.testing import assert_array_equal
import pytest
from support.samples import header, MOTION, STORE, WRENCH, wrench

STAMPS = strategies.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1)
TEXTS = strategies.text(max_size=5).filter(lambda text: '\0' not in text)
FLOATS = strategies.lists(strategies.floats(), max_size=3)
MESSAGES = strategies.lists(
    strategies.tuples(
        STAMPS, strategies.lists(TEXTS, max_size=3), FLOATS, FLOATS, strategies.booleans()
    ),
    min_size=1,
    max_size=40,
)


def joint_state(
    stamp: int,
    names: Sequence[str],
    position: Sequence[float] = (),
    velocity: Sequence[float] = (),
    *,
    little_endian: bool = True,
) -> bytes:
    """Serialize a JointState without efforts by rosbags."""
    arrays = (np.array(values, dtype=float) for values in (position, velocity, ()))
    message = STORE.types[MOTION](header(stamp), list(names), *arrays)
    return bytes(STORE.serialize_cdr(message, MOTION, little_endian=little_endian))


def decode(
    messages: Sequence[bytes], type_name: str, choice: wire.Choice, columns: int
) -> wire.Decoded:
    ends = np.cumsum([len(message) for message in messages])
    begins = ends - [len(message) for message in messages]
    data = np.frombuffer(b''.join(messages), dtype=np.uint8)
    return wire.decode(data, begins, ends, type_name, choice, columns)


def first_two(template: Template) -> list[int]:
    """Select the first number of the first two arrays."""
    return [begin if length else -1 for begin, length in template.arrays[:2]]


def second(template: Template) -> list[int]:
    """Select the second number of the first array."""
    return [template.arrays[0][0] + 8]


@settings(max_examples=150, deadline=None)
@given(MESSAGES)
def test_batch_values_equal_rosbags_values(
    drawn: list[tuple[int, list[str], list[float], list[float], bool]],
) -> None:
    """Both byte orders, any names and array lengths."""
    serialized, expected = [], []
    for stamp, names, position, velocity, little in drawn:
        serialized.append(joint_state(stamp, names, position, velocity, little_endian=little))
        expected.append([(*part, np.nan)[0] for part in (position, velocity)])
    read = decode(serialized, MOTION, first_two, 2)
    assert read.invalid == 0
    assert_array_equal(read.used, np.arange(len(drawn)))
    assert_array_equal(read.values, expected)
    for stamp, message in zip(read.stamps, serialized, strict=True):
        there = STORE.deserialize_cdr(message, MOTION).header.stamp  # type: ignore[attr-defined]
        assert stamp == there.sec * 10**9 + there.nanosec


@settings(max_examples=150, deadline=None)
@given(STAMPS, strategies.lists(TEXTS, max_size=3), FLOATS, FLOATS, strategies.booleans())
def test_template_round_trip_matches_rosbags(
    stamp: int, names: list[str], position: list[float], velocity: list[float], little: bool
) -> None:
    """The template of a message and a template from its description write the same bytes."""
    message = joint_state(stamp, names, position, velocity, little_endian=little)
    template = Template.of(message, MOTION)
    reading = template.read(message)
    assert reading is not None
    assert reading[:3] == (stamp, 'needle_base', tuple(names))
    assert_array_equal(np.concatenate(reading.values), [*position, *velocity])
    for k, name in enumerate(names):
        if name not in names[:k]:
            given_values = [one[k] if k < len(one) else np.nan for one in (position, velocity, ())]
            assert_array_equal(reading.joint(name), given_values)
    assert reading.joint('a name of more than five characters') is None
    assert template.serialize(stamp, *position, *velocity) == message
    if little:
        counts = len(position), len(velocity), 0
        made = Template(MOTION, 'needle_base', names=names, counts=counts)
        assert made.serialize(stamp, *position, *velocity) == message


DESCRIPTIONS = strategies.tuples(
    TEXTS, strategies.lists(TEXTS, max_size=3), strategies.tuples(*[strategies.integers(0, 3)] * 3)
)


@given(DESCRIPTIONS, DESCRIPTIONS, STAMPS)
def test_template_rejects_other_frames_joints_and_lengths(
    one: tuple[str, list[str], tuple[int, int, int]],
    other: tuple[str, list[str], tuple[int, int, int]],
    stamp: int,
) -> None:
    frame, names, counts = other
    data = Template(MOTION, frame, names=names, counts=counts).serialize(
        stamp, *[0.5] * sum(counts)
    )
    reading = Template(MOTION, one[0], names=one[1], counts=one[2]).read(data)
    assert (reading is not None) == (one == other)


@pytest.mark.parametrize('length', [0, 3, 12, 75])
def test_template_rejects_truncated_messages(length: int) -> None:
    """Additional bytes and encapsulation options are ignored."""
    template = Template(WRENCH, 'needle_base')
    data = template.serialize(1, *[0.5] * 6)
    reading = template.read(data)
    assert len(data) == 76
    assert reading is not None
    assert reading.values == ((0.5,) * 6,)
    assert template.read(data[:length]) is None
    assert template.read(data + b'\0') == reading
    assert template.read(data[:2] + b'\0\3' + data[4:]) == reading


@pytest.mark.parametrize('count', [0, 5, 7])
def test_wrong_number_of_values_is_rejected(count: int) -> None:
    """The next message is serialized correctly."""
    template = Template(WRENCH, 'needle_base')
    with pytest.raises(ShapeError, match=f'has 6 values, got {count}'):
        template.serialize(1, *[0.5] * count)
    reading = template.read(template.serialize(1, *[0.5] * 6))
    assert reading is not None
    assert reading.values == ((0.5,) * 6,)


def test_xcdr2_aligns_to_four_bytes() -> None:
    """Batch and single message give the same numbers."""
    body = struct.pack('<iII', 1, 2, 4) + b'abc\0' + struct.pack('<6d', *range(6))
    message = b'\x00\x07\x00\x00' + body
    read = decode([message], WRENCH, second, 1)
    assert read.invalid == 0
    assert read.values == [[1.0]]
    reading = Template.of(message, WRENCH).read(message)
    assert reading == (1_000_000_002, 'abc', (), (tuple(map(float, range(6))),))


@settings(max_examples=200, deadline=None)
@given(strategies.binary(max_size=120), strategies.sampled_from([*wire.TYPES]))
def test_random_bytes_are_valid_or_counted_as_invalid(data: bytes, type_name: str) -> None:
    """No other error is raised, and an invalid message has a reason."""
    for message in (data, b'\x00\x01\x00\x00' + data):
        read = decode([message], type_name, first_two, 2)
        assert read.invalid + len(read.used) == 1
        assert bool(read.invalid) == bool(read.fault)


@pytest.mark.parametrize('size', range(76))
def test_truncated_message_is_invalid(size: int) -> None:
    """The next message is parsed."""
    whole = wrench(10**18, 1.0)
    read = decode([whole[:size], whole], WRENCH, second, 1)
    assert (read.invalid, *read.used, *read.values) == (1, 1, 1.0)
    with pytest.raises(MessageError, match=r'not CDR|ends after'):
        Template.of(whole[:size], WRENCH)


def test_trailing_bytes_are_invalid() -> None:
    """Up to three bytes are accepted as padding."""
    whole = wrench(10**18, 1.0)
    assert Template.of(whole + bytes(3), WRENCH).read(whole + bytes(3)) is not None
    with pytest.raises(MessageError, match='has 80 bytes, 76 expected'):
        Template.of(whole + bytes(4), WRENCH)


def test_batch_with_many_templates() -> None:
    """Each message has a different joint name."""
    messages = [joint_state(i, [f'joint {i}'], [float(i)]) for i in range(200)]
    read = decode(messages, MOTION, first_two, 2)
    assert_array_equal(read.values[:, 0], np.arange(200.0))


def test_unselected_messages_are_skipped() -> None:
    """They count neither as used nor as invalid."""
    read = decode([wrench(1, 1.0)], WRENCH, lambda _template: None, 2)
    assert (len(read.used), read.invalid) == (0, 0)
