# SPDX-License-Identifier: Apache-2.0
"""Decompress files and messages (zstd, lz4), also truncated data, within limits of their size."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from math import isfinite
import os
from pathlib import Path
import struct
from typing import Any, Final

import lz4.frame
from needle_identification.errors import RecordingError
import zstandard

COMPRESSED: Final = ('.zstd', '.zst', '.lz4')  #: file name suffixes of compressed files
BLOCK: Final = 2**20  #: block size of reads [bytes]

#: Exceptions of the readers for damaged bytes.
DAMAGED: Final = (
    RuntimeError,
    zstandard.ZstdError,
    struct.error,
    AssertionError,
    KeyError,
    MemoryError,
    OverflowError,
    TypeError,
    ValueError,
)

FACTOR: Final = 'NEEDLE_BAG_FACTOR'  #: environment variable: factor of all limits of this module
LARGEST_RECORD: Final = 2**27  #: largest record or chunk [bytes]
LARGEST_MESSAGE: Final = 2**26  #: largest message that was compressed individually [bytes]
_AT_LEAST: Final = 2**28  # decompressed size allowed for any file [bytes]
_RATIO: Final = 50  # decompressed size allowed per byte of a file
_RECORDS: Final = 2**18  # records allowed for any file, else one per byte
COSTLY: Final = 8  #: number of records as which a chunk, a definition, an index counts


@contextmanager
def open_file(file: Path, budget: Budget) -> Iterator[Any]:
    """Open the decompressed content of a file as a binary stream; count each byte read."""
    stream: Any
    if file.suffix == '.lz4':
        stream = lz4.frame.LZ4FrameFile(file)
        # `read` would discard the last data of a truncated file.
        stream.read = stream.read1
    else:
        stream = file.open('rb')
        if file.suffix in COMPRESSED:
            stream = _zstd_stream(stream)
    with closing(stream):
        yield _Metered(stream, budget)


def read_up_to(stream: Any, length: int) -> bytes:
    """Read `length` bytes from a binary stream; fewer only at its end."""
    parts = []
    with suppress(EOFError):
        while length > 0 and (part := stream.read(min(length, BLOCK))):
            parts.append(part)
            length -= len(part)
    return parts[0] if len(parts) == 1 else b''.join(parts)


def decompress(compression: str, data: bytes, size: int) -> bytes:
    """Decompress data (``zstd``, ``lz4`` or '') up to `size` bytes, also if truncated."""
    if compression == 'zstd':
        with _zstd_stream(data) as stream:
            return read_up_to(stream, size)
    if compression == 'lz4':
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size))
    if compression:
        raise ValueError(f'compression {compression!r} is not zstd or lz4')
    return data


def _zstd_stream(source: Any) -> Any:
    return zstandard.ZstdDecompressor().stream_reader(source, read_across_frames=True)


def factor() -> float:
    """Return the positive factor of all limits, `FACTOR` of the environment or 1."""
    text = os.environ.get(FACTOR, '1')
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not (isfinite(value) and value > 0.0):
        raise RecordingError(f'{FACTOR} must be a positive number, got {text!r}')
    return value


class Budget:
    """Remaining decompressed size and records of a file; largest record and message [bytes]."""

    def __init__(self, file: Path) -> None:
        times = factor()
        self.name, self.size = file.name, file.stat().st_size
        self._most = self._left = round(times * max(_AT_LEAST, _RATIO * self.size))
        most = round(times * max(_RECORDS, self.size))
        self._most_records = self._records_left = most
        self.largest = round(times * LARGEST_RECORD)
        self.largest_message = round(times * LARGEST_MESSAGE)

    def spend(self, number: int, records: int = 0) -> None:
        """Count decompressed bytes and records; raise a RecordingError above a limit."""
        self._left -= number
        self._records_left -= records
        if self._left < 0 or self._records_left < 0:
            most = _bytes(self._most) if self._left < 0 else f'{self._most_records} records'
            raise RecordingError(
                f'{self.name} unfolds to more than {most} from {_bytes(self.size)}; {FACTOR}=10 '
                'raises this limit tenfold'
            )

    def too_large(self, what: str, size: int) -> str:
        return (
            f'a {what} of {size} bytes, at most {_bytes(self.largest)} are read; {FACTOR}=10 '
            'raises this limit tenfold'
        )


class _Metered:
    def __init__(self, stream: Any, budget: Budget) -> None:
        self._stream, self._budget = stream, budget

    def read(self, size: int) -> bytes:
        part: bytes = self._stream.read(size)
        self._budget.spend(len(part))
        return part


def _bytes(number: int) -> str:
    return f'{number / 2**20:.0f} MB' if number >= 2**20 else f'{number / 2**10:.1f} kB'
