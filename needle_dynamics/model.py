# SPDX-License-Identifier: Apache-2.0
"""
States, shapes and equations of motion of a flexible needle in soft tissue.

The generalized coordinates are q = [d, theta, q1, ..., qn] and the state is X = [q, q_dot]:
eight numbers for n = 2. d is the length of needle outside the tissue and decreases during
insertion; the insertion force f_y is positive into the tissue. The formulation `complete` has
every term of the Euler-Lagrange equations of T - V, equation (12). The formulation `as_printed`
is the final form in the source, which omits the row of d and the terms from dG/dt. `euler_loads`
are the buckling loads of the part outside the tissue.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import inf, isfinite, pi
from typing import Any, Final, NamedTuple

from needle_dynamics.arrays import FloatArray, floats
from needle_dynamics.compiled.integrals import ModeIntegrals, tip_deflections
from needle_dynamics.compiled.normal_modes import coupling
from needle_dynamics.compiled.step import CompiledNeedle
from needle_dynamics.compiled.tissue import Layers
from needle_dynamics.errors import InsertionDepthError
from needle_dynamics.friction import Friction
from needle_dynamics.modes import mode_shapes, ModeShapes
from needle_dynamics.parameters import NeedleParameters, Tissue
from needle_ros.errors import ParameterError, ShapeError
from needle_ros.settings import checked, is_whole
import numpy as np
from numpy.typing import ArrayLike

ROUNDING: Final = 1e-12  #: rounding tolerance of an insertion depth, relative to the needle length

#: First root of tan(x) = x: column clamped at one end and pinned at the other.
_PINNED: Final = 4.493409457909064


class _Instant(NamedTuple):
    """A checked state and the quantities that the equations need at it."""

    state: FloatArray
    #: Velocity of d, modal coordinates q1..qn and their rates.
    d_rate: float
    modal: FloatArray
    rate: FloatArray
    at: ModeIntegrals
    #: Tissue stiffness at the tip [N/m^2], and modal stiffness.
    tip_stiffness: float
    stiffness: FloatArray


@dataclass(frozen=True)
class NeedleModel:
    """
    Lagrangian model of needle and tissue for one set of constants.

    A state is X = [d, theta, q1, ..., qn] and its rates, shape (2 (2 + n),), in SI units.
    ``depth`` is the insertion depth s [m], ``time`` [s] counts for swelling tissue only. ``force``
    is the insertion force f_y at the base [N], positive into the tissue, ``torque`` is tau about x
    [N m]. The methods raise ShapeError or InsertionDepthError if a state is not valid.

    Examples
    --------
    A needle at rest at an insertion depth of 5 cm with a tip deflection of 1 mm:

    >>> from needle_dynamics import NeedleModel, NeedleParameters
    >>> model = NeedleModel(NeedleParameters.preset('phantom'))
    >>> state = model.state_at(0.05, tip_deflection=1e-3)
    >>> print(f'{model.tip_deflection(state):.4f} m')
    0.0010 m
    >>> print(f'{model.energy(state):.2g} J')
    0.00031 J

    """

    parameters: NeedleParameters  #: constants, SI units

    @cached_property
    def modes(self) -> ModeShapes:
        p = self.parameters
        return mode_shapes(p.length, p.modes, p.reach)

    @cached_property
    def tissue(self) -> Tissue:
        return self.parameters.tissue

    @cached_property
    def friction(self) -> Friction:
        return self.parameters.friction

    @cached_property
    def layers(self) -> Layers:
        """Integrals over the layers of the tissue."""
        return self.tissue.layers(self.modes)

    @cached_property
    def compiled(self) -> CompiledNeedle:
        """Needle constants in the layout of the compiled functions."""
        p = self.parameters
        own: dict[str, Any] = {
            'minimum_depth': p.minimum_depth - ROUNDING * p.length,
            'maximum_depth': self.modes.reach * p.length,
            'as_printed': p.formulation == 'as_printed',
            'friction': self.friction.constants,
            'modes': self.modes.tables,
            'layers': self.layers,
        }
        same = {name: getattr(p, name) for name in CompiledNeedle._fields if name not in own}
        return CompiledNeedle(**same, **own)

    @property
    def coordinates(self) -> int:
        """Number of generalized coordinates, 2 + n."""
        return 2 + self.parameters.modes

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        """Names of the generalized coordinates, in order: d, theta, q1, ..., qn."""
        return ('d', 'theta', *(f'q{i + 1}' for i in range(self.parameters.modes)))

    def checked_state(self, state: ArrayLike) -> FloatArray:
        """Return a copy of a state, or raise NeedleError."""
        found = floats('state', state, (2 * self.coordinates,))
        p = self.parameters
        depth = p.length - found[0]
        high = self.modes.reach * p.length
        # The insertion depth is a difference, so its limits hold up to rounding.
        if not p.minimum_depth - ROUNDING * p.length <= depth <= high:
            raise InsertionDepthError(
                f'insertion depth {depth:.6g} m is outside [{p.minimum_depth:g}, {high:g}] m '
                '(minimum_depth to the hub)'
            )
        return found

    def _stiffness(self, at: ModeIntegrals, depth: float, time: float) -> FloatArray:
        tissue, layer = self.tissue, self.tissue.layer(depth)
        above = self.layers.gram[layer]
        elastic = tissue.growth(time) * (tissue.stiffnesses[layer] * at.gram + above)
        return np.asarray(self.parameters.bending_stiffness * at.curvature_gram + elastic)

    def state_at(
        self, depth: float, tip_deflection: float = 0.0, modal: Sequence[float] = ()
    ) -> FloatArray:
        """
        Return the state at rest at an insertion depth [m], with a tip deflection [m] or shape.

        With a tip deflection w(s), the shape is the static shape under a lateral force at the tip,
        which has the least elastic energy for that deflection. (The source gives only the tip
        deflection.) ``modal``, q1 to qn [m^3/2], gives the shape instead. The beam is linear:
        valid up to a tip deflection of about a tenth of the insertion depth.
        """
        longest = self.parameters.length
        checked('tip_deflection', tip_deflection, 'm', low=-longest, high=longest)
        state = np.zeros(2 * self.coordinates)
        state[0] = longest - depth
        state = self.checked_state(state)
        if len(modal):
            if len(modal) != self.modes.count:
                raise ShapeError(f'modal must have {self.modes.count} numbers, got {modal!r}')
            if tip_deflection != 0.0:
                raise ParameterError(
                    'modal and tip_deflection both define the shape: '
                    f'one must be empty or 0, got {modal!r} and {tip_deflection!r} m'
                )
            state[2 : self.coordinates] = modal
            return self.checked_state(state)
        at = self.modes.integrals(depth)
        shape = np.linalg.solve(self._stiffness(at, depth, 0.0), at.value)
        state[2 : self.coordinates] = shape * (tip_deflection / (at.value @ shape))
        return self.checked_state(state)

    def stiffness_matrix(self, depth: float, time: float = 0.0) -> FloatArray:
        """Return the modal stiffness E I_y H + k_a G [N/m] from (12), shape (n, n)."""
        return self._stiffness(self.modes.integrals(depth), depth, time)

    def tip_deflection(self, state: ArrayLike) -> float:
        """Return the deflection of the tip Y = w(s, t) along z [m], the output of the model."""
        return float(self.tip_deflections(self.checked_state(state)[np.newaxis])[0])

    def tip_deflections(self, states: ArrayLike) -> FloatArray:
        """Return the tip deflections [m], shape (...), of many valid states; NaN for NaN."""
        x = np.ascontiguousarray(states, dtype=float)
        rows = x.reshape(-1, 2 * self.coordinates)
        return tip_deflections(self.modes.tables, rows).reshape(x.shape[:-1])

    def shape(self, state: ArrayLike, points: int = 50) -> FloatArray:
        """Return points y and w(y) [m] from entry point to tip, equation (10); (points, 2)."""
        x = self.checked_state(state)
        if not is_whole(points) or points < 2:
            raise ShapeError(f'points must be an integer >= 2, got {points!r}')
        y = np.linspace(0.0, self.parameters.length - x[0], points)
        return np.column_stack([y, self.modes.values(y) @ x[2 : self.coordinates]])

    def _instant(self, state: ArrayLike, time: float = 0.0) -> _Instant:
        x, m = self.checked_state(state), self.coordinates
        depth = self.parameters.length - x[0]
        at = self.modes.integrals(depth)
        tip_stiffness = self.tissue.stiffness(depth, time)
        stiffness = self._stiffness(at, depth, time)
        return _Instant(x, x[m], x[2:m], x[m + 2 :], at, tip_stiffness, stiffness)

    def mass_matrix(self, state: ArrayLike) -> FloatArray:
        """Return the mass matrix M(q) of (13), shape (2 + n, 2 + n): block diagonal."""
        return self._mass(self._instant(state).at)

    def _mass(self, at: ModeIntegrals) -> FloatArray:
        p = self.parameters
        matrix = np.zeros((self.coordinates, self.coordinates))
        matrix[0, 0] = p.moving_mass
        matrix[1, 1] = 0.5 * p.rotary_inertia
        matrix[2:, 2:] = p.linear_density * at.gram
        return matrix

    def bias_forces(self, state: ArrayLike, time: float = 0.0) -> FloatArray:
        """Return the bias forces N(q, q_dot) of (13), shape (2 + n,)."""
        return self._bias(self._instant(state, time))

    def _bias(self, now: _Instant) -> FloatArray:
        p, at = self.parameters, now.at
        bias = np.zeros(self.coordinates)
        bias[2:] = now.stiffness @ now.modal + p.tissue_damping * at.gram @ now.rate
        if p.formulation == 'complete':
            tip_rate, tip = float(at.value @ now.rate), float(at.value @ now.modal)
            bend = float(at.curvature @ now.modal)
            bias[0] = -coupling(
                p.linear_density, p.bending_stiffness, now.tip_stiffness, bend, tip, tip_rate
            )
            bias[2:] -= p.linear_density * now.d_rate * at.value * tip_rate
        return bias

    def acceleration(
        self, state: ArrayLike, force: float = 0.0, torque: float = 0.0, time: float = 0.0
    ) -> FloatArray:
        """Return the acceleration q_ddot, shape (2 + n,), by forward dynamics (16)-(17)."""
        now = self._instant(state, time)
        if not (isfinite(force) and isfinite(torque)):
            raise ParameterError(f'force and torque must be finite, got {force!r} and {torque!r}')
        bias = self._bias(now)
        applied = np.zeros(self.coordinates)
        # Q_d = -f_y: a force into the tissue shortens d.
        applied[0] = self.friction.force(-now.d_rate, force + bias[0]) - force
        applied[1] = torque
        return np.asarray(np.linalg.solve(self._mass(now.at), applied - bias))

    def inverse_dynamics(
        self, state: ArrayLike, acceleration: ArrayLike, time: float = 0.0
    ) -> FloatArray:
        """
        Return the forces, shape (2 + n,), that produce an acceleration q_ddot, equation (16).

        They are f_y [N], tau [N m], and the generalized force on each modal coordinate. From rest,
        friction opposes the starting motion; if the needle stays at rest, friction takes the value
        within its bounds that minimizes the required force.
        """
        now, m = self._instant(state, time), self.coordinates
        wanted = floats('acceleration', acceleration, (m,))
        forces = self._mass(now.at) @ wanted + self._bias(now)
        # From rest, an infinite drive gives the friction that opposes the starting motion.
        drive = -np.sign(wanted[0]) * np.inf if wanted[0] != 0.0 else forces[0]
        forces[0] = -forces[0] + self.friction.force(-now.d_rate, drive)
        return np.asarray(forces)

    def derivative(
        self, state: ArrayLike, force: float = 0.0, torque: float = 0.0, time: float = 0.0
    ) -> FloatArray:
        """Return X_dot of the state equation (18), for any ODE solver."""
        x = np.asarray(state, dtype=float)
        return np.concatenate([x[self.coordinates :], self.acceleration(x, force, torque, time)])

    def kinetic_energy(self, state: ArrayLike) -> float:
        """Return the kinetic energy T of (12) [J]."""
        now = self._instant(state)
        rate = now.state[self.coordinates :]
        return float(0.5 * rate @ self._mass(now.at) @ rate)

    def potential_energy(self, state: ArrayLike, time: float = 0.0) -> float:
        """Return the potential energy V of needle and tissue [J], from (12)."""
        now = self._instant(state, time)
        return float(0.5 * now.modal @ now.stiffness @ now.modal)

    def energy(self, state: ArrayLike, time: float = 0.0) -> float:
        """Return the total energy T + V [J]."""
        return self.kinetic_energy(state) + self.potential_energy(state, time)


class EulerLoads(NamedTuple):
    """Euler buckling loads of the part outside the tissue, clamped at the base [N]."""

    free: float  #: free end, as before the tip has entered
    pinned: float  #: pinned at the entry point: rotation is free, lateral displacement is zero


def euler_loads(parameters: NeedleParameters, depth: float) -> EulerLoads:
    """
    Return the Euler buckling loads of the part of the needle outside the tissue.

    A needle guide shortens the part that can buckle; it is not modeled.

    Parameters
    ----------
    parameters : NeedleParameters
        The needle.
    depth : float
        Insertion depth [m].

    Returns
    -------
    EulerLoads
        Both loads [N]; infinite if the needle is fully inserted.

    Examples
    --------
    >>> from needle_dynamics import euler_loads, NeedleParameters
    >>> loads = euler_loads(NeedleParameters.preset('phantom'), 0.02)
    >>> print(f'{loads.free:.1f} N, {loads.pinned:.1f} N')
    1.9 N, 16.0 N

    """
    if not 0.0 <= depth < inf:
        raise InsertionDepthError(f'insertion depth must be finite and >= 0, got {depth!r} m')
    outside = parameters.length - depth
    if outside <= 0.0:
        return EulerLoads(inf, inf)
    stiffness = parameters.bending_stiffness / outside**2
    return EulerLoads(0.25 * pi**2 * stiffness, _PINNED**2 * stiffness)
