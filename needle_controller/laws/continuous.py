# SPDX-License-Identifier: Apache-2.0
"""Continuous-time control laws of section 3.2.7 of the paper, for analysis."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from math import copysign, inf
from typing import Final

from needle_controller.laws.law import BREAKAWAY_TIME
from needle_dynamics import FloatArray, NeedleModel
from needle_dynamics.arrays import floats
from needle_ros.errors import ParameterError, ShapeError
from needle_ros.settings import check_choice, checked
import numpy as np
from numpy.typing import ArrayLike

#: Actuated coordinates: base only (f_y, tau), or all coordinates, which is not realizable.
ACTUATIONS: Final = ('physical', 'modal')

_BASE: Final = 2  #: Coordinates of the base, d and theta.


def _gain_matrix(
    name: str, gains: ArrayLike, size: int, *, may_vanish: bool = False
) -> FloatArray:
    """Return gains of ``size`` coordinates as a matrix; reject indefinite gains."""
    matrix = floats(name, gains)
    if matrix.shape not in ((size,), (size, size)):
        raise ShapeError(
            f'{name} must have shape ({size},) or ({size}, {size}), one gain for each driven '
            f'coordinate or a matrix; got shape {matrix.shape}'
        )
    if matrix.ndim == 1:
        matrix = np.diag(matrix)
    least = float(np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[0])
    # Rounding of the eigenvalues of a singular matrix.
    floor = -1e-12 * np.abs(matrix).max() if may_vanish else 0.0
    if least < floor or (least == 0.0 and not may_vanish):
        kind = 'semidefinite' if may_vanish else 'definite'
        raise ParameterError(
            f'{name} must be positive {kind}, got a symmetric part with eigenvalue {least:.6g}'
        )
    matrix.setflags(write=False)
    return matrix


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ContinuousLaw(ABC):
    """
    Control law in continuous time: a function of state, goal and integral of the error.

    States X = [d, theta, q1, ..., qn] and rates have shape (2 (2 + n),), goals q, q_dot and q_ddot
    have shape (3, 2 + n).
    """

    model: NeedleModel  #: nominal model of needle and tissue; the plant may differ
    #: ``physical``: f_y and tau only. ``modal``: a generalized force on every coordinate, as in
    #: the gain matrices of the paper.
    actuation: str = 'physical'

    @property
    def driven(self) -> int:
        """Number of driven coordinates, from the start of q."""
        return _BASE if self.actuation == 'physical' else self.model.coordinates

    @property
    def integrals(self) -> int:
        """Number of integrals of the error in the state of the closed loop."""
        return 0

    def errors(self, state: FloatArray, goal: ArrayLike) -> FloatArray:
        """Return e = q_d - q, its rate, and the desired acceleration; shape (3, driven)."""
        m, k = self.model.coordinates, self.driven
        wanted = floats('goal', goal, (3, m))
        wanted[0] -= state[:m]
        wanted[1] -= state[m:]
        return wanted[:, :k]

    @abstractmethod
    def forces(
        self, state: ArrayLike, goal: ArrayLike, integral: ArrayLike = (), time: float = 0.0
    ) -> FloatArray:
        """
        Return the forces at a time [s], for tissue that swells; shape (2 + n,).

        They are f_y [N], positive into the tissue, tau [N m], and the generalized force on each
        q_i [N m^-1/2]. The integral of the errors of the driven coordinates has shape
        (integrals,).
        """


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ContinuousInverseDynamics(ContinuousLaw):
    """
    F_c = M(q) (q_ddot_d + k_v e_dot + k_p e) + N', section 3.2.7.1.

    N' are the bias forces with friction. At rest, friction is compensated in the direction of the
    desired acceleration, so that the law breaks away.
    """

    #: Gains [1/s^2] and [1/s], positive definite, shape (driven,) or (driven, driven).
    kp: ArrayLike
    kv: ArrayLike
    #: If positive, dry friction is compensated in proportion to the desired velocity
    #: BREAKAWAY_TIME later, up to this speed [m/s]: the limit of the sampled law for short
    #: periods. 0 is the law of the paper.
    breakaway_speed: float = 0.0
    _gains: tuple[FloatArray, FloatArray] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        check_choice('actuation', self.actuation, ACTUATIONS)
        checked('breakaway_speed', self.breakaway_speed, 'm/s', low=0.0)
        kp, kv = (_gain_matrix(name, getattr(self, name), self.driven) for name in ('kp', 'kv'))
        object.__setattr__(self, '_gains', (kp, kv))

    def forces(
        self, state: ArrayLike, goal: ArrayLike, integral: ArrayLike = (), time: float = 0.0
    ) -> FloatArray:
        del integral
        model, k, m = self.model, self.driven, self.model.coordinates
        x = model.checked_state(state)
        error, rate, wanted = self.errors(x, goal)
        acceleration = np.zeros(m)
        acceleration[:k] = wanted + self._gains[1] @ rate + self._gains[0] @ error
        forces = model.inverse_dynamics(x, acceleration, time)
        if self.breakaway_speed > 0.0:
            inertial = model.mass_matrix(x)[0] @ acceleration + model.bias_forces(x, time)[0]
            forces[0] = self._friction(-x[m], -acceleration[0]) - inertial
        forces[k:] = 0.0
        return forces

    def _friction(self, velocity: float, acceleration: float) -> float:
        """Return viscous friction plus the compensated share of dry friction [N]."""
        law = self.model.friction
        lean = (velocity + BREAKAWAY_TIME * acceleration) / self.breakaway_speed
        lean = min(max(lean, -1.0), 1.0)
        # Dry friction in the direction of the lean; at rest, break-away friction.
        sign, modulus = copysign(1.0, lean), abs(velocity)
        ahead = 1.0 if lean > 0.0 else law.withdrawal
        dry = law.force(sign * modulus, sign * inf) - sign * ahead * law.viscous * modulus
        viscous = law.viscous * velocity * (1.0 if velocity > 0.0 else law.withdrawal)
        return abs(lean) * dry + viscous


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ContinuousPid(ContinuousLaw):
    """F = k_p e + k_i int e dt + k_v e_dot, section 3.2.7.2."""

    #: Gains, positive definite, shape (driven,) or (driven, driven); the paper writes k_v for kd.
    kp: ArrayLike
    kd: ArrayLike
    ki: ArrayLike | None = None  #: integral gain, positive semidefinite; None: no integral
    _gains: tuple[FloatArray, FloatArray, FloatArray] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        check_choice('actuation', self.actuation, ACTUATIONS)
        k = self.driven
        ki = np.zeros(k) if self.ki is None else self.ki
        gains = (
            _gain_matrix('kp', self.kp, k),
            _gain_matrix('kd', self.kd, k),
            _gain_matrix('ki', ki, k, may_vanish=True),
        )
        object.__setattr__(self, '_gains', gains)

    @property
    def integrals(self) -> int:
        """Number of integrals: the driven coordinates, or 0 without integral gain."""
        return 0 if self.ki is None else self.driven

    def forces(
        self, state: ArrayLike, goal: ArrayLike, integral: ArrayLike = (), time: float = 0.0
    ) -> FloatArray:
        del time
        x, k = self.model.checked_state(state), self.driven
        error, rate, _ = self.errors(x, goal)
        summed = floats('integral', integral, (self.integrals,))
        forces = np.zeros(self.model.coordinates)
        forces[:k] = self._gains[0] @ error + self._gains[1] @ rate
        if self.integrals:
            forces[:k] += self._gains[2] @ summed
        # Q_d = -f_y.
        forces[0] = -forces[0]
        return forces


def acceleration(
    model: NeedleModel, state: ArrayLike, forces: ArrayLike, time: float = 0.0
) -> FloatArray:
    """Return q_ddot of (16)-(17) under `ContinuousLaw.forces`; both have shape (2 + n,)."""
    x, applied = model.checked_state(state), floats('forces', forces, (model.coordinates,))
    result = model.acceleration(x, float(applied[0]), float(applied[1]), time)
    if applied[_BASE:].any():
        # The mass matrix is block diagonal: forces on q1..qn do not act on the base.
        modal = model.mass_matrix(x)[_BASE:, _BASE:]
        result[_BASE:] += np.linalg.solve(modal, applied[_BASE:])
    return result
