# SPDX-License-Identifier: Apache-2.0
"""Topics of a bag, and the quality of service (QoS) that their publishers offered."""

from collections.abc import Mapping
from dataclasses import dataclass, field
import re
from typing import Any, Final, NamedTuple

from needle_ros.documents import DocumentError, read_document
from needle_ros.errors import shown
from needle_ros.timing import NANOSECONDS

#: Policies of a QoS, with the names of rosbag2 for the numbers in older recordings.
WORDS: Final[Mapping[str, Mapping[Any, str]]] = {
    'reliability': {1: 'reliable', 2: 'best_effort'},
    'durability': {1: 'transient_local', 2: 'volatile'},
    'history': {1: 'keep_last', 2: 'keep_all'},
    'liveliness': {1: 'automatic', 3: 'manual_by_topic'},
}

DURATIONS: Final = ('deadline', 'lifespan', 'liveliness_lease_duration')  #: times of a QoS
UNLIMITED: Final = 2**63 - 1  #: value of the middleware for no limit [ns]


class OfferedQos(NamedTuple):
    """Quality of service that a publisher offers, with the names of rosbag2; times in ns."""

    reliability: str = 'reliable'  # or best_effort
    durability: str = 'volatile'  # or transient_local
    history: str = 'keep_last'  # or keep_all
    depth: int = 10  # number of messages that are kept
    deadline: int = UNLIMITED  # longest time between messages
    lifespan: int = UNLIMITED  # longest lifetime of a message
    liveliness: str = 'automatic'  # or manual_by_topic
    liveliness_lease_duration: int = UNLIMITED  # longest time without a signal of the publisher

    def as_mapping(self) -> dict[str, Any]:
        times = {}
        for name in DURATIONS:
            sec, nsec = divmod(getattr(self, name), NANOSECONDS)
            times[name] = {'sec': sec, 'nsec': nsec}
        return {**self._asdict(), **times, 'avoid_ros_namespace_conventions': False}


def _stored(profile: Mapping[str, Any]) -> OfferedQos:
    """Return a profile in the storage format of rosbag2; older ones have no liveliness."""
    words = {
        name: known.get(profile[name], profile[name])
        for name, known in WORDS.items()
        if name in profile or name != 'liveliness'
    }
    times: dict[str, Any] = {name: _nanoseconds(profile.get(name)) for name in DURATIONS}
    return OfferedQos(depth=int(profile['depth']), **words, **times)


def _nanoseconds(time: Mapping[str, int] | None) -> int:
    """Convert a stored time to ns; None, zero and negative times mean no limit."""
    if time is None:
        return UNLIMITED
    found = int(time['sec']) * NANOSECONDS + int(time['nsec'])
    return found if 0 < found < UNLIMITED else UNLIMITED


@dataclass(frozen=True, slots=True)
class BagTopic:
    """A topic in a bag."""

    name: str  #: full name
    #: Type, such as ``sensor_msgs/msg/JointState``. A message encoding other than CDR (ROS 2)
    #: follows the type in brackets, which makes it an unknown type.
    type_name: str
    #: Language of the definition of the type, ``ros2msg`` or ``ros2idl``, and the definition.
    encoding: str = field(default='', compare=False)
    definition: str = field(default='', compare=False, repr=False)
    #: YAML of the QoS that the publishers offered, for `offered_qos`.
    profiles: str = field(default='', compare=False, repr=False)

    def __str__(self) -> str:
        return f'{self.name} ({self.type_name})'

    def offered_qos(self) -> tuple[OfferedQos, ...]:
        """Return the QoS that each publisher offered; empty if missing or not readable."""
        try:
            return tuple(map(_stored, read_document(self.profiles) or []))
        except (DocumentError, AttributeError, KeyError, TypeError, ValueError, OverflowError):
            return ()


def make_topic(
    name: str,
    type_name: str,
    message_encoding: str,
    encoding: str = '',
    definition: str = '',
    profiles: str = '',
) -> BagTopic:
    """Build a topic; ``std_msgs/String`` (ROS 1, some writers) becomes ``std_msgs/msg/String``."""
    full = re.sub(r'^(\w+)/(\w+)$', r'\1/msg/\2', type_name)
    full = full if message_encoding == 'cdr' else f'{full} [{message_encoding}]'
    # Escaped names keep error messages of damaged files on one line.
    return BagTopic(shown(name), shown(full), encoding, definition, profiles)
