"""Decompress files and messages (zstd, lz4), also truncated data."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
import struct
from typing import Any, Final

import lz4.frame
import zstandard

#: File name suffixes of compressed files.
COMPRESSED: Final = ('.zstd', '.zst', '.lz4')

#: Block size of reads [bytes].
BLOCK: Final = 2**20

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


def open_file(file: Path) -> Any:
    """Open a file, compressed or not, as a binary stream of its decompressed content."""
    if file.suffix == '.lz4':
        archive = lz4.frame.LZ4FrameFile(file)
        # `read` would discard the last data of a truncated file.
        archive.read = archive.read1
        return archive
    stream = file.open('rb')
    return _zstd_stream(stream) if file.suffix in COMPRESSED else stream


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
