"""Needles that are pushed, all in one call of compiled code."""

from __future__ import annotations

from typing import Any, Final, NamedTuple, TYPE_CHECKING

from needle_dynamics.arrays import Array3, Array4, BoolVector, FloatArray, Matrix, Vector
from needle_dynamics.compiled.cache import kernel
from needle_dynamics.compiled.integrals import tip_deflections
from needle_dynamics.compiled.step import adapted, advance, Inputs, Needle
from needle_dynamics.compiled.tissue import Layers
import numpy as np

if TYPE_CHECKING:
    from needle_dynamics.compiled.held import Held

#: Time of a step [s], longest step of the integrator [s], and largest force [N].
PERIOD, STEP, FORCE = 0.01, 1e-3, 15.0

#: A needle is there when it is nearer [m] and slower [m/s].
NEAR, SLOW = 2e-4, 1e-3

#: Price of force in the reward [1/N^2].
PRICE: Final = 1e-5

#: Units of an observation: error [m], velocity [m/s], depth [m], deflection [m].
UNITS: Final = (0.1, 0.1, 0.1, 1e-3)

#: Observations are cut here, which nothing sane comes near.
BOUND: Final = 1e3


class Tissues(NamedTuple):
    """
    Layers of tissue of several needles: the fields of `Layers`.

    Attributes
    ----------
    starts, stiffnesses : ndarray, shape (n, layers)
        As in `Layers`, as are the others.
    gram : ndarray, shape (n, layers, modes, modes)
        Of each needle.
    area, moment : ndarray, shape (n, layers, modes)
        Of each needle.

    """

    starts: Matrix
    stiffnesses: Matrix
    gram: Array4
    area: Array3
    moment: Array3


class Pushed(NamedTuple):
    """
    Some needles.

    Attributes
    ----------
    common : Needle
        What is the same for all.
    friction : ndarray, shape (n, 2)
        Coulomb friction [N] and viscous friction [N s/m] of each.
    layers : Tissues
        Layers of tissue of each.
    times : ndarray, shape (n,)
        Time of each [s].
    states : ndarray, shape (n, 2 (2 + modes))
        State of each.
    targets : ndarray, shape (n,)
        Depth of the target of each [m].

    """

    common: Needle
    friction: Matrix
    layers: Tissues
    times: Vector
    states: Matrix
    targets: Vector


@kernel
def push(held: Held[Pushed], actions: Vector, which: BoolVector) -> tuple[FloatArray, Any]:
    """
    Push some needles for a period.

    Parameters
    ----------
    held : Held of Pushed
        The needles; times and states are overwritten.
    actions : ndarray, shape (n,)
        Insertion forces, in parts of `FORCE`; what is beyond is cut.
    which : ndarray of bool, shape (n,)
        Those that are pushed.

    Returns
    -------
    rewards : ndarray, shape (n,)
        Errors of depth and price of force, with a minus [m]; 0 where not pushed.
    over : ndarray of bool, shape (n,)
        Where the needle rests at its target, or would have left its range.

    """
    c, friction, layers, times, states, targets = held.value
    n, u = states.shape[0], states.shape[1] // 2
    rewards, over = np.zeros(n), np.zeros(n, dtype=np.bool_)
    none = np.empty((0, 3))
    for k in range(n):
        if not which[k]:
            continue
        tissue = Layers(
            layers.starts[k], layers.stiffnesses[k], layers.gram[k], layers.area[k],
            layers.moment[k],
        )  # fmt: skip
        needle = adapted(c, friction[k, 0], friction[k, 1], tissue)
        force = FORCE * min(max(actions[k], -1.0), 1.0)
        inputs = Inputs(force, 0.0, 0.0, False)
        left, _ = advance(needle, states[k], times[k], inputs, STEP, False, PERIOD, none)
        times[k] += PERIOD - left
        error = abs(targets[k] - (c.length - states[k, 0]))
        if left > 0.0:
            rewards[k], over[k] = -1.0, True
        else:
            rewards[k] = -error - PRICE * force * force
            over[k] = error < NEAR and abs(states[k, u]) < SLOW
    return rewards, over


@kernel
def observe(held: Held[Pushed]) -> Any:
    """
    Return what is seen of needles.

    Parameters
    ----------
    held : Held of Pushed
        The needles.

    Returns
    -------
    ndarray of float32, shape (n, 4)
        Error of depth, velocity, depth and deflection of the tip, in `UNITS`.

    """
    c, _, _, _, states, targets = held.value
    tips, u = tip_deflections(c.modes, states), states.shape[1] // 2
    seen = np.empty((states.shape[0], 4), dtype=np.float32)
    for k in range(states.shape[0]):
        depth = c.length - states[k, 0]
        for i, value in enumerate((targets[k] - depth, -states[k, u], depth, tips[k])):
            seen[k, i] = min(max(value / UNITS[i], -BOUND), BOUND)
    return seen
