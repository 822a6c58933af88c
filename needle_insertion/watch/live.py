# SPDX-License-Identifier: Apache-2.0
"""JSON frames of live nodes and of a recording for the readers of the page."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
import json
from time import monotonic
from typing import Any, Final

from needle_controller.steering.insertion_plan import Plan
from needle_insertion.watch.recorded import Comparison, PagePlayback, ShownRecording
from needle_insertion.watch.view import planned, RATE, SPAN, View
from needle_ros.errors import ParameterError

PERIOD: Final = 1.0 / RATE  #: time between two frames [s]


def _json(content: object) -> str:
    return json.dumps(content, separators=(',', ':'), allow_nan=False)


class Live:
    """Frames at a fixed rate, the same for all readers; `poll` updates the view at a time [s]."""

    def __init__(
        self, view: View, poll: Callable[[float], None], *, control: bool, plan: Plan | None = None
    ) -> None:
        self._view, self._poll = view, poll
        shown = None if plan is None else planned(plan)
        self.setting: dict[str, Any] = {'control': control, 'recording': None, 'plan': shown}
        self.history: deque[list[float | None]] = deque(maxlen=round(SPAN * RATE))
        self._changed = asyncio.Condition()
        self.scene: dict[str, Any] = {}
        self.number, self.frame = 0, ''

    async def run(self) -> None:
        due = monotonic()
        while True:
            now = monotonic()
            self._poll(now)
            frame = self._view.frame(now)
            frame['row'] = self._view.row(now)
            self.history.append(frame['row'])
            self.scene = self._view.scene
            self.number, self.frame = self.number + 1, _json(frame)
            async with self._changed:
                self._changed.notify_all()
            # No extra frames after a delay.
            due = max(due + PERIOD, now)
            await asyncio.sleep(due - monotonic())

    async def newer(self, number: int) -> None:
        async with self._changed:
            await self._changed.wait_for(lambda: self.number > number)


class LiveReader:
    """Frames of live nodes for one reader."""

    def __init__(self, live: Live) -> None:
        self._live = live
        self._number = 0
        self._scene: dict[str, Any] = {}

    async def next(self) -> str:
        """
        Wait for the next newer frame; return it as JSON.

        It has the scene if it has changed, and the rows since the previous frame.
        """
        live, first = self._live, self._number == 0
        await live.newer(self._number)
        missed = min(live.number - self._number, len(live.history)) - 1
        self._number = live.number
        parts = [f'"frame":{live.frame}']
        if missed and not first:
            parts.append(f'"missed":{_json([*live.history][-missed - 1 : -1])}')
        if first or live.scene is not self._scene:
            self._scene = live.scene
            parts.append(f'"scene":{_json(self._scene)}')
        if first:
            parts += [f'"setting":{_json(live.setting)}', f'"history":{_json([*live.history])}']
        return '{' + ','.join(parts) + '}'

    def take(self, message: dict[str, Any]) -> None:
        raise ParameterError(f'the live page accepts "seen" and "ask" only, got {sorted(message)}')


class RecordedReader:
    """Frames of a recording for one reader, with those of another if it is compared."""

    def __init__(
        self,
        recording: ShownRecording,
        comparison: Comparison | None = None,
        plan: Plan | None = None,
    ) -> None:
        self._recording, self._comparison = recording, comparison
        self._playback = PagePlayback(recording.duration)
        self._setting = {
            'control': False,
            'recording': {
                'name': recording.name,
                'duration': recording.duration,
                'losses': list(recording.losses),
            },
            'plan': None if plan is None else planned(plan),
        }
        self._scene: dict[str, Any] | None = None
        self._due = monotonic()
        self._asked = asyncio.Event()
        self._asked.set()

    async def next(self) -> str:
        """Wait for the next frame; return it, at first with all signals, as JSON."""
        playback = self._playback
        if playback.playing:
            await asyncio.sleep(self._due - monotonic())
        else:
            await self._asked.wait()
        # No extra frames after a delay.
        self._due = max(self._due, monotonic() - PERIOD) + PERIOD
        self._asked.clear()
        at = playback.at
        view = self._recording.view(at)
        frame = view.frame(at)
        if self._comparison is not None:
            frame['other'] = self._comparison.needle(at)
        content: dict[str, Any] = {
            'frame': frame,
            'playback': {'playing': playback.playing, 'speed': playback.speed},
        }
        if view.scene != self._scene:
            content['scene'], first = view.scene, self._scene is None
            self._scene = view.scene
            if first:
                content |= {'setting': self._setting, 'signals': self._recording.signals()}
                if self._comparison is not None:
                    content['other'] = self._comparison.content()
        return _json(content)

    def take(self, message: dict[str, Any]) -> None:
        self._playback.take(message)
        self._asked.set()
