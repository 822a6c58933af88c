# SPDX-License-Identifier: Apache-2.0
"""Paths that the joints of a plant follow, and a pause that holds them."""

from collections.abc import Collection
from typing import NamedTuple

from needle_dynamics.simulated.run import follow, PlantRun
from needle_ros.timing import NANOSECONDS
from needle_ros.trajectories import JointPath


class _Execution(NamedTuple):
    """Path that some of its joints follow, and its start [ns]."""

    path: JointPath
    joints: frozenset[str]
    begun: int


class Executions:
    """
    Paths under way of the joints ``moved``; a pause holds the rest of each.

    `sampled` is the stamp of the newest sample [ns], 0 before the first.
    """

    def __init__(self, plant_run: PlantRun, moved: Collection[str]) -> None:
        self._run, self._moved = plant_run, moved
        self.sampled = 0
        self.period = round(NANOSECONDS / plant_run.constants.own.rate)
        self._running: list[_Execution] = []
        self._held: list[_Execution] = []
        self._paused: int | None = None  #: start of the pause [ns]

    @property
    def paused(self) -> bool:
        return self._paused is not None

    @property
    def joints_held(self) -> set[str]:
        return {name for one in self._held for name in one.joints}

    def follow(self, path: JointPath, joints: Collection[str], elapsed: float) -> None:
        """Follow a path with some joints, at a time after its start [s]."""
        follow(path, tuple(joints), self._run, elapsed)
        self.forget(joints)
        begun = self.sampled - round(elapsed * NANOSECONDS)
        self._running.append(_Execution(path, frozenset(joints), begun))

    def forget(self, joints: Collection[str]) -> None:
        """Discard the paths of joints that something else moves."""
        for paths in (self._running, self._held):
            kept = [one._replace(joints=one.joints - {*joints}) for one in paths]
            paths[:] = [one for one in kept if one.joints]

    def pause(self, *, withdraws: bool = False) -> None:
        """Hold the joints that move, or all if the plant withdraws; begin no motion."""
        self._paused, end = self.sampled, self.sampled + self.period
        self._held = [one for one in self._running if one.path.end(one.begun) > end]
        self._running, joints = [], self.joints_held
        # At rest nothing changes: an indenter keeps its force.
        if joints or withdraws:
            self._run.hold([name for name in self._moved if name in joints or withdraws])

    def resume(self) -> None:
        """End a pause: follow the rest of the paths that it holds."""
        begun, held = self._paused, self._held
        self._paused, self._held = None, []
        for one in held:
            path = one.path.only(one.joints)
            self.follow(path, path.joints, ((begun or 0) - one.begun) / NANOSECONDS)
