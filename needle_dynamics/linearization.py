# SPDX-License-Identifier: Apache-2.0
"""
Linearization (19) of the model at an operating point, with natural units.

The only equilibria of the model are straight needles. Elsewhere (19) holds along a motion, with
coefficients frozen at the operating point.
"""

from dataclasses import dataclass
from math import inf
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_dynamics.friction import Friction
from needle_dynamics.model import NeedleModel
from needle_ros.errors import NeedleError
from needle_ros.settings import check_choice, checked
import numpy as np
from numpy.typing import ArrayLike

#: Sliding directions and the sign of the insertion velocity.
SLIDING: Final = {'insertion': 1.0, 'withdrawal': -1.0}


class StuckError(NeedleError):
    """The friction law has no derivative: the needle is at rest without a sliding direction."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearSystem:
    """Linear system (19) at one operating point, SI units, of order N = 2 (2 + n)."""

    # With the deviations x of the state, u = [f_y, tau] of the inputs and y of the tip deflection,
    # x_dot = drift + A x + B u and y = C x + D u.

    A: FloatArray  #: state matrix, shape (N, N)
    B: FloatArray  #: input matrix, shape (N, 2)
    C: FloatArray  #: output matrix, shape (1, N)
    D: FloatArray  #: feedthrough, zero, shape (1, 2)
    drift: FloatArray  #: X_dot at the operating point; zero at an equilibrium, shape (N,)
    names: tuple[str, ...]  #: names of the states: d, theta, q1, ..., qn, d_dot, ...
    frequencies: FloatArray  #: natural frequencies of the inserted part, ascending [rad/s]
    transform: FloatArray  #: the state is this (N, N) times the state in natural units
    input_scales: FloatArray  #: natural units of force [N] and torque [N m], shape (2,)
    output_scale: float  #: natural unit of the tip deflection [m]

    @property
    def scaled_names(self) -> tuple[str, ...]:
        """Names of the states in natural units; a rate has the name of its coordinate."""
        bending = (f'bending {i + 1}' for i in range(len(self.frequencies)))
        return ('d', 'theta', *bending) * 2

    def scaled(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return A (N, N), B (N, 2) and C (1, N) in natural (dimensionless) units."""
        # The unit of time is 1 / omega_1 of the slowest mode of the inserted part. The unit of d
        # and of the tip deflection is the insertion depth s. Angles are in radians. One unit of
        # force or torque moves the needle or the rotor by one unit within the unit of time. The
        # bending is decomposed into its normal modes, displacement and rate in the energy norm:
        # the state of mode 1 is its root mean square deflection over s.
        slowest = self.frequencies[0]
        back = np.linalg.inv(self.transform)
        return (
            back @ self.A @ self.transform / slowest,
            back @ self.B * self.input_scales / slowest,
            self.C @ self.transform / self.output_scale,
        )


def operating_point(
    model: NeedleModel, depth: float, tip_deflection: float = 0.0, velocity: float = 0.0
) -> FloatArray:
    """Return the state, as `NeedleModel.state_at`, of a needle that moves at a velocity [m/s]."""
    state = model.state_at(depth, tip_deflection)
    state[model.coordinates] = -velocity
    return model.checked_state(state)


def linearize(
    model: NeedleModel,
    state: ArrayLike,
    force: float = 0.0,
    torque: float = 0.0,
    time: float = 0.0,
    sliding: str | None = None,
) -> LinearSystem:
    r"""
    Linearize the state equation (18) and the output at an operating point, equation (19).

    With g = phi phi^T and h = phi'' phi''^T at the tip, dG/ds = g and dH/ds = h, so that the
    modal rows rho A G a + K q + (c_a G - rho A d_dot g) q_dot = 0 give

    .. math:: \rho A\, G\, \partial a / \partial s = -[(E I_y h + k g) q + c_a g \dot q
        - \rho A\, \dot d\, g' \dot q + \rho A\, g a],

    and the row of d is differentiated likewise; `as_printed` has neither d_dot g nor that row.

    Parameters
    ----------
    model : NeedleModel
        The model.
    state : array_like, shape (2 (2 + n),)
        Operating point, SI units. At a layer boundary the deeper layer applies.
    force : float
        Insertion force f_y [N]. It enters the drift, and determines the direction in which a
        needle at rest breaks away.
    torque : float
        Torque tau [N m], part of the drift.
    time : float
        Time [s] at which the swelling is evaluated.
    sliding : str, optional
        ``insertion`` or ``withdrawal``: at rest, the branch of the friction law to differentiate
        (the limit of slow motion in that direction). Ignored if the needle moves or breaks away
        under the given forces.

    Returns
    -------
    LinearSystem
        A, B, C, D and the natural units.

    Raises
    ------
    StuckError
        If the needle is at rest, friction there has no derivative, and ``sliding`` is not given.

    Examples
    --------
    A straight needle that is inserted at 5 mm/s: neither input steers its deflection.

    >>> from needle_dynamics import analyze, linearize, NeedleModel, NeedleParameters
    >>> from needle_dynamics.linearization import operating_point
    >>> model = NeedleModel(NeedleParameters.preset('phantom'))
    >>> system = linearize(model, operating_point(model, depth=0.05, velocity=5e-3))
    >>> system.A.shape
    (8, 8)
    >>> found = analyze(system)
    >>> found.output_controllable, found.state.loss
    (False, 'q1, q2, q1_dot, q2_dot')

    """
    from scipy.linalg import eigh

    for name, number in (('force', force), ('torque', torque), ('time', time)):
        checked(name, number)
    p, x, m = model.parameters, model.checked_state(state), model.coordinates
    modal, d_rate, rate = x[2:m], x[m], x[m + 2 :]
    depth = p.length - x[0]
    at = model.modes.integrals(depth)
    slope, curl = (model.modes.derivatives(depth, order) for order in (1, 3))
    density, bending = p.linear_density, p.bending_stiffness
    layer = model.tissue.stiffness(depth, time)
    full = p.formulation == 'complete'
    convection = density * d_rate if full else 0.0
    tip, bend, tip_rate = at.value @ modal, at.curvature @ modal, at.value @ rate

    mass = density * at.gram
    stiffness = model.stiffness_matrix(depth, time)
    damping = p.tissue_damping * at.gram - convection * np.outer(at.value, at.value)
    squares, normal = eigh(stiffness, mass)
    compliance = normal @ normal.T  # the inverse of the modal mass
    acceleration = -compliance @ (stiffness @ modal + damping @ rate)
    by_depth = (
        bending * bend * at.curvature
        + (layer * tip + p.tissue_damping * tip_rate + density * (at.value @ acceleration))
        * at.value
        - convection * (tip_rate * slope + (slope @ rate) * at.value)
    )
    drive = force + model.bias_forces(x, time)[0]
    resistance, drag = _friction(model.friction, -d_rate, drive, sliding)

    a = np.zeros((2 * m, 2 * m))
    a[:m, m:] = np.eye(m)
    a[m, m] = -drag
    a[m + 2 :, 0] = compliance @ by_depth  # d = l - s
    a[m + 2 :, 2:m] = -compliance @ stiffness
    a[m + 2 :, m + 2 :] = -compliance @ damping
    if full:
        a[m, 0] = density * tip_rate * (slope @ rate)
        a[m, 0] -= bending * bend * (curl @ modal) + layer * tip * (slope @ modal)
        a[m, 2:m] = bending * bend * at.curvature + layer * tip * at.value
        a[m, m + 2 :] = -density * tip_rate * at.value
        a[m + 2 :, m] = density * tip_rate * compliance @ at.value
    a[m] /= p.moving_mass
    b = np.zeros((2 * m, 2))
    b[m, 0], b[m + 1, 1] = -1.0 / p.moving_mass, 2.0 / p.rotary_inertia
    c = np.zeros((1, 2 * m))
    c[0, 0], c[0, 2:m] = -slope @ modal, at.value
    drift = np.concatenate([x[m:], np.zeros(2), acceleration])
    drift[m] = (resistance - drive) / p.moving_mass
    drift[m + 1] = b[m + 1, 1] * torque

    frequencies = np.sqrt(squares)
    slowest = frequencies[0]
    energy = depth * slowest * np.sqrt(density * depth)
    transform = np.zeros_like(a)
    transform[0, 0], transform[m, m] = depth, depth * slowest
    transform[1, 1], transform[m + 1, m + 1] = 1.0, slowest
    transform[2:m, 2:m] = energy * normal / frequencies
    transform[m + 2 :, m + 2 :] = energy * normal
    push = (p.moving_mass * slowest + abs(drag)) * depth * slowest
    names = model.coordinate_names
    return LinearSystem(
        A=a,
        B=b,
        C=c,
        D=np.zeros((1, 2)),
        drift=drift,
        names=(*names, *(f'{name}_dot' for name in names)),
        frequencies=frequencies,
        transform=transform,
        input_scales=np.array([push, 0.5 * p.rotary_inertia * slowest**2]),
        output_scale=depth,
    )


def _friction(
    law: Friction, velocity: float, drive: float, sliding: str | None
) -> tuple[float, float]:
    """Return the friction force [N] and its derivative in the velocity [N s/m]."""
    if sliding is not None:
        check_choice('sliding', sliding, SLIDING)
    if velocity != 0.0:
        return law.force(velocity, drive), law.slope(velocity, velocity)
    ahead, back = law.force(0.0, inf), law.force(0.0, -inf)
    if drive > ahead or drive < back:
        direction = 1.0 if drive > ahead else -1.0
    elif sliding is not None:
        direction = SLIDING[sliding]
    elif ahead == back and law.slope(0.0, 1.0) == law.slope(0.0, -1.0):
        direction = 1.0
    else:
        raise StuckError(
            f'the needle is at rest and {drive:.3g} N does not move it: static friction, from '
            f'{back:.3g} to {ahead:.3g} N, has no derivative; give a velocity, a larger force, '
            f'or the branch to slide on ({" or ".join(SLIDING)})'
        )
    return (ahead if direction > 0.0 else back), law.slope(0.0, direction)
