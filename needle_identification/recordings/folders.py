# SPDX-License-Identifier: Apache-2.0
"""Find the recordings in a folder: bags, single data files, and tables."""

from contextlib import suppress
from pathlib import Path

from needle_identification.bags.bag import form_of, METADATA, recordings_among
from needle_identification.errors import RecordingError
from needle_identification.recordings.tables import is_table


def recordings_in(path: Path) -> list[Path]:
    """
    Return the bags, data files and tables in a folder that is no bag itself, else the path.

    Without metadata, a folder with the files of one recording and no other is a bag.
    """
    return _recordings_in(path, set())


def _recordings_in(path: Path, seen: set[Path]) -> list[Path]:
    # A link may lead to a folder above itself.
    seen.add(path.resolve())
    inside = [one for one in _inside(path) if not one.is_dir() or one.resolve() not in seen]
    if any(one.name == METADATA for one in inside):
        return [path]
    groups = recordings_among(one for one in inside if form_of(one) and one.is_file())
    found = [one for one in inside if is_table(one)]
    for folder in filter(_has_bag, inside):
        if folder.resolve() not in seen:
            found += _recordings_in(folder, seen)
    if len(groups) == 1 and not found:
        return [path]
    for group in groups:
        if len(group) > 1:
            raise RecordingError(
                f'{path} holds other recordings besides {group[0].name} to {group[-1].name}, the '
                f'parts of one recording: move these parts to a folder of their own'
            )
        found += group
    return sorted(found) or [path]


def _has_bag(folder: Path) -> bool:
    """Whether a folder has files of a bag, also of one that was not closed."""
    return any(form_of(one) or one.name == METADATA for one in _inside(folder) if one.is_file())


def _inside(folder: Path) -> list[Path]:
    # A folder that cannot be read is reported when it is read as a recording.
    with suppress(OSError):
        return sorted(folder.iterdir()) if folder.is_dir() else []
    return []
