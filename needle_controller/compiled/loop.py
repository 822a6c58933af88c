"""The closed loop of one sampled law and the simulated needle, for batches of runs."""

from __future__ import annotations

from needle_controller.compiled.laws import law_step, LawConstants, MEMORY
from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.cache import compiled
from needle_dynamics.compiled.friction import slide
from needle_dynamics.compiled.step import advance, Inputs, Needle
import numpy as np


@compiled
def run_loop(
    c: Needle,
    state: FloatArray,
    law: tuple[float, ...],
    axis: tuple[float, float, float],
    limit: float,
    setpoints: FloatArray,
    goal: FloatArray,
    pending: FloatArray,
    longest: float,
    depths: FloatArray,
    errors: FloatArray,
) -> int:
    """
    Run a sampled law of insertion around the simulated needle.

    Parameters
    ----------
    c : Needle
        The needle.
    state : ndarray, shape (2 (2 + n),)
        Initial state; overwritten with the state at the end.
    law : tuple of float
        Fields of `LawConstants`.
    axis : tuple of float
        Inertia [kg], Coulomb friction [N] and viscous friction [N s/m] that the law believes in.
    limit : float
        Largest force [N].
    setpoints : ndarray, shape (k, 3)
        Position, speed and acceleration that each command aims at.
    goal : ndarray, shape (k + 1,)
        Position of the reference at the times of the measurements [m].
    pending : ndarray, shape (delay,)
        Commands that have not yet taken effect [N]; overwritten.
    longest : float
        Longest step of the integrator [s].
    depths : ndarray, shape (k + 1,) or (0,)
        Overwritten with the inserted lengths at the times of the measurements [m]; empty if they
        are not needed.
    errors : ndarray, shape (3,)
        Overwritten with goal minus inserted length: last [m], largest in modulus [m] and mean
        square [m^2].

    Returns
    -------
    int
        Number of periods completed: fewer than k if the needle left its range.

    """
    inertia, coulomb, viscous = axis
    memory = np.zeros(MEMORY)
    period, delay, m = LawConstants(*law).period, pending.shape[0], state.shape[0] // 2
    count = setpoints.shape[0]
    largest, squares = 0.0, 0.0
    for k in range(count + 1):
        depth, speed = c.length - state[0], -state[m]
        if depths.shape[0] > 0:
            depths[k] = depth
        error = goal[k] - depth
        largest = max(largest, abs(error))
        squares += error * error
        errors[0], errors[1], errors[2] = error, largest, squares / (k + 1)
        if k == count:
            break
        for i in range(delay):
            speed, moved = slide(speed, pending[i], inertia, coulomb, viscous, period)
            depth = depth + moved
        aim = setpoints[k]
        instant = (depth, speed, aim[0], aim[1], aim[2])
        command = law_step(law, memory, instant, 0.0, limit)
        force = command
        if delay > 0:
            force = pending[0]
            for i in range(1, delay):
                pending[i - 1] = pending[i]
            pending[delay - 1] = command
        inputs = Inputs(force, 0.0, 0.0, False)
        left, _ = advance(c, state, k * period, inputs, longest, False, period)
        if left != 0.0:
            return k
    return int(count)
