# SPDX-License-Identifier: Apache-2.0
"""Split a byte stream into OpenIGTLink messages, in bounded memory."""

from collections.abc import Callable
import struct
from typing import Final, NamedTuple

from needle_ros.errors import MessageError

#: Version, type, device name, time stamp (whole and fraction), size of the body, checksum.
HEADER: Final = struct.Struct('>H12s20sIIQQ')

#: Versions of the header: 1 and 2 of OpenIGTLink 1 to 3, and a future version.
_VERSIONS: Final = (1, 2, 3)

LARGEST: Final = 1 << 16  #: largest accepted body [bytes]: 481 points

#: Largest skipped body [bytes]; a larger size is a protocol error.
_LARGEST_SKIPPED: Final = 1 << 30


class Frame(NamedTuple):
    """Unparsed message: its type, such as ``POINT``, name of the device, header and body."""

    kind: str
    device: str
    data: bytes


class Frames:
    """Splitter of a byte stream into wanted messages; `refuse` reports too large ones."""

    def __init__(
        self, wanted: Callable[[str, str], bool], refuse: Callable[[str], object]
    ) -> None:
        self._wanted, self._refuse = wanted, refuse
        self._rest = b''
        self._skip = 0

    def take(self, data: bytes) -> list[Frame]:
        """Return the messages completed by further bytes; `MessageError` if not OpenIGTLink."""
        stream, at, found = self._rest + data, 0, []
        while True:
            step = min(self._skip, len(stream) - at)
            at, self._skip = at + step, self._skip - step
            if self._skip or len(stream) - at < HEADER.size:
                break
            kind, device, size = _header(stream[at : at + HEADER.size])
            whole = HEADER.size + size
            if not self._wanted(kind, device):
                self._skip = whole
            elif size > LARGEST:
                self._refuse(
                    f'target refused: a {kind} message of {size} bytes, {LARGEST} at most'
                )
                self._skip = whole
            elif len(stream) - at < whole:
                break
            else:
                found.append(Frame(kind, device, stream[at : at + whole]))
                at += whole
        self._rest = stream[at:]
        return found


def _header(header: bytes) -> tuple[str, str, int]:
    version, kind, device, _, _, size, _ = HEADER.unpack(header)
    name = kind.rstrip(b' \0')
    if version not in _VERSIONS or not name.isascii() or not name.decode('latin1').isprintable():
        raise MessageError(f'not OpenIGTLink: it begins with {header[:14]!r}')
    if size > _LARGEST_SKIPPED:
        raise MessageError(f'not OpenIGTLink: a {name.decode()} message of {size} bytes')
    # Slicer uses names of nodes, which may be truncated within a character.
    return name.decode(), device.rstrip(b' \0').decode(errors='replace'), size
