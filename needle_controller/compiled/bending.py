"""
The bending of the inserted part as the observer's filter has it.

For each normal mode the filter holds c = omega a and b = a_dot, both in sqrt(J), so that without
damping the modes turn: the transition over any time is a rotation.
"""

from __future__ import annotations

from math import cos, sin, sqrt
from typing import NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.cache import inlined
from needle_dynamics.compiled.integrals import mode_integrals, ModeIntegrals
from needle_dynamics.compiled.normal_modes import modal_stiffness, normal_modes, NormalModes
from needle_dynamics.compiled.oscillator import swing
from needle_dynamics.compiled.step import Needle
from needle_dynamics.compiled.tissue import layer_at
import numpy as np


class Frozen(NamedTuple):
    """
    The needle at a frozen depth.

    Attributes
    ----------
    depth : float
        Inserted length [m].
    growth : float
        Factor by which the tissue has grown stiffer by swelling.
    layer : int
        Layer that holds the tip.
    stiffness : float
        Stiffness of the tissue at the tip [N/m^2].
    at : ModeIntegrals
        Shape modes and their integrals.
    modes : NormalModes
        Normal modes.

    """

    depth: float
    growth: float
    layer: int
    stiffness: float
    at: ModeIntegrals
    modes: NormalModes


@inlined
def freeze(needle: Needle, depth: float, growth: float, modes: NormalModes) -> Frozen:
    """
    Return the needle at a frozen depth.

    Parameters
    ----------
    needle : Needle
        The needle.
    depth : float
        Inserted length [m].
    growth : float
        Factor by which the tissue has grown stiffer by swelling.
    modes : NormalModes
        Overwritten; part of the result.

    Returns
    -------
    Frozen
        Modes and tissue at that depth.

    """
    n = modes.squares.shape[0]
    grids, rows = np.empty((3, n, n)), np.empty((4, n))
    at = ModeIntegrals(grids[0], grids[1], rows[0], rows[1], rows[2], rows[3])
    mode_integrals(needle.modes, depth, np.empty(needle.modes.series.shape[1] + 4 * n), at)
    layer = layer_at(needle.layers.starts, depth)
    stiffness = growth * needle.layers.stiffnesses[layer]
    modal_stiffness(
        needle.bending_stiffness, at, stiffness, growth, needle.layers, layer, grids[2]
    )
    normal_modes(needle.linear_density, at, grids[2], modes)
    return Frozen(depth, growth, layer, stiffness, at, modes)


@inlined
def turn(rate: float, square: float, t: float) -> tuple[float, float, float, float]:
    """
    Return the transition of c and b of one mode over a time.

    Parameters
    ----------
    rate : float
        Damping of the rates [1/s].
    square : float
        Square of the natural frequency omega [1/s^2].
    t : float
        Time [s].

    Returns
    -------
    cc, cb, bc, bb : float
        c after t is cc c + cb b, and b is bc c + bb b.

    """
    omega = sqrt(square)
    pp, pv, _, vv = swing(rate, square, t)
    return pp, omega * pv, -omega * pv, vv


@inlined
def _means(rate: float, since: float, until: float) -> tuple[float, float]:
    """Return the means of cos(rate t) and sin(rate t) over a time."""
    middle, half = 0.5 * rate * (since + until), 0.5 * rate * (until - since)
    # The next term is below 1e-18.
    mean = sin(half) / half if abs(half) > 1e-4 else 1.0 - half * half / 6.0
    return mean * cos(middle), mean * sin(middle)


@inlined
def change_basis(
    old: NormalModes,
    new: NormalModes,
    since: float,
    until: float,
    change: FloatArray,
) -> None:
    """
    Write how c and b change from the normal modes of one depth to those of another.

    q and the momenta rho A G q_dot go on as they are. The depth changes evenly, not at once: what
    one mode gives to another is the mean over the rotation in between. Slow modes do not turn and
    take the change as it is. Of fast ones only the part remains that keeps the action
    energy / omega.

    Parameters
    ----------
    old, new : NormalModes
        Normal modes at both depths. The new ones take the signs of the old ones.
    since, until : float
        Time over which the depth changes, from that of the new modes [s].
    change : ndarray, shape (2 n, 2 n)
        Overwritten: c and b in the new modes from those in the old ones.

    """
    n = new.squares.shape[0]
    for i in range(n):
        along = 0.0
        for j in range(n):
            along += new.inverse[i, j] * old.shapes[j, i]
        if along < 0.0:
            for j in range(n):
                new.shapes[j, i], new.inverse[i, j] = -new.shapes[j, i], -new.inverse[i, j]
        one = sqrt(new.squares[i])
        for k in range(n):
            other = sqrt(new.squares[k])
            positions, momenta = 0.0, 0.0
            for j in range(n):
                positions += new.inverse[i, j] * old.shapes[j, k]
                momenta += new.shapes[j, i] * old.inverse[k, j]
            same = 1.0 if i == k else 0.0
            by_c = positions * one / sqrt(old.squares[k]) - same
            by_b = momenta - same
            # The small change diag(by_c, by_b) is a rotation and a reflection.
            rotation, reflection = 0.5 * (by_c + by_b), 0.5 * (by_c - by_b)
            cos_d, sin_d = _means(other - one, since, until)
            cos_s, sin_s = _means(other + one, since, until)
            change[i, k] = same + rotation * cos_d + reflection * cos_s
            change[i, n + k] = rotation * sin_d + reflection * sin_s
            change[n + i, k] = reflection * sin_s - rotation * sin_d
            change[n + i, n + k] = same + rotation * cos_d - reflection * cos_s


@inlined
def base_impulse(needle: Needle, f: Frozen, velocity: float, rows: FloatArray) -> None:
    """
    Write the impulse of the lateral force and of the moment at the base per change of c and b.

    It follows from the balance of momentum over the inserted part, as in
    `needle_dynamics.model.NeedleModel.base_reaction`: what the integral of the state over a time
    is, the change of the state over that time says.

    Parameters
    ----------
    needle : Needle
        The needle.
    f : Frozen
        The needle at the mean depth.
    velocity : float
        Insertion velocity [m/s].
    rows : ndarray, shape (2, 2 n)
        Overwritten, for the force in the first row and for the moment about the base in the
        second one.

    """
    n = f.modes.squares.shape[0]
    rho, damping = needle.linear_density, needle.tissue_damping
    rate = damping / rho
    integrals = (f.at.area, f.at.moment)
    above = (needle.layers.area, needle.layers.moment)
    for channel in range(2):
        weight, extra = integrals[channel], above[channel]
        # What enters brings the momentum of the tip, and the inserted part is slowed by it.
        entering = rho * velocity * (1.0 if channel == 0 else f.depth)
        for k in range(n):
            area, tip = 0.0, 0.0
            for i in range(n):
                area += weight[i] * f.modes.shapes[i, k]
                tip += f.at.value[i] * f.modes.shapes[i, k]
            entering -= rho * rho * velocity * area * tip
        for k in range(n):
            inertia, held, carried = 0.0, 0.0, 0.0
            for i in range(n):
                shape = f.modes.shapes[i, k]
                inertia += rho * weight[i] * shape
                held += (f.stiffness * weight[i] + f.growth * extra[f.layer, i]) * shape
                carried += (damping * weight[i] + entering * f.at.value[i]) * shape
            compliance = held / f.modes.squares[k]
            rows[channel, k] = (carried - compliance * rate) / sqrt(f.modes.squares[k])
            rows[channel, n + k] = inertia - compliance
    outside = needle.length - f.depth
    for k in range(2 * n):
        rows[1, k] += outside * rows[0, k]


@inlined
def tip_response(needle: Needle, f: Frozen, rest: FloatArray, direct: FloatArray) -> None:
    """
    Write what a constant lateral force of 1 N at the tip does.

    Parameters
    ----------
    needle : Needle
        The needle.
    f : Frozen
        The needle at the mean depth.
    rest : ndarray, shape (n,)
        Overwritten with c of each mode at rest under the force [sqrt(J)/N].
    direct : ndarray, shape (2,)
        Overwritten with the lateral force [1] and the moment about the base [m] beyond what
        `base_impulse` says of the motion of c and b.

    """
    n = f.modes.squares.shape[0]
    integrals, above = (f.at.area, f.at.moment), (needle.layers.area, needle.layers.moment)
    arms = (1.0, f.depth)
    for k in range(n):
        tip = 0.0
        for i in range(n):
            tip += f.at.value[i] * f.modes.shapes[i, k]
        rest[k] = tip / sqrt(f.modes.squares[k])
    for channel in range(2):
        direct[channel] = -arms[channel]
        for k in range(n):
            held = 0.0
            for i in range(n):
                tissue = f.stiffness * integrals[channel][i]
                tissue += f.growth * above[channel][f.layer, i]
                held += tissue * f.modes.shapes[i, k]
            direct[channel] += held / sqrt(f.modes.squares[k]) * rest[k]
    direct[1] += (needle.length - f.depth) * direct[0]
