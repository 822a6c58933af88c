# SPDX-License-Identifier: Apache-2.0
"""Closed loop of a sampled law and the simulated needle, for batches of runs."""

from __future__ import annotations

from typing import NamedTuple, TYPE_CHECKING

from needle_controller.compiled.filter import Filter
from needle_controller.compiled.laws import (
    adapt,
    answer,
    axis_step,
    law_step,
    LawConstants,
    LawTuple,
    MEMORY,
)
from needle_controller.compiled.loop_observer import LoopObserver, observed_load
from needle_dynamics.arrays import (
    Array3,
    BoolArray,
    FloatArray,
    IntArray,
    IntVector,
    Matrix,
    Vector,
)
from needle_dynamics.compiled.cache import inlined, kernel
from needle_dynamics.compiled.friction import friction_flow, FrictionConstants
from needle_dynamics.compiled.integrals import tip_deflections
from needle_dynamics.compiled.lane_rows import (
    ACCELERATION,
    DEPTH,
    FORCE,
    INSIDE,
    LaneModes,
    LEFT,
    TIME,
    TIP,
    VELOCITY,
)
from needle_dynamics.compiled.lanes import (
    empty_lanes,
    load_lane,
    rotate_two_lanes,
    Rotation,
    step_lanes,
    swap_lanes,
    tip_lanes,
)
from needle_dynamics.compiled.step import adapted, advance, CompiledNeedle, Inputs
import numpy as np

if TYPE_CHECKING:
    from needle_dynamics.compiled.boxed import Boxed


@inlined
def _delayed(pending: FloatArray, command: float) -> float:
    """Append a command to the pending commands; return the command that acts now."""
    delay = len(pending)
    if delay == 0:
        return command
    force = float(pending[0])
    for i in range(1, delay):
        pending[i - 1] = pending[i]
    pending[delay - 1] = command
    return force


@inlined
def _waits(command: float, limit: float, to_go: float) -> int:
    return 1 if abs(command) >= limit and command * to_go > 0.0 else 0


@inlined
def _past(commands: FloatArray, run: int, k: int) -> float:
    """Return an earlier command of a run; zero before the first."""
    return float(commands[run, k]) if k >= 0 else 0.0


@kernel
def run_loop(
    c: CompiledNeedle,
    state: Vector,
    law: LawTuple,
    limit: float,
    setpoints: Matrix,
    goal: Vector,
    pending: Vector,
    known: int,
    noise: Matrix,
    added: Matrix,
    longest: float,
    observer: LoopObserver,
    boxed: Boxed[Filter],
    depths: Vector,
    states: Matrix,
    commands: Vector,
    errors: Vector,
) -> int:
    """
    Run a sampled law of insertion with the simulated needle; return the completed periods.

    They are fewer than k if the needle leaves its range. Positions are in m, velocities in m/s,
    forces in N.

    ``state``, shape (2 (2 + n),), takes the final state; ``limit`` is the largest force. For each
    of k commands ``setpoints``, shape (k, 3), has position, velocity and acceleration; ``goal``,
    shape (k + 1,), the reference at the measurements. While the force is at its limit towards the
    last setpoint the reference waits, as in `ReferenceHold`. ``pending``, shape (delay,), are
    commands without effect so far, updated, of which the law compensates the newest ``known``.
    ``noise``, shape (k, 3) or (0, 3), has errors of measured position and velocity, and additional
    force; with an observer, whose load the law compensates from the next period on, a fourth
    column has errors of the measured tip deflection. ``added``, shape (m, 3), has depths above
    which Coulomb and viscous friction [N s/m] are added, until the next row. ``longest`` is the
    longest step [s].

    Outputs, the first three unused if empty: at the measurements ``depths``, shape (k + 1,), and
    ``states``, shape (k + 1, 2 (2 + n)); ``commands``, shape (k,); ``errors``, shape (3,), goal
    without waits minus insertion depth: last, largest in modulus, and mean square [m^2].
    """
    memory, none, load = np.zeros(MEMORY), np.empty((0, 3)), 0.0
    observer.memory[:] = 0.0
    period, m = LawConstants(*law).period, state.shape[0] // 2
    count = setpoints.shape[0]
    largest, squares, waited = 0.0, 0.0, 0
    # Force of the last period, and pending commands, according to the law.
    forces = np.zeros(1 + known)
    forces[1:] = pending[pending.shape[0] - known :]
    for k in range(count + 1):
        depth, velocity = c.length - state[0], -state[m]
        if depths.shape[0] > 0:
            depths[k] = depth
        if states.shape[0] > 0:
            states[k] = state
        error = goal[k] - depth
        largest = max(largest, abs(error))
        squares += error * error
        errors[0], errors[1], errors[2] = error, largest, squares / (k + 1)
        if k == count:
            break
        if noise.shape[0] > 0:
            depth, velocity = depth + noise[k, 0], velocity + noise[k, 1]
        at = k - waited
        instant = (depth, velocity, setpoints[at, 0], setpoints[at, 1], setpoints[at, 2])
        if observer.memory.shape[0] > 0:
            tip = tip_deflections(c.modes, state.reshape(1, -1))[0] + noise[k, 3]
            load = observed_load(boxed, observer, 0, k * period, period, depth, velocity, tip)
        command = answer(law, memory, forces, instant, load, limit, np.nan)
        waited += _waits(command, limit, setpoints[count - 1, 0] - goal[at])
        force = _delayed(pending, command)
        if commands.shape[0] > 0:
            commands[k] = command
        if noise.shape[0] > 0:
            force += noise[k, 2]
        inputs = Inputs(force, 0.0, 0.0, False)
        needle = c
        for row in added:
            if c.length - state[0] >= row[0]:
                needle = adapted(
                    c, c.friction.coulomb + row[1], c.friction.viscous + row[2], c.layers
                )
        left, _ = advance(needle, state, k * period, inputs, longest, False, period, none)
        if left != 0.0:
            return k
    return int(count)


class LaneLoop(NamedTuple):
    """Needles of closed loops, their inputs, and results; as for `run_loop` if not described."""

    #: As in `lanes.LaneBatch`.
    needles: Matrix
    modes: LaneModes
    layers: Array3
    law: LawTuple
    limit: float
    #: With a leading axis of runs, in falling order of the periods, and long enough for all.
    setpoints: Array3
    goal: Matrix
    counts: IntVector  #: periods of each run
    delays: IntVector  #: periods until a command acts, before which no force acts
    known: int
    noise: Array3
    longest: float
    observer: LoopObserver  #: an observer for each row in `which`, or none
    which: IntVector  #: rows of the runs to compute, at most one for each lane
    starts: Matrix  #: initial states
    #: Results: insertion depth, velocity and tip deflection at the measurements, shape
    #: (runs, 3, k + 1); commands; completed periods.
    motions: Array3
    commands: Matrix
    completed: Vector


@inlined
def run_lanes_with(rotate: Rotation, loop: LaneLoop, boxed: Boxed[Filter]) -> None:
    """Run a law with needles in lanes as `run_loop`; ``rotate`` advances their modes."""
    needles, modes, layers, law, limit, setpoints, goal, counts, delays = loop[:9]
    known, noise, longest, observer, which, starts, motions, commands, completed = loop[9:]
    n, period = len(which), LawConstants(*law).period
    w, memory, acts = empty_lanes(modes), np.zeros((n, MEMORY)), np.zeros(n)
    waited, inside = np.zeros(n, dtype=np.int64), np.ones(n, dtype=np.bool_)
    observer.memory[:] = 0.0
    # Lanes change places; the run of each.
    order = np.arange(n)
    for i in range(n):
        load_lane(w, i, needles, which[i], starts[which[i]], modes)
    _keep(w, n, modes, which, order, inside, motions, 0)
    for k in range(counts[which[0]]):
        for i in range(n - 1, -1, -1):
            if counts[which[order[i]]] <= k:
                n -= 1
                _swap(w, order, i, n)
        for i in range(n):
            own = order[i]
            run, at = which[own], k - waited[own]
            # As `answer`: arrays of pending commands would take longer than the law.
            depth, velocity = w[DEPTH + i] + noise[run, k, 0], w[VELOCITY + i] + noise[run, k, 1]
            tip, now = motions[run, 2, k] + noise[run, k, 3], k * period
            load = observed_load(boxed, observer, own, now, period, depth, velocity, tip)
            adapt(law, memory[own], depth, velocity, acts[own] - load)
            for late in range(known, 0, -1):
                force = _past(commands, run, k - late) - load
                depth, velocity = axis_step(law, depth, velocity, force)
            aim = setpoints[run, at, 0], setpoints[run, at, 1], setpoints[run, at, 2]
            command = law_step(law, memory[own], (depth, velocity, *aim), load, limit)
            commands[run, k] = command
            to_go = setpoints[run, counts[run] - 1, 0] - goal[run, at]
            waited[own] += _waits(command, limit, to_go)
            acts[own] = _past(commands, run, k - known)
            w[FORCE + i] = _past(commands, run, k - delays[run]) + noise[run, k, 2]
            w[LEFT + i], w[ACCELERATION + i], w[TIME + i] = period, 0.0, k * period
        # Lanes with a border between layers in this period take more steps.
        m = n
        while m > 0:
            step_lanes(rotate, w, m, modes, layers, longest, 0.0)
            for i in range(m - 1, -1, -1):
                inside[order[i]] &= w[INSIDE + i] != 0.0
                if w[LEFT + i] == 0.0:
                    m -= 1
                    _swap(w, order, i, m)
        _keep(w, n, modes, which, order, inside, motions, k + 1)
        for i in range(n):
            if inside[order[i]]:
                completed[which[order[i]]] = k + 1


@kernel
def run_lanes(loop: LaneLoop, boxed: Boxed[Filter]) -> None:
    """Run `run_lanes_with` for needles with one or two modes."""
    run_lanes_with(rotate_two_lanes, loop, boxed)


@inlined
def _swap(w: FloatArray, order: IntArray, i: int, j: int) -> None:
    if i != j:
        swap_lanes(w, i, j)
        order[i], order[j] = order[j], order[i]


@inlined
def _keep(
    w: FloatArray,
    n: int,
    modes: LaneModes,
    which: IntArray,
    order: IntArray,
    inside: BoolArray,
    motions: FloatArray,
    k: int,
) -> None:
    """Write the motion of each lane that is inside its range."""
    tip_lanes(w, n, modes)
    for i in range(n):
        if inside[order[i]]:
            run = which[order[i]]
            motions[run, 0, k], motions[run, 1, k] = w[DEPTH + i], w[VELOCITY + i]
            motions[run, 2, k] = w[TIP + i]


@kernel
def ring(
    law: LawTuple,
    friction: FrictionConstants,
    inertia: float,
    known: int,
    pending: Vector,
    start: float,
    count: int,
) -> tuple[float, float, int]:
    """
    Run a law from a position [m] to zero on a simulated axis, and measure its final oscillation.

    ``friction`` and ``inertia`` are of the true axis; ``known`` and ``pending`` as in `run_loop`;
    ``count`` is the number of periods in a third of the run. Returns the span of the position in
    the second and in the last third [m], and the number of reversals in the last third.
    """
    memory = np.zeros(MEMORY)
    period, delay = LawConstants(*law).period, pending.shape[0]
    position, velocity, turns, direction = start, 0.0, 0, 0.0
    spans = np.zeros(3)
    for part in range(3):
        low, high = position, position
        for _ in range(count):
            measured, rate = position, velocity
            for i in range(delay - known, delay):
                measured, rate = axis_step(law, measured, rate, pending[i])
            command = law_step(law, memory, (measured, rate, 0.0, 0.0, 0.0), 0.0, np.inf)
            force = _delayed(pending, command)
            velocity, moved = friction_flow(friction, inertia, velocity, force, period)
            position = position + moved
            low, high = min(low, position), max(high, position)
            if velocity * direction < 0.0 and part == 2:
                turns += 1
            if velocity != 0.0:
                direction = velocity
        spans[part] = high - low
    return float(spans[1]), float(spans[2]), turns
