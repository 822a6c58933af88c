# SPDX-License-Identifier: Apache-2.0
"""File with the record of an insertion, for a restart of the node `steering`."""

import json
import os
from pathlib import Path
from threading import Lock
from typing import Any, Final

from needle_controller.steering.insertion_record import SteeringRecord
from needle_controller.steering.planning import ThreadJob
from needle_ros.errors import MessageError, ParameterError
from needle_ros.files import write_whole

_LONGEST: Final = 0.05  #: Longest time that a callback waits for the disk [s].


class RecordFile:
    """
    The record of a node on a domain, and the source of its measurements.

    The source identifies the process of the robot: with another one, the needle may be another.
    Threads read and write, so that a disk without a response delays a callback by 0.05 s at most.
    """

    def __init__(self, node: str, domain: int) -> None:
        home = Path(os.environ.get('ROS_HOME') or Path.home() / '.ros')
        name = node.strip('/').replace('/', '.')
        self._path = home / 'needle_insertion' / f'{name}.{domain}.json'
        self._lock = Lock()
        #: Newest content that the thread has not begun to write, and the thread while it writes.
        self._next: bytes | None = None
        self._writer: ThreadJob[None] | None = None

    def write(self, record: str, source: str) -> None:
        """
        Replace the file, or raise `ParameterError`.

        A file that is not replaced within 0.05 s is an error, too; its thread continues.
        """
        with self._lock:
            self._next = json.dumps({'source': source, 'record': record}).encode()
            if self._writer is None:
                self._writer = ThreadJob(self._write)
            writer = self._writer
        if not writer.wait(_LONGEST):
            raise ParameterError(f'{self._path} is not written within {_LONGEST:g} s')
        writer.result()

    def _write(self, _progress: Any) -> None:
        """Write the newest content until there is none; raise the error of the last one."""
        failed: ParameterError | None = None
        while True:
            with self._lock:
                content, self._next = self._next, None
                if content is None:
                    self._writer = None
                    break
            try:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                write_whole(self._path, content)
                failed = None
            except OSError as error:
                failed = ParameterError(f'{self._path} cannot be written: {error.strerror}')
            except ParameterError as error:
                failed = error
        if failed is not None:
            raise failed

    def read(self) -> tuple[SteeringRecord, str] | None:
        """Return the record and its source; None without a file, `MessageError` if invalid."""
        reader = ThreadJob(self._read)
        if not reader.wait(_LONGEST):
            raise MessageError(f'{self._path} is not read within {_LONGEST:g} s')
        return reader.result()

    def _read(self, _progress: Any) -> tuple[SteeringRecord, str] | None:
        try:
            content = json.loads(self._path.read_bytes())
            record = SteeringRecord.from_values(json.loads(content['record']))
            return record, str(content['source'])
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise MessageError(f'{self._path} cannot be read: {error}') from error
