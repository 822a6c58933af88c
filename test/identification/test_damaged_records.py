# SPDX-License-Identifier: Apache-2.0
"""Damaged bytes in an MCAP file without checksums lose only the records that they touch."""

from pathlib import Path
import re
import struct

from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer
from needle_identification import Bag
from needle_identification.bags.bag import read_topic
import pytest
from support.samples import EPOCH, TEXT, text

COUNT, DAMAGE = 40, 20


def write(file: Path, *, chunked: bool) -> list[tuple[int, int]]:
    """Write messages without checksums; return the positions of their records."""
    with file.open('wb') as stream:
        writer = Writer(
            stream, use_chunking=chunked, enable_crcs=False, compression=CompressionType.NONE
        )
        writer.start('ros2')
        schema = writer.register_schema(TEXT, 'ros2msg', b'string data')
        channel = writer.register_channel('/a', 'cdr', schema)
        for i in range(COUNT):
            writer.add_message(channel, EPOCH + i, text(f'message {i}'), EPOCH + i)
        writer.finish()
    content = file.read_bytes()
    spans, at = [], content.index(struct.pack('<BQ', Opcode.MESSAGE, 22 + len(text('message 0'))))
    for _ in range(COUNT):
        _, length = struct.unpack_from('<BQ', content, at)
        spans.append((at, at + 9 + length))
        at = spans[-1][1]
    return spans


@pytest.mark.parametrize('chunked', [False, True])
def test_only_damaged_records_and_the_record_before_are_lost(
    tmp_path: Path, chunked: bool
) -> None:
    """The damage is reported with the number of written messages, wherever it is."""
    file = tmp_path / 'run.mcap'
    spans = write(file, chunked=chunked)
    whole = file.read_bytes()
    for begin in range(spans[0][0] + 1, spans[-1][1] - DAMAGE, 3):
        end = begin + DAMAGE
        wrong = bytearray(whole)
        wrong[begin:end] = bytes(byte ^ 0x7F for byte in wrong[begin:end])
        file.write_bytes(wrong)
        hit = [i for i, (first, after) in enumerate(spans) if first < end and begin < after]
        intact = [text(f'message {i}') for i in range(COUNT) if i not in (*hit, hit[0] - 1)]
        bag = Bag(file)
        batches = bag.batches(lambda _topic: True)
        found = [data for batch in batches for _, data in batch.messages()]
        assert [data for data in found if data in intact] == intact
        # If a head is hit, an altered message before it is lost, too.
        if any(first < end and begin < first + 9 for first, _ in spans):
            before = text(f'message {hit[0] - 1}')
            assert [data for data in found if data != before] == intact
            (loss,) = bag.losses
            # The last record has none after it.
            fault = (
                r'has lost messages|is damaged: .*' if hit == [COUNT - 1] else r'is damaged: .*'
            )
            count = rf'{len(found)} of {COUNT} messages read'
            assert re.fullmatch(rf'run.mcap ({fault}); {count}', loss)


def test_a_record_after_zeros_is_found(tmp_path: Path) -> None:
    """A block of a file that the disk has not stored is zero."""
    file = tmp_path / 'run.mcap'
    spans = write(file, chunked=False)
    whole = file.read_bytes()
    begin = spans[20][0]
    file.write_bytes(whole[:begin] + bytes(2**21) + whole[begin:])
    found = [message.data for _, message in read_topic(file, '/a')]
    assert found == [f'message {i}' for i in range(COUNT) if i != 19]
