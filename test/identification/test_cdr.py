"""Numbers taken from whole batches are those that a deserializer finds message by message."""

from collections.abc import Callable
import struct
from typing import Any

from hypothesis import given, settings, strategies
from needle_ros import cdr
from needle_ros.cdr import Decoded, Layout
import numpy as np
from numpy.testing import assert_array_equal
import pytest
from support.samples import header, MOTION, STORE, WRENCH, wrench

FLOATS = strategies.lists(strategies.floats(), max_size=3)
MESSAGES = strategies.lists(
    strategies.tuples(
        strategies.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1),
        strategies.lists(strategies.text(max_size=5).filter(lambda t: '\0' not in t), max_size=3),
        FLOATS,
        FLOATS,
        strategies.booleans(),
    ),
    min_size=1,
    max_size=40,
)


def decode(
    messages: list[bytes], type_name: str, choice: Callable[..., Any], columns: int
) -> Decoded:
    ends = np.cumsum([len(message) for message in messages])
    begins = ends - [len(message) for message in messages]
    data = np.frombuffer(b''.join(messages), dtype=np.uint8)
    return cdr.decode(data, begins, ends, type_name, choice, columns)


def first_two(layout: Layout) -> list[int]:
    return [begin if length else -1 for begin, length in layout.arrays[:2]]


@settings(max_examples=150, deadline=None)
@given(MESSAGES)
def test_finds_what_rosbags_finds_in_either_byte_order(drawn: list[Any]) -> None:
    serialized, expected = [], []
    for stamp, names, position, velocity, little in drawn:
        message = STORE.types[MOTION](
            header(stamp), names, np.array(position), np.array(velocity), np.array([])
        )
        serialized.append(bytes(STORE.serialize_cdr(message, MOTION, little_endian=little)))
        expected.append([(*part, np.nan)[0] for part in (position, velocity)])
    read = decode(serialized, MOTION, first_two, 2)
    assert read.broken == 0
    assert_array_equal(read.used, np.arange(len(drawn)))
    assert_array_equal(read.values, expected)
    for stamp, data in zip(read.stamps, serialized, strict=True):
        there = STORE.deserialize_cdr(data, MOTION).header.stamp  # type: ignore[attr-defined]
        assert stamp == there.sec * 10**9 + there.nanosec


def test_reads_xcdr2_which_aligns_to_four_bytes() -> None:
    body = struct.pack('<iII', 1, 2, 4) + b'abc\0' + struct.pack('<6d', *range(6))
    read = decode([b'\x00\x07\x00\x00' + body], WRENCH, lambda plan: [plan.arrays[0][0] + 8], 1)
    assert read.broken == 0
    assert read.values == [[1.0]]


@settings(max_examples=200, deadline=None)
@given(strategies.binary(max_size=120), strategies.sampled_from([*cdr.TYPES]))
def test_any_bytes_are_broken_or_have_numbers(data: bytes, type_name: str) -> None:
    for message in (data, b'\x00\x01\x00\x00' + data):
        read = decode([message], type_name, first_two, 2)
        assert read.broken + len(read.used) == 1
        assert bool(read.broken) == bool(read.fault)


@pytest.mark.parametrize('size', range(76))
def test_a_message_cut_anywhere_is_broken(size: int) -> None:
    whole = wrench(10**18, 1.0)
    read = decode([whole[:size], whole], WRENCH, lambda plan: [plan.arrays[0][0] + 8], 1)
    assert (read.broken, *read.used, *read.values) == (1, 1, 1.0)


def test_many_kinds_of_message_are_taken_one_by_one() -> None:
    messages = [
        bytes(
            STORE.serialize_cdr(
                STORE.types[MOTION](
                    header(i), [f'joint {i}'], np.array([float(i)]), np.array([]), np.array([])
                ),
                MOTION,
            )
        )
        for i in range(200)
    ]
    read = decode(messages, MOTION, first_two, 2)
    assert_array_equal(read.values[:, 0], np.arange(200.0))
