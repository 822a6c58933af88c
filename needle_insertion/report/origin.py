"""What a result was identified from: recordings, files, settings, and what was lost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

#: Bytes of a file that are read at once.
_PIECE: Final = 1 << 20


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """
    One recording.

    Attributes
    ----------
    name : str
        The recording.
    losses : tuple of str
        What was lost, left out or repaired in reading, in words.
    clock_offset : float
        Stamps of the force minus those of the motion [s], already corrected.
    samples : int
        Samples of force and motion.
    files : tuple of (str, str)
        Paths and SHA-256 of its files.

    """

    name: str
    losses: tuple[str, ...]
    clock_offset: float
    samples: int
    files: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """
    Recordings and settings behind a result.

    Attributes
    ----------
    settings : object
        The dataclass with the settings.
    reading : Mapping[str, Any]
        Options of reading; None stands for what is found by type.
    result : Path or None
        The parameter file, if one is written.
    sources : sequence of Source
        The recordings.
    failures : sequence of (str, str)
        Recordings that could not be used, and why.

    """

    settings: Any
    reading: Mapping[str, Any]
    result: Path | None
    sources: Sequence[Source] = ()
    failures: Sequence[tuple[str, str]] = ()

    @property
    def failed(self) -> list[str]:
        """Recordings that could not be used, in words."""
        return [with_name(name, reason) for name, reason in self.failures]

    @property
    def losses(self) -> list[str]:
        """What was lost or corrected in reading, in words."""
        lost = [f'{one.name}: {words}' for one in self.sources for words in one.losses]
        return lost + [
            f'{one.name}: the clock of the force was {1e3 * one.clock_offset:+.2f} ms off the '
            'clock of the motion; corrected'
            for one in self.sources
            if one.clock_offset
        ]

    @property
    def setting_rows(self) -> list[tuple[str, str, str]]:
        """Name, value and meaning of each setting."""
        rows = [
            (
                item.name.replace('_', ' '),
                _worded(getattr(self.settings, item.name), item.metadata.get('unit', '')),
                item.metadata.get('description', ''),
            )
            for item in fields(self.settings)
        ]
        return rows + [
            (name.replace('_', ' '), _worded(value, ''), '')
            for name, value in self.reading.items()
        ]

    @property
    def file_rows(self) -> list[tuple[str, str, str]]:
        """Path, samples of the recording, and SHA-256 of each file."""
        return [
            (path, f'{one.samples}', digest) for one in self.sources for path, digest in one.files
        ]


def with_name(name: str, reason: str) -> str:
    """
    Return why a recording could not be used, with its name.

    Parameters
    ----------
    name, reason : str
        The recording, and a message that may name it already.

    Returns
    -------
    str
        One line.

    """
    return reason if name in reason else f'{name}: {reason}'


def _worded(value: Any, unit: str) -> str:
    if value is None:
        return 'found by type'
    if isinstance(value, (list, tuple)):
        return ', '.join(map(str, value))
    return f'{value:g} {unit}'.removesuffix(' 1') if isinstance(value, float) else str(value)


def digests(bag: Path) -> tuple[tuple[str, str], ...]:
    """
    Return the files of a recording with their checksums.

    Parameters
    ----------
    bag : Path
        A file, or a folder of files.

    Returns
    -------
    tuple of (str, str)
        Path and SHA-256 of each.

    """
    files = sorted(path for path in bag.iterdir() if path.is_file()) if bag.is_dir() else [bag]
    found = []
    for path in files:
        digest = sha256()
        with path.open('rb') as stream:
            while piece := stream.read(_PIECE):
                digest.update(piece)
        found.append((str(path), digest.hexdigest()))
    return tuple(found)
