# SPDX-License-Identifier: Apache-2.0
"""Responses of the tip and prior of the hypotheses of the steering controller."""

from typing import NamedTuple

from needle_dynamics.arrays import Array3, Array4, Matrix, Vector


class HypothesisResponses(NamedTuple):
    """Shifts of the tip at each depth, for g points of the grid, and their sums."""

    guide: Array3  #: per position of the guide in each step, shape (g, n + 1, n)
    #: Per origin [m], turn of the frame [rad], tilt, load of the bevel [N] without roll, and
    #: curvature of the path at each depth [1/m], shape (g, n + 1, 5 + n).
    causes: Array3
    bevel: Array3  #: per load of the bevel [N] on the skin, and in each step, (g, n + 1, n + 1)
    elastic: Matrix  #: of the resting tip per load of the bevel [m/N], shape (g, n + 1)
    #: The same for the force on the guide at its position of each step [N], with n rows.
    guide_load: Array3
    causes_load: Array3
    bevel_load: Array3
    #: Change of `guide` to the next bending length, to the next skin, and per logarithm of the
    #: stiffness of each layer, shape (2 + layers, g, n + 1, n).
    between: Array4
    lags: Matrix  #: largest lag of the roll of the tip behind the base [rad], shape (g, n + 1)
    #: Sums of the absolute values at the last depth: of `guide` from each step on, shape
    #: (g, n + 1), and of `bevel` from the skin and each step on, shape (g, n + 3).
    later_guide: Matrix
    later_bevel: Matrix


class StatePrior(NamedTuple):
    """Prior of the state, for g points of the grid and h hypotheses."""

    #: Covariance of the tips with tips and forces by origin, frame and tilt, and by a path noise
    #: of 1, shape (g, n + 1, 2 n + 1).
    known: Array3
    wandering: Array3
    #: Standard deviations of the constants except the slow error: load of the bevel [N], positions
    #: in units of the grid, and logarithms of the stiffness of layers, shape (3 + layers,).
    deviations: Vector
    noises: Vector  #: path noise by hypothesis [rad^2/m], shape (h,)
    drifts: Vector  #: standard deviation of the slow error by hypothesis [m], shape (h,)
    decay: Vector  #: correlation of the slow error over a step, shape (n,)
