# SPDX-License-Identifier: Apache-2.0
"""States of the nodes, as lines for 3D Slicer."""

from typing import Final

_PERIOD: Final = 1.0  #: time between two transmissions, unless something changes [s]

#: Largest number of nodes, and ages of a silent and of a removed node [s].
_MOST: Final = 20
_SILENT: Final = 5.0
_REMOVED: Final = 60.0

_LEVELS: Final = {0: 'OK', 1: 'WARN', 2: 'ERROR', 3: 'STALE'}


class NodeStates:
    """Latest state of each node on ``/diagnostics``; all times are of a monotonic clock [s]."""

    def __init__(self) -> None:
        #: Time of receipt, level and message, by node.
        self._states: dict[str, tuple[float, int, str]] = {}
        #: Peer at the last call of `is_due`.
        self._peer = ''
        self._sent = self._changed = -_PERIOD

    def take(self, name: str, level: int, message: str, now: float) -> None:
        """Store the state of a node; further nodes beyond the largest number are ignored."""
        if name in self._states or len(self._states) < _MOST:
            if self._states.get(name, (0.0, -1, ''))[1:] != (level, message):
                self._changed = now
            self._states[name] = now, level, message

    def mark_changed(self, now: float) -> None:
        self._changed = now

    def is_due(self, peer: str, now: float) -> bool:
        """Return whether the states must be sent now: to a new peer, after a change, or again."""
        is_new, self._peer = peer != self._peer, peer
        changed = is_new or self._changed > self._sent or now - self._sent >= _PERIOD
        if not peer or not changed:
            return False
        self._sent = now
        return True

    def lines(self, now: float) -> list[str]:
        """Return a line for each node, sorted by name; nodes without a state are removed."""
        known = sorted(self._states.items())
        self._states = {name: state for name, state in known if now - state[0] < _REMOVED}
        lines = []
        for name, (when, level, message) in self._states.items():
            age = now - when
            silent = f', silent for {age:.0f} s' if age > _SILENT else ''
            lines.append(f'{name} [{_LEVELS.get(level, str(level))}{silent}]: {message}')
        return lines
