# SPDX-License-Identifier: Apache-2.0
"""List the files of a bag."""

from pathlib import Path
import re
from typing import Final

from needle_identification.bags.compression import COMPRESSED
from needle_identification.errors import RecordingError
from needle_ros.documents import DocumentError, LARGEST, read_document
from needle_ros.errors import printable

METADATA: Final = 'metadata.yaml'  #: lists the other files, written at the end
LOST: Final = 'messages lost'  #: key of the metadata for the messages that the recorder lost

_FORMS: Final = ('.mcap', '.db3', '.bag')

_VALID: Final = 'valid: a rosbag2 folder, an .mcap or a .db3 file, or a .bag file of ROS 1'


def form_of(file: Path) -> str:
    """Return the storage format by file name: ``.mcap``, ``.db3``, ``.bag`` (ROS 1), or ''."""
    suffix = _uncompressed(file).suffix
    return suffix if suffix in _FORMS else ''


def _uncompressed(file: Path) -> Path:
    return file.with_suffix('') if file.suffix in COMPRESSED else file


def files_of(path: Path) -> tuple[list[Path], list[str]]:
    """List the files of a bag in the order of recording, and its missing or foreign files."""
    if not path.exists():
        raise RecordingError(f'{path} does not exist; {_VALID}')
    if path.is_file():
        if not form_of(path):
            raise RecordingError(f'{path} is not a recording; {_VALID}')
        return [path], []
    # Sort part_10 after part_9.
    inside = path.iterdir() if path.is_dir() else ()
    found = sorted(filter(Path.is_file, inside), key=lambda file: [len(file.name), file.name])
    by_form = {form: [file for file in found if form_of(file) == form] for form in _FORMS}
    chosen = next(filter(None, by_form.values()), [])
    if not chosen:
        other = min(path.glob(f'*/{METADATA}'), default=None)
        hint = _VALID if other is None else f'name those inside, such as {other.parent}'
        raise RecordingError(f'{path} holds no recording; {hint}')
    names, losses = None, [f'no readable {METADATA}: the recording was not closed']
    try:
        names, lost = _metadata(path)
    except DocumentError as error:
        losses = [f'{METADATA} {error}']
    except (OSError, UnicodeDecodeError, KeyError, TypeError):
        # Missing, or of an unknown structure.
        pass
    if names is None:
        # The parts of one recording differ only in a number at the end of the name.
        if len({re.sub(r'_\d+$', '', _uncompressed(file).stem) for file in chosen}) > 1:
            raise RecordingError(
                f'{path} holds several recordings; name them, such as {chosen[0]}; {losses[0]}'
            )
        return chosen, losses
    there = {file.name for file in chosen}
    losses = [f'the recorder lost {lost}'] if lost else []
    losses += [f'{name} is missing' for name in names if name not in there]
    if there.isdisjoint(names):
        return chosen, losses
    losses += [
        f'{file.name} is not part of the recording by {METADATA}, left out'
        for file in chosen
        if file.name not in names
    ]
    return [path / name for name in names if name in there], losses


def _metadata(folder: Path) -> tuple[list[str], str]:
    """Return the files listed in the metadata of a bag, and its lost messages."""
    with (folder / METADATA).open(encoding='utf-8') as stream:
        document = read_document(stream.read(LARGEST + 1))
    information = document['rosbag2_bagfile_information']
    paths = information['relative_file_paths']
    if not isinstance(paths, list):
        raise TypeError('relative_file_paths is not a list')
    own = information.get('custom_data') or {}
    lost = printable(str(own.get(LOST, ''))) if isinstance(own, dict) else ''
    return list(dict.fromkeys(Path(str(name)).name for name in paths)), lost
