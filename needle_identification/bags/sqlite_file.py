# SPDX-License-Identifier: Apache-2.0
"""Read messages of sqlite3 files, also of damaged files."""

from collections.abc import Iterator
from contextlib import closing, ExitStack, suppress
from functools import partial
from itertools import islice
from pathlib import Path
import sqlite3
from tempfile import TemporaryDirectory
from typing import Any, Final
from urllib.parse import quote

from needle_identification.bags.compression import BLOCK, COMPRESSED, factor, open_file, read_up_to
from needle_identification.bags.topics import (
    BagTopic,
    grouped,
    LARGEST_BATCH,
    make_topic,
    MessageBatch,
    Tally,
)
from needle_identification.errors import RecordingError

_TABLES: Final = ('messages', 'topics', 'message_definitions')

_ROW: Final = 16  # size of a row in addition to its data [bytes]
_STEPS: Final = 10**8  # limit of SQLite steps; a message of 40 bytes takes 20 to 40
_STEPS_PER_BYTE: Final = 20  # additional steps per byte of the file
_STEPS_PER_CALL: Final = 10**5  # steps between two checks


def sqlite_batches(file: Path, tally: Tally) -> Iterator[MessageBatch]:
    """Read a ``.db3`` file; raise sqlite3.Error after the messages before a damaged part."""
    with ExitStack() as stack:
        if file.suffix in COMPRESSED:
            folder = stack.enter_context(TemporaryDirectory())
            unfolded = Path(folder, file.stem)
            with open_file(file, tally.budget) as stream, unfolded.open('wb') as copy:
                while part := read_up_to(stream, BLOCK):
                    copy.write(part)
            file = unfolded
        # An unmerged journal contains the end of the recording.
        journal = file.with_name(f'{file.name}-wal').exists()
        uri = f'file:{quote(str(file.resolve()))}?{"mode=ro" if journal else "immutable=1"}'
        database = stack.enter_context(closing(sqlite3.connect(uri, uri=True)))
        database.text_factory = bytes
        database.row_factory = partial(_counted, tally)
        # Without it, a truncated file (missing index) is not readable.
        database.execute('PRAGMA writable_schema = ON')
        _bound(database, tally.budget.size, tally)
        yield from _rows(database, tally)


def _counted(tally: Tally, _cursor: object, row: tuple[Any, ...]) -> tuple[Any, ...]:
    """Count a row when it is read: rows may share bytes of the file."""
    tally.budget.spend(_ROW + sum([len(value) for value in row if isinstance(value, bytes)]), 1)
    return row


def _bound(database: sqlite3.Connection, size: int, tally: Tally) -> None:
    """Limit the duration of queries by the file size, and reject computed tables and columns."""
    steps = _STEPS + size * _STEPS_PER_BYTE
    calls = iter(range(int(factor() * steps) // _STEPS_PER_CALL))
    # A value other than None or 0 ends the query.
    database.set_progress_handler(lambda: next(calls, None) is None, _STEPS_PER_CALL)
    if hasattr(database, 'setlimit'):
        # Python 3.11 or newer.
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, tally.budget.largest)
    for kind, name in database.execute('SELECT type, name FROM sqlite_master').fetchall():
        if _text(name) not in _TABLES:
            continue
        # A view or a computed column may not terminate.
        columns = database.execute(f'PRAGMA table_xinfo("{_text(name)}")').fetchall()
        if _text(kind) != 'table' or any(hidden for *_, hidden in columns):
            raise RecordingError(
                f'{tally.budget.name}: {_text(name)} is not a plain table, and is not read'
            )


def _topics(database: sqlite3.Connection) -> dict[int, BagTopic]:
    definitions: dict[Any, list[Any]] = {}
    with suppress(sqlite3.Error):
        # Older recordings lack this table.
        query = 'SELECT topic_type, encoding, encoded_message_definition FROM message_definitions'
        definitions = {name: own for name, *own in database.execute(query)}
    profiles: dict[Any, Any] = {}
    with suppress(sqlite3.Error):
        # The oldest recordings lack this column.
        profiles.update(database.execute('SELECT id, offered_qos_profiles FROM topics'))
    topics = {}
    query = 'SELECT id, name, type, serialization_format FROM topics'
    for key, name, kind, form in database.execute(query):
        encoding, definition = definitions.get(kind, ('', ''))
        words = map(_text, (name, kind, form, encoding, definition, profiles.get(key, '')))
        if isinstance(key, int):
            topics[key] = make_topic(*words)
    return topics


def _rows(database: sqlite3.Connection, tally: Tally) -> Iterator[MessageBatch]:
    """Yield the messages of a database up to its first damaged part."""
    topics = _topics(database)
    wanted = ', '.join(str(key) for key, topic in topics.items() if tally.wanted(topic))
    # Load only the data of selected topics, not images.
    rows = database.execute(
        f'SELECT topic_id, timestamp, CASE WHEN topic_id IN ({wanted}) THEN data END FROM messages'  # noqa: S608
    )
    fault = None
    while fault is None:
        some: list[tuple[int, int, bytes]] = []
        try:
            some.extend(islice(rows, LARGEST_BATCH))
        except sqlite3.Error as error:
            # Rows before the fault are valid.
            fault = error
        if not some:
            break
        tally.piece += 1
        for key, group in grouped(some).items():
            if tally.enter(topics.get(key), len(group)):
                times, parts = zip(*group, strict=True)
                yield MessageBatch.of_times(topics[key], times, parts).decompressed(tally.budget)
    if fault is not None:
        raise fault


def _text(value: Any) -> str:
    return value.decode(errors='replace') if isinstance(value, bytes) else str(value)
