# SPDX-License-Identifier: Apache-2.0
"""Atomic writing of files."""

from contextlib import suppress
import os
from pathlib import Path

from needle_ros.errors import ParameterError


def write_whole(path: Path | str, content: bytes) -> None:
    """Write a file atomically: a reader sees the old or the new content, never a part."""
    path = Path(path)
    if not path.name or path.is_dir():
        raise ParameterError(f'{path} cannot be written: it is not the name of a file')
    draft = path.with_name(f'{path.name}.{os.getpid()}.tmp')
    try:
        draft.write_bytes(content)
        draft.replace(path)
    except OSError as error:
        with suppress(OSError):
            draft.unlink()
        raise ParameterError(f'{path} cannot be written: {error.strerror}') from error
