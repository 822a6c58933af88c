"""A peer as 3D Slicer is one, by pyigtl and in a process of its own: it can be killed."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing, suppress
import json
from pathlib import Path
import select
import socket
import subprocess
import sys
import time
from typing import Any, Final, NamedTuple

import numpy as np
import pyigtl

#: Time between two targets of a peer [s].
PERIOD: Final = 0.1

#: Stands for the device in what a peer tells of the targets that it has sent.
SENT: Final = 'sent'


def free_port() -> int:
    """
    Find a port of this machine that nobody uses.

    Returns
    -------
    int
        The port.

    """
    with closing(socket.socket()) as one:
        one.bind(('127.0.0.1', 0))
        return int(one.getsockname()[1])


class Told(NamedTuple):
    """
    A message that has come to a peer, or that it has sent.

    Attributes
    ----------
    device : str
        Name of its device, or `SENT`.
    time : float
        Time of its header [s].
    arrived : float
        When it came, by the clock that never jumps [s].
    content : Any
        Points [mm], matrix or text.

    """

    device: str
    time: float
    arrived: float
    content: Any


class Peer:
    """
    A process that connects to a port, tells what comes, and repeats a target.

    Parameters
    ----------
    folder : Path
        Folder for what it tells.
    port : int
        Port of this machine.
    target : sequence of float
        The target [mm]; nothing is sent if it is empty.
    step : float
        How much its x grows from one to the next [mm].

    """

    def __init__(
        self, folder: Path, port: int, target: Sequence[float] = (), step: float = 0.0
    ) -> None:
        self._path = folder / f'peer{len(list(folder.glob("peer*")))}.jsonl'
        #: What it has told so far, and where this ends in its file.
        self._told: list[Told] = []
        self._end = 0
        with self._path.open('wb') as output:
            self.process = subprocess.Popen(
                [sys.executable, __file__, *map(str, (port, step, *target))],
                stdin=subprocess.PIPE,
                stdout=output,
                # pyigtl prints a traceback for each connection that is lost.
                stderr=subprocess.DEVNULL,
            )

    def told(self, device: str) -> list[Told]:
        """
        Return what has come.

        Parameters
        ----------
        device : str
            Name of the device, or `SENT`.

        Returns
        -------
        list of Told
            All messages of the device.

        """
        with self._path.open('rb') as file:
            file.seek(self._end)
            data = file.read()
        # The last line may not be whole.
        end = data.rfind(b'\n') + 1
        self._end += end
        self._told += [Told(*json.loads(line)) for line in data[:end].splitlines()]
        return [one for one in self._told if one.device == device]

    def kill(self) -> None:
        """End it at once, as a crash does."""
        self.process.kill()
        self.process.communicate()


def _tell(told: Told) -> None:
    # One call: two threads tell.
    sys.stdout.write(f'{json.dumps(told)}\n')
    sys.stdout.flush()


class _Devices(dict[str, Any]):
    """Where pyigtl puts the newest message of each device: tells all of them."""

    def __setitem__(self, device: str, message: Any) -> None:
        content: Any = None
        if isinstance(message, pyigtl.PointMessage):
            content = message.positions
        elif isinstance(message, pyigtl.TransformMessage):
            content = message.matrix.tolist()
        elif isinstance(message, pyigtl.StringMessage):
            content = message.string
        _tell(Told(device, message.timestamp, time.monotonic(), content))


def main(port: str, step: str, *target: str) -> None:
    """
    Connect until the one who has started this ends.

    Parameters
    ----------
    port, step, *target : str
        As for `Peer`.

    """
    client = pyigtl.OpenIGTLinkClient(port=int(port), start_now=False)
    client.incoming_messages = _Devices()
    client.start()
    at = [float(one) for one in target]
    while not select.select([sys.stdin], [], [], PERIOD)[0]:
        if at and client.is_connected():
            # As SmartNeedle's module of 3D Slicer sends it.
            message = pyigtl.PointMessage(
                np.array([at, [0.0, 0.0, 0.0]]), names=['TARGET', 'ENTRY'], device_name='PlanningZ'
            )
            _tell(Told(SENT, message.timestamp, time.monotonic(), at))
            client.send_message(message, wait=False)
            at[0] += float(step)


if __name__ == '__main__':
    with suppress(KeyboardInterrupt):
        main(*sys.argv[1:])
