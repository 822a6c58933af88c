# SPDX-License-Identifier: Apache-2.0
"""OpenIGTLink peer in place of 3D Slicer, by pyigtl in a separate process that can be killed."""

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

#: Device name of sent targets in the log.
SENT: Final = 'sent'


def free_port() -> int:
    """Return a free port of this machine."""
    with closing(socket.socket()) as one:
        one.bind(('127.0.0.1', 0))
        return int(one.getsockname()[1])


class Told(NamedTuple):
    """
    A message received or sent by a peer.

    Attributes
    ----------
    device : str
        Name of the device, or `SENT`.
    time : float
        Time of the header [s].
    arrived : float
        Time of reception by the monotonic clock [s].
    content : Any
        Points [mm], matrix or text.

    """

    device: str
    time: float
    arrived: float
    content: Any


class Peer:
    """
    Process that connects to a port, logs received messages, and sends a target periodically.

    Parameters
    ----------
    folder : Path
        Folder of the log.
    port : int
        Port of this machine.
    target : sequence of float
        Target [mm]; empty: nothing is sent.
    step : float
        Increment of x from one target to the next [mm].

    """

    def __init__(
        self, folder: Path, port: int, target: Sequence[float] = (), step: float = 0.0
    ) -> None:
        self._path = folder / f'peer{len(list(folder.glob("peer*")))}.jsonl'
        #: Messages read from the log, and the position in its file.
        self._told: list[Told] = []
        self._end = 0
        with self._path.open('wb') as output:
            self.process = subprocess.Popen(
                [sys.executable, __file__, *map(str, (port, step, *target))],
                stdin=subprocess.PIPE,
                stdout=output,
                # pyigtl prints a traceback for each lost connection.
                stderr=subprocess.DEVNULL,
            )

    def told(self, device: str) -> list[Told]:
        """Return all logged messages of a device, or of `SENT`."""
        with self._path.open('rb') as file:
            file.seek(self._end)
            data = file.read()
        # The last line may be incomplete.
        end = data.rfind(b'\n') + 1
        self._end += end
        self._told += [Told(*json.loads(line)) for line in data[:end].splitlines()]
        return [one for one in self._told if one.device == device]

    def kill(self) -> None:
        """Kill the process, as in a crash."""
        self.process.kill()
        self.process.communicate()


def _tell(told: Told) -> None:
    # A single call: two threads write.
    sys.stdout.write(f'{json.dumps(told)}\n')
    sys.stdout.flush()


class _Devices(dict[str, Any]):
    """Device table of pyigtl that logs each new message."""

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
    """Connect until the parent process ends; arguments as for `Peer`."""
    client = pyigtl.OpenIGTLinkClient(port=int(port), start_now=False)
    client.incoming_messages = _Devices()
    client.start()
    at = [float(one) for one in target]
    while not select.select([sys.stdin], [], [], PERIOD)[0]:
        if at and client.is_connected():
            # Format of the SmartNeedle module of 3D Slicer.
            message = pyigtl.PointMessage(
                np.array([at, [0.0, 0.0, 0.0]]), names=['TARGET', 'ENTRY'], device_name='PlanningZ'
            )
            _tell(Told(SENT, message.timestamp, time.monotonic(), at))
            client.send_message(message, wait=False)
            at[0] += float(step)


if __name__ == '__main__':
    with suppress(KeyboardInterrupt):
        main(*sys.argv[1:])
