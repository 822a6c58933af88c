# SPDX-License-Identifier: Apache-2.0
"""Provenance of an identified result: recordings, files, settings and losses."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

from needle_insertion.progress import ProgressLine
from needle_ros.errors import NeedleError

_CLOCKS: Final = 'the clock of the force was {:+.2f} ms off the clock of the motion; corrected'
_PIECE: Final = 1 << 20  #: block size for reading a file [bytes]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingSource:
    """Recording of a result."""

    name: str
    losses: tuple[str, ...]  #: lost, discarded or corrected data
    #: Stamps of the force minus stamps of the motion [s], already corrected.
    clock_offset: float
    samples: int
    files: tuple[tuple[str, str], ...]  #: paths and SHA-256


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """Recordings and settings of a result."""

    settings: Any
    reading: Mapping[str, Any]  #: options of the reader; None for automatic selection by type
    #: Written parameter file, if any.
    result: Path | None
    sources: Sequence[RecordingSource] = ()
    failures: Sequence[tuple[str, str]] = ()  #: unusable recordings with reason
    #: Recordings with the same samples as another, with its name; used once.
    copies: Sequence[tuple[str, str]] = ()

    @property
    def failed(self) -> list[str]:
        return [why if name in why else f'{name}: {why}' for name, why in self.failures]

    @property
    def losses(self) -> list[str]:
        return [f'{name}: {words}' for name, words in self.lost]

    @property
    def lost(self) -> list[tuple[str, str]]:
        """Recordings with a message for each loss or correction."""
        return [
            *((name, f'the same samples as {other}: counts once') for name, other in self.copies),
            *((one.name, words) for one in self.sources for words in one.losses),
            *(
                (one.name, _CLOCKS.format(1e3 * one.clock_offset))
                for one in self.sources
                if one.clock_offset
            ),
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


def _worded(value: Any, unit: str) -> str:
    if value is None:
        return 'found by type'
    if isinstance(value, (list, tuple)):
        return ', '.join(map(str, value))
    return f'{value:g} {unit}'.removesuffix(' 1') if isinstance(value, float) else str(value)


def identify_all(
    bags: Sequence[Path],
    read: Callable[[Path], Any],
    identify: Callable[[Any], Any],
    origin: Origin,
    *,
    digest: bool,
) -> tuple[list[Any], Origin]:
    """Identify recordings except copies and unusable ones; return estimates and origin."""
    estimates, sources, failures, copies = [], [], [], []
    known: dict[bytes, str] = {}
    with ProgressLine('identification', brief=True) as show:
        for number, bag in enumerate(bags, 1):
            show(f'recording {number} of {len(bags)}')
            recording = None
            try:
                recording = read(bag)
                if recording.digest in known:
                    copies.append((recording.name, known[recording.digest]))
                    continue
                known[recording.digest] = recording.name
                estimates.append(identify(recording))
            except (NeedleError, OSError) as error:
                # What was corrected or assumed may be the cause.
                assumed = () if recording is None else recording.losses
                failures.append((str(bag), '; '.join([str(error), *assumed])))
                continue
            kept = {name: getattr(recording, name) for name in ('name', 'losses', 'clock_offset')}
            files = _digests(bag) if digest else ()
            sources.append(RecordingSource(**kept, samples=len(recording.time), files=files))
    return estimates, replace(
        origin, sources=tuple(sources), failures=tuple(failures), copies=tuple(copies)
    )


def _digests(bag: Path) -> tuple[tuple[str, str], ...]:
    files = sorted(path for path in bag.iterdir() if path.is_file()) if bag.is_dir() else [bag]
    found = []
    for path in files:
        digest = sha256()
        with path.open('rb') as stream:
            while piece := stream.read(_PIECE):
                digest.update(piece)
        found.append((str(path), digest.hexdigest()))
    return tuple(found)
