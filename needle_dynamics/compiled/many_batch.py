# SPDX-License-Identifier: Apache-2.0
"""Batches of needles with three or four modes, compiled when such needles are first simulated."""

from needle_dynamics.arrays import Array3, IntVector, Matrix, Vector
from needle_dynamics.compiled.cache import kernel
from needle_dynamics.compiled.lane_rows import LaneModes
from needle_dynamics.compiled.lanes import BatchTrajectory, run_with
from needle_dynamics.compiled.many_lanes import rotate_many_lanes


@kernel
def run_many(
    needles: Matrix,
    modes: LaneModes,
    layers: Array3,
    trajectory: BatchTrajectory,
    runs: IntVector,
    states: Matrix,
    kept: Array3,
    completed: Vector,
) -> None:
    """Run `lanes.run_with` for needles with three or four modes."""
    run_with(rotate_many_lanes, needles, modes, layers, trajectory, runs, states, kept, completed)
