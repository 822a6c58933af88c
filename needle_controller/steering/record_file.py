# SPDX-License-Identifier: Apache-2.0
"""File with the record of an insertion, for a restart of the node `steering`."""

import json
import os
from pathlib import Path

from needle_controller.steering.insertion_record import SteeringRecord
from needle_ros.errors import MessageError, ParameterError
from needle_ros.files import write_whole


class RecordFile:
    """
    File with the record of a node on a domain, and with the source of its measurements.

    The source identifies the process of the robot: with another one, the needle may be another.
    """

    def __init__(self, node: str, domain: int) -> None:
        home = Path(os.environ.get('ROS_HOME') or Path.home() / '.ros')
        name = node.strip('/').replace('/', '.')
        self._path = home / 'needle_insertion' / f'{name}.{domain}.json'

    def write(self, record: str, source: str) -> None:
        """Replace the file, or raise `ParameterError`."""
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ParameterError(f'{self._path} cannot be written: {error.strerror}') from error
        write_whole(self._path, json.dumps({'source': source, 'record': record}).encode())

    def read(self) -> tuple[SteeringRecord, str] | None:
        """Return the record and its source; None without a file, `MessageError` if invalid."""
        try:
            content = json.loads(self._path.read_bytes())
            record = SteeringRecord.from_values(json.loads(content['record']))
            return record, str(content['source'])
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise MessageError(f'{self._path} cannot be read: {error}') from error
