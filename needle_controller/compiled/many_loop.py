# SPDX-License-Identifier: Apache-2.0
"""Closed loops with needles of three or four modes, compiled when they are first simulated."""

from __future__ import annotations

from typing import TYPE_CHECKING

from needle_controller.compiled.filter import Filter
from needle_controller.compiled.loop import LaneLoop, run_lanes_with
from needle_dynamics.compiled.cache import kernel
from needle_dynamics.compiled.many_lanes import rotate_many_lanes

if TYPE_CHECKING:
    from needle_dynamics.compiled.boxed import Boxed


@kernel
def run_many_lanes(loop: LaneLoop, boxed: Boxed[Filter]) -> None:
    """Run `loop.run_lanes_with` for needles with three or four modes."""
    run_lanes_with(rotate_many_lanes, loop, boxed)
