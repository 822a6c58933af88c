"""Topics of a bag, and the quality of service (QoS) that their publishers offered."""

from __future__ import annotations

from dataclasses import dataclass, field
import re
from typing import Any, Final, NamedTuple

import yaml

#: Numbers that older recordings have instead of the words of rosbag2.
_WORDS: Final = {
    'reliability': {1: 'reliable', 2: 'best_effort'},
    'durability': {1: 'transient_local', 2: 'volatile'},
    'history': {1: 'keep_last', 2: 'keep_all'},
}

#: No limit, as rosbag2 stores it.
_UNLIMITED: Final = {'sec': 9223372036, 'nsec': 854775807}


class OfferedQos(NamedTuple):
    """
    Quality of service that a publisher offers, in the words of rosbag2.

    Attributes
    ----------
    reliability, durability, history : str
        ``reliable`` or ``best_effort``, ``volatile`` or ``transient_local``, ``keep_last`` or
        ``keep_all``.
    depth : int
        Number of messages that are kept.

    """

    reliability: str = 'reliable'
    durability: str = 'volatile'
    history: str = 'keep_last'
    depth: int = 10

    def as_mapping(self) -> dict[str, Any]:
        """
        Return the profile as rosbag2 stores it.

        Returns
        -------
        dict
            The profile; what is not known here is unlimited.

        """
        return {
            'history': self.history,
            'depth': self.depth,
            'reliability': self.reliability,
            'durability': self.durability,
            'deadline': dict(_UNLIMITED),
            'lifespan': dict(_UNLIMITED),
            'liveliness': 'automatic',
            'liveliness_lease_duration': dict(_UNLIMITED),
            'avoid_ros_namespace_conventions': False,
        }


@dataclass(frozen=True, slots=True)
class Topic:
    """
    A topic in a bag.

    Attributes
    ----------
    name, type_name : str
        Full name, and type such as ``sensor_msgs/msg/JointState``. A message encoding other than
        that of ROS 2 follows the type in brackets, so that it is no known type.
    encoding, definition : str
        Language of the definition of the type, ``ros2msg`` or ``ros2idl``, and the definition.
    profiles : str
        YAML of the QoS that its publishers offered, for `offered_qos`.

    """

    name: str
    type_name: str
    encoding: str = field(default='', compare=False)
    definition: str = field(default='', compare=False, repr=False)
    profiles: str = field(default='', compare=False, repr=False)

    def __str__(self) -> str:
        return f'{self.name} ({self.type_name})'

    def offered_qos(self) -> tuple[OfferedQos, ...]:
        """
        Read the QoS that the publishers offered.

        Returns
        -------
        tuple of OfferedQos
            One per publisher; empty if there are none or they are not readable.

        """
        try:
            profiles = yaml.safe_load(self.profiles) or []
            return tuple(
                OfferedQos(
                    **{
                        name: words.get(stored[name], stored[name])
                        for name, words in _WORDS.items()
                    },
                    depth=int(stored['depth']),
                )
                for stored in profiles
            )
        except (yaml.YAMLError, KeyError, TypeError, ValueError, RecursionError):
            return ()


def make_topic(
    name: str,
    type_name: str,
    message_encoding: str,
    encoding: str = '',
    definition: str = '',
    profiles: str = '',
) -> Topic:
    """
    Make a topic from what a file says of it.

    Parameters
    ----------
    name, type_name : str
        Name and type, as written; some writers leave out the middle of the type, as ROS 1 did.
    message_encoding : str
        Encoding of the messages; ``cdr`` is that of ROS 2.
    encoding, definition, profiles : str
        As in `Topic`.

    Returns
    -------
    Topic
        The topic, with the full name of its type and no control characters in the names.

    """
    full = re.sub(r'^(\w+)/(\w+)$', r'\1/msg/\2', type_name)
    full = full if message_encoding == 'cdr' else f'{full} [{message_encoding}]'
    # Messages about a topic are one line, whatever a damaged file calls it.
    name, full = (re.sub(r'[\x00-\x1f\x7f]', '?', word) for word in (name, full))
    return Topic(name, full, encoding, definition, profiles)
