# SPDX-License-Identifier: Apache-2.0
"""Closed loops with needles of three or four modes, compiled when they are first simulated."""

from needle_controller.compiled.laws import LawTuple
from needle_controller.compiled.loop import run_lanes_with
from needle_dynamics.arrays import Array3, IntVector, Matrix, Vector
from needle_dynamics.compiled.cache import kernel
from needle_dynamics.compiled.lane_rows import LaneModes
from needle_dynamics.compiled.many_lanes import rotate_many_lanes


@kernel
def run_many_lanes(
    needles: Matrix,
    modes: LaneModes,
    layers: Array3,
    law: LawTuple,
    limit: float,
    setpoints: Array3,
    goal: Matrix,
    counts: IntVector,
    delays: IntVector,
    known: int,
    noise: Array3,
    longest: float,
    which: IntVector,
    starts: Matrix,
    motions: Array3,
    commands: Matrix,
    completed: Vector,
) -> None:
    """Run `loop.run_lanes_with` for needles with three or four modes."""
    run_lanes_with(
        rotate_many_lanes, needles, modes, layers, law, limit, setpoints, goal, counts, delays,
        known, noise, longest, which, starts, motions, commands, completed,
    )  # fmt: skip
