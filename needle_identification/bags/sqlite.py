"""Messages from sqlite3 files, damaged ones as far as they go."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, ExitStack, suppress
from itertools import islice
from pathlib import Path
import sqlite3
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote

from needle_identification.bags.storage import (
    Batch,
    BLOCK,
    COMPRESSED,
    joined,
    LATEST,
    MOST,
    opened,
    taken,
    Tally,
    topic_of,
)
import numpy as np


def sqlite_batches(file: Path, tally: Tally) -> Iterator[Batch]:
    """Yield the messages in a file that may be compressed; sqlite3.Error if it breaks off."""
    with ExitStack() as stack:
        if file.suffix in COMPRESSED:
            folder = stack.enter_context(TemporaryDirectory())
            with opened(file) as stream, Path(folder, file.stem).open('wb') as copy:
                while part := taken(stream, BLOCK):
                    copy.write(part)
            file = Path(folder, file.stem)
        # A journal that was not merged into the file holds the end of a recording.
        journal = file.with_name(f'{file.name}-wal').exists()
        uri = f'file:{quote(str(file.resolve()))}?{"mode=ro" if journal else "immutable=1"}'
        database = stack.enter_context(closing(sqlite3.connect(uri, uri=True)))
        database.text_factory = bytes
        yield from _rows(database, tally)


def _rows(database: sqlite3.Connection, tally: Tally) -> Iterator[Batch]:
    """Yield the messages in a database, a damaged one as far as it goes."""
    # Otherwise nothing is read of a file whose end, with an index, is missing.
    database.execute('PRAGMA writable_schema = ON')
    definitions: dict[Any, tuple[Any, Any]] = {}
    with suppress(sqlite3.Error):
        # Older recordings have no such table.
        definitions = {
            name: (encoding, definition)
            for name, encoding, definition in database.execute(
                'SELECT topic_type, encoding, encoded_message_definition FROM message_definitions'
            )
        }
    profiles: dict[Any, Any] = {}
    with suppress(sqlite3.Error):
        # Nor have the oldest this column.
        profiles.update(database.execute('SELECT id, offered_qos_profiles FROM topics'))
    topics = {
        key: topic_of(
            *map(
                _word, (name, kind, form, *definitions.get(kind, ('', '')), profiles.get(key, ''))
            )
        )
        for key, name, kind, form in database.execute(
            'SELECT id, name, type, serialization_format FROM topics'
        )
        if isinstance(key, int)
    }
    wanted = ', '.join(str(key) for key, topic in topics.items() if tally.wanted(topic))
    # Only what is wanted is loaded; images beside it are large.
    rows = database.execute(
        f'SELECT topic_id, timestamp, CASE WHEN topic_id IN ({wanted}) THEN data END FROM messages'  # noqa: S608
    )
    fault = None
    while fault is None:
        some: list[tuple[int, int, bytes]] = []
        try:
            some.extend(islice(rows, MOST))
        except sqlite3.Error as error:
            # What came before it is as good as any.
            fault = error
        if not some:
            break
        tally.piece += 1
        groups: dict[int, list[tuple[int, bytes]]] = {}
        for key, received, data in some:
            groups.setdefault(key, []).append((received, data))
        for key, group in groups.items():
            if key not in topics:
                tally.faults.append(f'is broken: {len(group)} messages of an unknown topic')
            elif tally.enter(topics[key], len(group)):
                times, parts = zip(*group, strict=True)
                stamps = np.array([t if isinstance(t, int) else 0 for t in times])
                yield joined(
                    topics[key],
                    np.clip(stamps, -LATEST, LATEST),
                    [part if isinstance(part, bytes) else b'' for part in parts],
                ).plain()
    if fault is not None:
        raise fault


def _word(value: Any) -> str:
    return value.decode(errors='replace') if isinstance(value, bytes) else str(value)
