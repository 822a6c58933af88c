# SPDX-License-Identifier: Apache-2.0
"""Closed loops with needles of three or four modes, compiled when they are first simulated."""

from needle_controller.compiled.loop import LaneLoop, run_lanes_with
from needle_dynamics.compiled.cache import kernel
from needle_dynamics.compiled.many_lanes import rotate_many_lanes


@kernel
def run_many_lanes(loop: LaneLoop) -> None:
    """Run `loop.run_lanes_with` for needles with three or four modes."""
    run_lanes_with(rotate_many_lanes, loop)
