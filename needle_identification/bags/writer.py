# SPDX-License-Identifier: Apache-2.0
"""Write bags as MCAP."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from mcap.writer import CompressionType, Writer
from needle_identification.bags.bag import LOST, METADATA
from needle_identification.bags.messages import definition_of
from needle_identification.bags.topics import OfferedQos
from needle_identification.errors import RecordingError
from needle_ros.settings import check_choice
import yaml

_COMPRESSIONS: Final = {
    'zstd': CompressionType.ZSTD,
    'lz4': CompressionType.LZ4,
    'none': CompressionType.NONE,
}

COMPRESSIONS: Final = tuple(_COMPRESSIONS)  #: compressions of the chunks of a bag, by name


class BagWriter:
    """
    Writes serialized messages to a new rosbag2 folder.

    ``metadata.yaml`` is written last: a folder without it was not closed. Data passed to the
    operating system by `flush` survive the end of the process.

    Parameters
    ----------
    path : Path or str
        Folder to create.
    compression : str
        One of `COMPRESSIONS`.

    Raises
    ------
    RecordingError
        If the folder exists or cannot be created.

    Examples
    --------
    >>> from needle_identification import BagWriter
    >>> from needle_identification.bags.bag import read_topic
    >>> from needle_identification.bags.messages import encode, message_type
    >>> from tempfile import TemporaryDirectory
    >>> folder = TemporaryDirectory()
    >>> text = message_type('std_msgs/msg/String')
    >>> with BagWriter(f'{folder.name}/bag') as bag:
    ...     bag.add_topic('/notes', 'std_msgs/msg/String')
    ...     bag.write('/notes', encode(text('begin')), receive_ns=1_000_000_000)
    >>> [(received, note.data) for received, note in read_topic(f'{folder.name}/bag', '/notes')]
    [(1000000000, 'begin')]
    >>> folder.cleanup()

    """

    def __init__(self, path: Path | str, compression: str = 'zstd') -> None:
        self.path = path = Path(path)
        check_choice('compression', compression, COMPRESSIONS)
        self._file = path / f'{path.name}_0.mcap'
        try:
            path.mkdir(parents=True)
            self._stream = self._file.open('xb')
            self._writer: Any = Writer(self._stream, compression=_COMPRESSIONS[compression])
            self._writer.start('ros2')
            self.flush()
        except FileExistsError:
            raise RecordingError(f'{path} exists; a recording must go to a new folder') from None
        except OSError as error:
            raise RecordingError(f'cannot record to {path}: {error.strerror}') from error
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._topics: dict[str, dict[str, Any]] = {}
        #: Number of written messages by topic, and of lost ones, counted by the caller.
        self.counts: dict[str, int] = {}
        self.lost: Counter[str] = Counter()
        self._start, self._end = 2**63 - 1, 0

    @property
    def size(self) -> int:
        """Number of written bytes, without the chunk in progress."""
        return self._stream.tell()

    def add_topic(
        self, topic: str, type_name: str, offered: Sequence[OfferedQos] = (OfferedQos(),)
    ) -> None:
        """Announce a topic by its full name, or update the QoS of all of its publishers."""
        definition, type_hash = definition_of(type_name)
        if type_name not in self._schemas:
            self._schemas[type_name] = self._writer.register_schema(
                type_name, 'ros2msg', definition.encode()
            )
        profiles = [qos.as_mapping() for qos in offered]
        about = {'offered_qos_profiles': yaml.safe_dump(profiles), 'topic_type_hash': type_hash}
        schema = self._schemas[type_name]
        self._channels[topic] = self._writer.register_channel(topic, 'cdr', schema, about)
        self.counts.setdefault(topic, 0)
        self._topics[topic] = {
            'name': topic,
            'type': type_name,
            'serialization_format': 'cdr',
            'offered_qos_profiles': profiles,
            'type_description_hash': type_hash,
        }

    def write(self, topic: str, data: bytes, receive_ns: int) -> None:
        """Write a serialized message (CDR) of an announced topic, with its receive time [ns]."""
        self._writer.add_message(self._channels[topic], receive_ns, data, receive_ns)
        self.counts[topic] += 1
        self._start = min(self._start, receive_ns)
        self._end = max(self._end, receive_ns)

    def flush(self) -> None:
        """Pass all buffered data to the operating system."""
        self._writer.flush()

    def close(self) -> None:
        """Complete the bag: index, then metadata."""
        self._writer.finish()
        self._stream.close()
        draft = self.path / f'{METADATA}.tmp'
        draft.write_text(yaml.safe_dump(self._metadata(), sort_keys=False), encoding='utf-8')
        draft.replace(self.path / METADATA)

    def abort(self) -> None:
        """Close the file without completing it, after a write error."""
        with suppress(OSError):
            self._stream.close()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def _metadata(self) -> dict[str, Any]:
        name = self._file.name
        return {
            'rosbag2_bagfile_information': {
                'version': 9,
                'storage_identifier': 'mcap',
                **self._extent(),
                'topics_with_message_count': [
                    {'topic_metadata': metadata, 'message_count': self.counts[topic]}
                    for topic, metadata in self._topics.items()
                ],
                'compression_format': '',
                'compression_mode': '',
                'relative_file_paths': [name],
                'files': [{'path': name, **self._extent()}],
                'custom_data': {LOST: described(self.lost)} if self.lost else None,
                'ros_distro': 'jazzy',
            }
        }

    def _extent(self) -> dict[str, Any]:
        return {
            'duration': {'nanoseconds': max(0, self._end - self._start)},
            'starting_time': {'nanoseconds_since_epoch': self._start},
            'message_count': sum(self.counts.values()),
        }


def described(lost: Mapping[str, int]) -> str:
    return ', '.join(f'{number} of {topic}' for topic, number in sorted(lost.items()))
