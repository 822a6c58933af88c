"""Whole OpenIGTLink messages from a stream of bytes, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable
import struct
from typing import Final, NamedTuple

from needle_ros.errors import MessageError

#: Version, type, device name, time stamp (whole and fraction), size of the body, checksum.
HEADER: Final = struct.Struct('>H12s20sIIQQ')

#: Versions of the header: those of OpenIGTLink 1 and 2, of 3, and one to come.
_VERSIONS: Final = (1, 2, 3)

#: Largest body that is taken [bytes]: 481 points.
LARGEST: Final = 1 << 16

#: Largest body that is passed over [bytes]. A larger one is no message.
_LARGEST_SKIPPED: Final = 1 << 30


class Frame(NamedTuple):
    """
    A message as it came.

    Attributes
    ----------
    kind : str
        Its type, such as ``POINT``.
    device : str
        Name of its device.
    data : bytes
        Header and body.

    """

    kind: str
    device: str
    data: bytes


class Frames:
    """
    Cuts a stream into messages; those that nobody wants are passed over and never stored.

    Parameters
    ----------
    wanted : callable
        Returns whether a message of a type and a device name is wanted.
    refuse : callable
        Called with a line about a message that is wanted, but too large.

    """

    def __init__(
        self, wanted: Callable[[str, str], bool], refuse: Callable[[str], object]
    ) -> None:
        self._wanted, self._refuse = wanted, refuse
        self._rest = b''
        self._skip = 0

    def take(self, data: bytes) -> list[Frame]:
        """
        Take the next bytes.

        Parameters
        ----------
        data : bytes
            Any part of the stream.

        Returns
        -------
        list of Frame
            The messages that are complete now.

        Raises
        ------
        MessageError
            If this is not OpenIGTLink; where the next message begins is not known then.

        """
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
    """Return type, device name and size of the body."""
    version, kind, device, _, _, size, _ = HEADER.unpack(header)
    name = kind.rstrip(b' \0')
    if version not in _VERSIONS or not name.isascii() or not name.decode('latin1').isprintable():
        raise MessageError(f'not OpenIGTLink: it begins with {header[:14]!r}')
    if size > _LARGEST_SKIPPED:
        raise MessageError(f'not OpenIGTLink: a {name.decode()} message of {size} bytes')
    # Slicer takes names of nodes, which may be cut within a letter.
    return name.decode(), device.rstrip(b' \0').decode(errors='replace'), size
