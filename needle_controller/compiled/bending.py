# SPDX-License-Identifier: Apache-2.0
"""
Bending of the inserted part in the coordinates of the observer.

The filter state of each normal mode is c = omega a and b = a_dot, both in sqrt(J): without
damping the transition over any time is a rotation.
"""

from math import cos, sin, sqrt
from typing import NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.cache import inlined
from needle_dynamics.compiled.integrals import mode_integrals, ModeIntegrals
from needle_dynamics.compiled.normal_modes import modal_stiffness, normal_modes, NormalModes, swing
from needle_dynamics.compiled.step import CompiledNeedle
from needle_dynamics.compiled.tissue import layer_at
import numpy as np


class Frozen(NamedTuple):
    """Needle constants and modes at a frozen depth."""

    depth: float  #: insertion depth [m]
    growth: float  #: stiffness factor of swelling
    layer: int  #: index of the layer that contains the tip
    stiffness: float  #: stiffness of the tissue at the tip [N/m^2]
    at: ModeIntegrals
    modes: NormalModes


@inlined
def freeze(needle: CompiledNeedle, depth: float, growth: float, modes: NormalModes) -> Frozen:
    """Return modes and tissue at an insertion depth [m]; ``modes`` is overwritten."""
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
    Return cc, cb, bc, bb: after a time t [s] a mode has c of cc c + cb b and b of bc c + bb b.

    ``rate`` is the damping [1/s] and ``square`` the squared natural frequency [1/s^2] of the mode.
    """
    omega = sqrt(square)
    pp, pv, _, vv = swing(rate, square, t)
    return pp, omega * pv, -omega * pv, vv


@inlined
def _means(rate: float, since: float, until: float) -> tuple[float, float]:
    middle, half = 0.5 * rate * (since + until), 0.5 * rate * (until - since)
    # The next term is below 1e-18.
    mean = sin(half) / half if abs(half) > 1e-4 else 1.0 - half * half / 6.0
    return mean * cos(middle), mean * sin(middle)


@inlined
def change_basis(
    old: NormalModes, new: NormalModes, since: float, until: float, change: FloatArray
) -> None:
    """
    Compute the change of c and b from the normal modes of one depth to the modes of another depth.

    q and the momenta rho A G q_dot are continuous. The depth changes at a constant rate from
    ``since`` to ``until`` [s], relative to the time of the new modes: the coupling between modes
    is the mean over the rotation in between. Slow modes do not rotate in this time and take the
    full change; fast modes keep only the part that conserves the action energy / omega. The new
    modes take the signs of the old modes. ``change``, shape (2 n, 2 n), is overwritten.
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
def base_impulse(needle: CompiledNeedle, f: Frozen, velocity: float, rows: FloatArray) -> None:
    """
    Compute the impulse of force and moment at the base per change of c and b, shape (2, 2 n).

    The balance of momentum over the inserted part relates the integral of the state over a time to
    the change of the state. ``velocity`` is the insertion velocity [m/s].
    """
    n = f.modes.squares.shape[0]
    rho, damping = needle.linear_density, needle.tissue_damping
    rate = damping / rho
    integrals = (f.at.area, f.at.moment)
    above = (needle.layers.area, needle.layers.moment)
    for channel in range(2):
        weight, extra = integrals[channel], above[channel]
        # Entering length has the momentum of the tip, which decreases the momentum of the rest.
        entering = rho * velocity * (1.0 if channel == 0 else f.depth)
        for k in range(n):
            area, tip = 0.0, 0.0
            for i in range(n):
                area += weight[i] * f.modes.shapes[i, k]
                tip += f.at.value[i] * f.modes.shapes[i, k]
            entering -= rho * rho * velocity * area * tip
        for k in range(n):
            inertia, elastic, carried = 0.0, 0.0, 0.0
            for i in range(n):
                shape = f.modes.shapes[i, k]
                inertia += rho * weight[i] * shape
                elastic += (f.stiffness * weight[i] + f.growth * extra[f.layer, i]) * shape
                carried += (damping * weight[i] + entering * f.at.value[i]) * shape
            compliance = elastic / f.modes.squares[k]
            rows[channel, k] = (carried - compliance * rate) / sqrt(f.modes.squares[k])
            rows[channel, n + k] = inertia - compliance
    outside = needle.length - f.depth
    for k in range(2 * n):
        rows[1, k] += outside * rows[0, k]


@inlined
def tip_response(needle: CompiledNeedle, f: Frozen, rest: FloatArray, direct: FloatArray) -> None:
    """
    Compute the response to a constant lateral force of 1 N at the tip.

    ``rest``, shape (n,), takes c of each mode at rest [sqrt(J)/N]; ``direct``, shape (2,), the
    lateral force [1] and the moment about the base [m] that are not part of `base_impulse`.
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
            elastic = 0.0
            for i in range(n):
                tissue = f.stiffness * integrals[channel][i]
                tissue += f.growth * above[channel][f.layer, i]
                elastic += tissue * f.modes.shapes[i, k]
            direct[channel] += elastic / sqrt(f.modes.squares[k]) * rest[k]
    direct[1] += (needle.length - f.depth) * direct[0]
