# SPDX-License-Identifier: Apache-2.0
"""Steering law without feedback, for comparison."""

from needle_controller.steering.law import GuideLaw
from needle_controller.steering.planned_path import PlannedPath
from needle_dynamics.arrays import FloatArray


class OpenLoopLaw(GuideLaw):
    """A fixed guide, or the planned positions of the guide."""

    _path: PlannedPath | None = None

    def follow(self, path: PlannedPath) -> None:
        self._path = path

    def choose(self, _tip: FloatArray, _at: int) -> FloatArray:
        return self.guides[-1] if self._path is None else self._path.guide[self.step]
