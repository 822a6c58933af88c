# SPDX-License-Identifier: Apache-2.0
"""Tissue layers along the needle."""

from math import expm1, inf
from typing import NamedTuple

from needle_dynamics.arrays import Array3, FloatArray, Matrix, Vector
from needle_dynamics.compiled.cache import compiled, inlined


class Layers(NamedTuple):
    """Tissue layers, and the contributions of the layers above to the integrals of the modes."""

    # With the tip in layer m, the integrals of k phi phi^T, k phi and k y phi are its stiffness
    # times the integrals without k, plus row m of ``gram``, ``area`` and ``moment``, all times
    # the swelling.
    starts: Vector  #: depths at which the layers begin [m], the first 0, shape (m,)
    stiffnesses: Vector  #: stiffness of each layer per length [N/m^2], shape (m,)
    gram: Array3  #: addition to the integral of k phi phi^T [N/m^2], shape (m, n, n)
    #: Additions to the integrals of k phi [N m^-3/2] and k y phi [N m^-1/2], shape (m, n).
    area: Matrix
    moment: Matrix


@inlined
def layer_at(starts: FloatArray, depth: float, layer: int = 0) -> int:
    """Return the layer at a depth [m], searched from ``layer``; at a border the lower layer."""
    while layer + 1 < starts.shape[0] and depth >= starts[layer + 1]:
        layer += 1
    while layer > 0 and depth < starts[layer]:
        layer -= 1
    return layer


@compiled
def time_to_layer(
    starts: FloatArray, stiffnesses: FloatArray, depth: float, velocity: float
) -> float:
    """Return the time to the next border between unlike layers [s], inf without border ahead."""
    soonest = inf
    for i in range(1, starts.shape[0]):
        ahead = (starts[i] - depth) / velocity if velocity != 0.0 else inf
        if 0.0 < ahead < soonest and stiffnesses[i] != stiffnesses[i - 1]:
            soonest = ahead
    return soonest


@compiled
def growth_at(swelling: float, swelling_time: float, time: float) -> float:
    """Return the stiffness factor at a time [s], from final increase and time constant [s]."""
    return 1.0 - swelling * expm1(-time / swelling_time) if swelling != 0.0 else 1.0
