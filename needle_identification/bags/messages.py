# SPDX-License-Identifier: Apache-2.0
"""Message definitions, and serialization of messages, without ROS."""

from functools import lru_cache
import os
from pathlib import Path
import re
from typing import Any

from needle_identification.bags.compression import DAMAGED
from needle_identification.bags.topics import BagTopic
from needle_identification.errors import RecordingError
from rosbags import typesys
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore


@lru_cache(maxsize=1)
def _jazzy() -> Typestore:
    return typesys.get_typestore(typesys.Stores.ROS2_JAZZY)


def message_type(type_name: str) -> Any:
    """Return the class of a message type of ROS 2 Jazzy, for `encode`."""
    try:
        return _jazzy().types[type_name]
    except KeyError:
        raise RecordingError(
            f'no definition of {type_name}; valid: the types of ROS 2 Jazzy'
        ) from None


@lru_cache(maxsize=64)
def _installed(type_name: str) -> Typestore:
    """Return a store with a type; types outside Jazzy are read from installed .msg files."""
    store, types, wanted = _jazzy(), {}, [type_name]
    while wanted:
        name = wanted.pop()
        if name in store.fielddefs or name in types:
            continue
        found = typesys.get_types_from_msg(_message_file(name).read_text(encoding='utf-8'), name)
        types.update(found)
        for _, fields in found.values():
            wanted += [part for _, kind in fields if (part := _message_in(kind))]
    if not types:
        return store
    own = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    own.register(types)
    return own


def _message_in(kind: Any) -> str | None:
    """Return the message type of a field (element type of an array), or None."""
    while kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        kind = kind[1][0]
    return str(kind[1]) if kind[0] == Nodetype.NAME else None


def _message_file(type_name: str) -> Path:
    package, _, name = type_name.partition('/msg/')
    for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        path = Path(prefix) / 'share' / package / 'msg' / f'{name}.msg'
        if prefix and path.is_file():
            return path
    raise RecordingError(
        f'no definition of {type_name}: it is not a type of ROS 2 Jazzy, and no package of the '
        'sourced workspaces has it as a .msg file'
    )


def definition_of(type_name: str) -> tuple[str, str]:
    """Return the definition (``ros2msg``) and the type hash of a message type."""
    try:
        store = _installed(type_name)
        definition, _ = store.generate_msgdef(type_name, ros_version=2)
        return definition, store.hash_rihs01(type_name)
    except (OSError, UnicodeDecodeError, typesys.TypesysError) as error:
        raise RecordingError(f'the definition of {type_name} is not readable: {error}') from error


def encode(message: Any) -> bytes:
    """Serialize a message of a class of `message_type` (CDR)."""
    return bytes(_jazzy().serialize_cdr(message, message.__msgtype__))


def deserialize(topic: BagTopic, data: bytes) -> Any:
    """Deserialize a message (CDR) of a topic; the bag defines types outside ROS 2 Jazzy."""
    store = _store(topic.type_name, topic.encoding, topic.definition)
    try:
        if data[:2] not in (b'\0\0', b'\0\1'):
            raise ValueError(f'begins with {data[:4].hex(" ")}, not with 00 00 or 00 01 (CDR)')
        kind = store.get_msgdef(topic.type_name)
        read = kind.deserialize_cdr_le if data[1] else kind.deserialize_cdr_be
        message, size = read(data[4:], 0, kind.cls, store)
        # rclpy appends up to four bytes for each empty array, which itself has four bytes.
        if len(data) > 2 * size + 8:
            raise ValueError(f'has {len(data)} bytes, {size + 4} expected')
        return message
    except (*DAMAGED, SerdeError) as error:
        raise RecordingError(f'is not a {topic.type_name}: {error}') from error


@lru_cache(maxsize=64)
def _store(type_name: str, encoding: str, definition: str) -> Typestore:
    """Return a store with a type: the Jazzy store, or a store with the definition of the bag."""
    known = _jazzy().fielddefs
    if type_name in known:
        return _jazzy()
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    try:
        if encoding == 'ros2msg':
            types = typesys.get_types_from_msg(definition, type_name)
        else:
            types = {}
            for part in re.split(r'^=+\nIDL: .*\n', definition, flags=re.MULTILINE):
                types.update(typesys.get_types_from_idl(part) if part.strip() else {})
        store.register({name: fields for name, fields in types.items() if name not in known})
    except typesys.TypesysError as error:
        raise RecordingError(f'the definition of {type_name} is not readable: {error}') from error
    if type_name not in store.fielddefs:
        raise RecordingError(f'the bag does not hold the definition of {type_name}')
    return store
