# SPDX-License-Identifier: Apache-2.0
"""Simulate and observe many pushed needles in one call of compiled code."""

from __future__ import annotations

from typing import Any, Final, NamedTuple, TYPE_CHECKING

from needle_dynamics.arrays import Array3, Array4, BoolVector, FloatArray, Matrix, Vector
from needle_dynamics.compiled.cache import kernel
from needle_dynamics.compiled.integrals import tip_deflections
from needle_dynamics.compiled.step import adapted, advance, CompiledNeedle, Inputs
from needle_dynamics.compiled.tissue import Layers
import numpy as np

if TYPE_CHECKING:
    from needle_dynamics.compiled.boxed import Boxed

#: Period of an action [s], longest step of the integrator [s], and largest force [N].
PERIOD, STEP, FORCE = 0.01, 1e-3, 15.0

#: Largest depth error [m] and speed [m/s] of a needle at rest at its target.
NEAR, SLOW = 2e-4, 1e-3

START: Final = 0.02  #: Depth at the start [m].

#: Rewards: of the whole way to the target, of an arrival, of a needle that leaves its range, of
#: a period, and of a period at the largest force.
WAY, ARRIVAL, LEFT, TIME, EFFORT = 1.0, 1.0, -2.0, -1e-3, -3e-3

#: Units of an observation: error [m], velocity [m/s], depth [m], deflection [m].
UNITS: Final = (0.1, 0.1, 0.1, 1e-3)

BOUND: Final = 1e3  #: limit of observations, far above any plausible value


class Tissues(NamedTuple):
    """Layers of tissue of n needles: the fields of `Layers`, each with a leading axis n."""

    starts: Matrix
    stiffnesses: Matrix
    gram: Array4
    area: Array3
    moment: Array3


class Pushed(NamedTuple):
    """State of n needles."""

    common: CompiledNeedle  #: constants that are the same for all
    #: Coulomb friction [N] and viscous friction [N s/m], shape (n, 2).
    friction: Matrix
    layers: Tissues
    #: Times [s], shape (n,), and states, shape (n, 2 (2 + modes)).
    times: Vector
    states: Matrix
    targets: Vector  #: target depths [m], shape (n,)


@kernel
def push(boxed: Boxed[Pushed], actions: Vector, which: BoolVector) -> tuple[FloatArray, Any]:
    """
    Push the needles of the mask `which` for a period by actions, fractions of `FORCE` in [-1, 1].

    Returns rewards, 0 where not pushed, and 1 where a needle has arrived, -1 where it has left its
    range, else 0.
    """
    c, friction, layers, times, states, targets = boxed.value
    n, u = states.shape[0], states.shape[1] // 2
    rewards, ends = np.zeros(n), np.zeros(n, dtype=np.int8)
    none = np.empty((0, 3))
    for k in range(n):
        if not which[k]:
            continue
        tissue = Layers(
            layers.starts[k], layers.stiffnesses[k], layers.gram[k], layers.area[k],
            layers.moment[k],
        )  # fmt: skip
        needle = adapted(c, friction[k, 0], friction[k, 1], tissue)
        part = min(max(actions[k], -1.0), 1.0)
        before = abs(targets[k] - (c.length - states[k, 0]))
        inputs = Inputs(FORCE * part, 0.0, 0.0, False)
        left, _ = advance(needle, states[k], times[k], inputs, STEP, False, PERIOD, none)
        times[k] += PERIOD - left
        error = abs(targets[k] - (c.length - states[k, 0]))
        rewards[k] = WAY * (before - error) / abs(targets[k] - START) + TIME + EFFORT * part * part
        if left > 0.0:
            ends[k] = -1
            rewards[k] += LEFT
        elif error < NEAR and abs(states[k, u]) < SLOW:
            ends[k] = 1
            rewards[k] += ARRIVAL
    return rewards, ends


@kernel
def observe(boxed: Boxed[Pushed]) -> Any:
    """Return depth error, velocity, depth and tip deflection, shape (n, 4), in `UNITS`."""
    c, _, _, _, states, targets = boxed.value
    tips, u = tip_deflections(c.modes, states), states.shape[1] // 2
    observed = np.empty((states.shape[0], 4), dtype=np.float32)
    for k in range(states.shape[0]):
        depth = c.length - states[k, 0]
        for i, value in enumerate((targets[k] - depth, -states[k, u], depth, tips[k])):
            observed[k, i] = min(max(value / UNITS[i], -BOUND), BOUND)
    return observed
