# SPDX-License-Identifier: Apache-2.0
"""Batches of needles with three or four modes, compiled when such needles are first simulated."""

from needle_dynamics.compiled.cache import kernel
from needle_dynamics.compiled.lanes import LaneBatch, run_with
from needle_dynamics.compiled.many_lanes import rotate_many_lanes


@kernel
def run_many(batch: LaneBatch) -> None:
    """Run `lanes.run_with` for needles with three or four modes."""
    run_with(rotate_many_lanes, batch)
