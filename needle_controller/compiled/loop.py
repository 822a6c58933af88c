# SPDX-License-Identifier: Apache-2.0
"""Closed loop of a sampled law and the simulated needle, for batches of runs."""

from needle_controller.compiled.laws import (
    answer,
    axis_step,
    law_step,
    LawConstants,
    LawTuple,
    MEMORY,
)
from needle_dynamics.arrays import FloatArray, Matrix, Vector
from needle_dynamics.compiled.cache import inlined, kernel
from needle_dynamics.compiled.friction import friction_flow, FrictionConstants
from needle_dynamics.compiled.step import adapted, advance, CompiledNeedle, Inputs
import numpy as np


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


@kernel
def run_loop(  # noqa: C901
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
    force. ``added``, shape (m, 3), has depths above which Coulomb and viscous friction [N s/m] are
    added, until the next row. ``longest`` is the longest step [s].

    Outputs, the first three unused if empty: at the measurements ``depths``, shape (k + 1,), and
    ``states``, shape (k + 1, 2 (2 + n)); ``commands``, shape (k,); ``errors``, shape (3,), goal
    without waits minus insertion depth: last, largest in modulus, and mean square [m^2].
    """
    memory, none = np.zeros(MEMORY), np.empty((0, 3))
    period, delay, m = LawConstants(*law).period, pending.shape[0], state.shape[0] // 2
    count = setpoints.shape[0]
    largest, squares, acts, waited = 0.0, 0.0, 0.0, 0
    for k in range(count + 1):
        depth, velocity = c.length - state[0], -state[m]
        if depths.shape[0] > 0:
            depths[k] = depth
        if states.shape[0] > 0:
            for i in range(len(state)):
                states[k, i] = state[i]
        error = goal[k] - depth
        largest = max(largest, abs(error))
        squares += error * error
        errors[0], errors[1], errors[2] = error, largest, squares / (k + 1)
        if k == count:
            break
        if noise.shape[0] > 0:
            depth, velocity = depth + noise[k, 0], velocity + noise[k, 1]
        aim = setpoints[k - waited]
        instant = (depth, velocity, aim[0], aim[1], aim[2])
        newest = pending[delay - known :]
        command = answer(law, memory, newest, instant, acts, 0.0, limit, np.nan)
        to_go = setpoints[count - 1, 0] - goal[k - waited]
        if abs(command) >= limit and command * to_go > 0.0:
            waited += 1
        if commands.shape[0] > 0:
            commands[k] = command
        # Force of this period according to the law.
        acts = pending[delay - known] if known > 0 else command
        force = _delayed(pending, command)
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
