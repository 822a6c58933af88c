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
from typing import Any, NamedTuple

import numpy as np
import pyigtl

#: Time between two targets of a peer [s].
_PERIOD = 0.1


def free_port() -> int:
    """Return a port of this machine that nobody uses."""
    with closing(socket.socket()) as one:
        one.bind(('127.0.0.1', 0))
        return int(one.getsockname()[1])


class Told(NamedTuple):
    """A message as it arrived: device, time of the header [s], and what it says."""

    device: str
    time: float
    content: Any


class Peer:
    """A process that connects to a port, tells what comes, and repeats a target [mm]."""

    def __init__(self, folder: Path, port: int, target: Sequence[float] = ()) -> None:
        self._path = folder / f'peer{len(list(folder.glob("peer*")))}.jsonl'
        with self._path.open('wb') as output:
            self.process = subprocess.Popen(
                [sys.executable, __file__, str(port), *map(str, target)],
                stdin=subprocess.PIPE,
                stdout=output,
                # pyigtl prints a traceback for each connection that is lost.
                stderr=subprocess.DEVNULL,
            )

    def told(self, device: str) -> list[Told]:
        """Return all messages of a device that have come."""
        lines = self._path.read_text(encoding='utf-8').splitlines(keepends=True)
        whole = (Told(*json.loads(line)) for line in lines if line.endswith('\n'))
        return [one for one in whole if one.device == device]

    def kill(self) -> None:
        """End it at once, as a crash does."""
        self.process.kill()
        self.process.communicate()


class _Told(dict[str, Any]):
    """Where pyigtl puts the newest message of each device: tells all of them."""

    def __setitem__(self, device: str, message: Any) -> None:
        content: Any = None
        if isinstance(message, pyigtl.PointMessage):
            content = message.positions
        elif isinstance(message, pyigtl.TransformMessage):
            content = message.matrix.tolist()
        elif isinstance(message, pyigtl.StringMessage):
            content = message.string
        sys.stdout.write(json.dumps(Told(device, message.timestamp, content)) + '\n')
        sys.stdout.flush()


def main(port: str, *target: str) -> None:
    """Connect until the one who has started this ends."""
    client = pyigtl.OpenIGTLinkClient(port=int(port), start_now=False)
    client.incoming_messages = _Told()
    client.start()
    while not select.select([sys.stdin], [], [], _PERIOD)[0]:
        if target and client.is_connected():
            # As SmartNeedle's module of 3D Slicer sends it.
            points = np.array([[float(one) for one in target], [0.0, 0.0, 0.0]])
            message = pyigtl.PointMessage(
                points, names=['TARGET', 'ENTRY'], device_name='PlanningZ'
            )
            client.send_message(message, wait=False)


if __name__ == '__main__':
    with suppress(KeyboardInterrupt):
        main(*sys.argv[1:])
