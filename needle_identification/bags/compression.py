"""Compressed files and messages (zstd, lz4), also where their end is missing."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
import struct
from typing import Any, Final

import lz4.frame
import zstandard

#: Endings of compressed files.
COMPRESSED: Final = ('.zstd', '.zst', '.lz4')

#: Bytes that are read at a time.
BLOCK: Final = 2**20

#: What readers raise at damaged bytes.
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
    """
    Open a file for reading.

    Parameters
    ----------
    file : Path
        A file, compressed or not.

    Returns
    -------
    binary stream
        Its decompressed content.

    """
    if file.suffix == '.lz4':
        archive = lz4.frame.LZ4FrameFile(file)
        # Where the end is missing, read would lose what there is.
        archive.read = archive.read1
        return archive
    stream = file.open('rb')
    return _zstd_stream(stream) if file.suffix in COMPRESSED else stream


def read_up_to(stream: Any, length: int) -> bytes:
    """
    Read bytes from a stream.

    Parameters
    ----------
    stream : binary stream
        Stream to read.
    length : int
        Number of bytes.

    Returns
    -------
    bytes
        That many bytes, fewer only at the end of the stream.

    """
    parts = []
    with suppress(EOFError):
        while length > 0 and (part := stream.read(min(length, BLOCK))):
            parts.append(part)
            length -= len(part)
    return parts[0] if len(parts) == 1 else b''.join(parts)


def decompress(compression: str, data: bytes, size: int) -> bytes:
    """
    Decompress data.

    Parameters
    ----------
    compression : str
        ``zstd``, ``lz4``, or '' for none.
    data : bytes
        Compressed data; their end may be missing.
    size : int
        Largest number of bytes to return.

    Returns
    -------
    bytes
        As much as the data hold.

    Raises
    ------
    ValueError
        If the compression is unknown.

    """
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
