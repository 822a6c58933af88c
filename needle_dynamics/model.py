r"""
Equations of motion of the needle in tissue, one method per equation.

The generalized coordinates are q = [d, theta, q1, ..., qn] and the state is X = [q, q_dot]:
eight numbers for n = 2. d is the length of needle outside the tissue, so that insertion
decreases it; the insertion force f_y is positive into the tissue. The formulation `complete` has
every term of Euler-Lagrange on T - V, equation (12); `as_printed` is the source's final form,
which leaves out the row of d and what comes from dG/dt.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isfinite
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_dynamics.errors import (
    InsertedLengthError,
)
from needle_dynamics.friction import Friction
from needle_dynamics.modes import mode_shapes, ModeShapes
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.tissue import Tissue
from needle_ros.errors import (
    ParameterError,
    ShapeError,
)
import numpy as np
from numpy.typing import ArrayLike

#: Rounding of an inserted length, relative to the needle's length.
ROUNDING: Final = 1e-12


@dataclass(frozen=True)
class NeedleModel:
    """
    The Lagrangian model of needle and tissue for one set of constants.

    Attributes
    ----------
    parameters : NeedleParameters
        Constants, SI units.
    modes : ModeShapes
        Shape modes of the needle.
    tissue : Tissue
        Elastic foundation.
    friction : Friction
        Friction along the insertion axis.

    """

    parameters: NeedleParameters
    modes: ModeShapes = field(init=False, repr=False)
    tissue: Tissue = field(init=False, repr=False)
    friction: Friction = field(init=False, repr=False)

    def __post_init__(self) -> None:
        p = self.parameters
        # Without the stop the needle may overshoot the hub by as much as its length.
        reach = 1.0 if p.hub_stop else 2.0
        object.__setattr__(self, 'modes', mode_shapes(p.length, p.modes, reach))
        object.__setattr__(self, 'tissue', p.tissue)
        object.__setattr__(self, 'friction', p.friction)

    @property
    def coordinates(self) -> int:
        """Number of generalized coordinates, 2 + n."""
        return 2 + self.modes.count

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        """Names of the generalized coordinates, in order: d, theta, q1, ..., qn."""
        return ('d', 'theta', *(f'q{i + 1}' for i in range(self.modes.count)))

    def checked_state(self, state: ArrayLike) -> FloatArray:
        """
        Return the state as an array, or say what is wrong with it.

        Parameters
        ----------
        state : array_like, shape (2 (2 + n),)
            X = [d, theta, q1, ..., qn] and its rates, SI units.

        Returns
        -------
        ndarray, shape (2 (2 + n),)
            A copy.

        Raises
        ------
        ShapeError
            If the shape is wrong or a number is not finite.
        InsertedLengthError
            If the inserted length is outside its range.

        """
        try:
            checked = np.array(state, dtype=float)
        except (TypeError, ValueError):
            raise ShapeError(f'state must be numbers, got {state!r}') from None
        if checked.shape != (2 * self.coordinates,):
            raise ShapeError(
                f'state must have shape ({2 * self.coordinates},), got {checked.shape}'
            )
        if not np.isfinite(checked).all():
            raise ShapeError(f'state must be finite, got {checked.tolist()}')
        p = self.parameters
        depth = p.length - checked[0]
        high = self.modes.reach * p.length
        # The inserted length is a difference: its ends are met up to rounding.
        if not p.minimum_depth - ROUNDING * p.length <= depth <= high:
            raise InsertedLengthError(
                f'inserted length {depth:.6g} m is outside [{p.minimum_depth:g}, {high:g}] m '
                '(minimum_depth to the hub)'
            )
        return checked

    def state_at(self, depth: float, tip_deflection: float = 0.0) -> FloatArray:
        """
        Return the state at rest with a given inserted length and tip deflection.

        The shape is the one a lateral force at the tip would hold: the least elastic energy
        for that deflection. (The source gives the deflection of the tip alone.)

        Parameters
        ----------
        depth : float
            Inserted length s [m].
        tip_deflection : float
            w(s) [m].

        Returns
        -------
        ndarray, shape (2 (2 + n),)
            State.

        Raises
        ------
        InsertedLengthError
            If ``depth`` is outside its range.
        ShapeError
            If a number is not finite.

        """
        state = np.zeros(2 * self.coordinates)
        state[0] = self.parameters.length - depth
        state = self.checked_state(state)
        value = self.modes.integrals(depth).value
        shape = np.linalg.solve(self.stiffness_matrix(depth), value)
        state[2 : self.coordinates] = shape * (tip_deflection / (value @ shape))
        return self.checked_state(state)

    def stiffness_matrix(self, depth: float, time: float = 0.0) -> FloatArray:
        """
        Modal stiffness E I_y H + k_a G of needle and tissue, from (12).

        Parameters
        ----------
        depth : float
            Inserted length s [m].
        time : float
            Time [s], for tissue that swells.

        Returns
        -------
        ndarray, shape (n, n)
            Stiffness [N/m] for modal coordinates in m^3/2.

        """
        bending = self.parameters.bending_stiffness * self.modes.integrals(depth).curvature_gram
        return np.asarray(bending + self.tissue.matrix(self.modes, depth, time))

    def mass_matrix(self, state: ArrayLike) -> FloatArray:
        """
        Mass matrix M(q) of (13): symmetric, positive definite, block diagonal.

        Parameters
        ----------
        state : array_like, shape (2 (2 + n),)
            State.

        Returns
        -------
        ndarray, shape (2 + n, 2 + n)
            Mass matrix.

        """
        p, x = self.parameters, self.checked_state(state)
        matrix = np.zeros((self.coordinates, self.coordinates))
        matrix[0, 0] = p.moving_mass
        matrix[1, 1] = 0.5 * p.rotary_inertia
        matrix[2:, 2:] = p.linear_density * self.modes.integrals(p.length - x[0]).gram
        return matrix

    def bias_forces(self, state: ArrayLike, time: float = 0.0) -> FloatArray:
        """
        Bias forces N(q, q_dot) of (13): elastic, inertial and tissue damping.

        Parameters
        ----------
        state : array_like, shape (2 (2 + n),)
            State.
        time : float
            Time [s], for tissue that swells.

        Returns
        -------
        ndarray, shape (2 + n,)
            N in M q_ddot + N = F - F_f.

        """
        p, x, m = self.parameters, self.checked_state(state), self.coordinates
        depth = p.length - x[0]
        at = self.modes.integrals(depth)
        modal, rate, d_rate = x[2:m], x[m + 2 :], x[m]
        bias = np.zeros(m)
        bias[2:] = self.stiffness_matrix(depth, time) @ modal + p.tissue_damping * at.gram @ rate
        if p.formulation == 'complete':
            tip_rate = at.value @ rate
            bias[0] = 0.5 * (
                p.linear_density * tip_rate**2
                - p.bending_stiffness * (at.curvature @ modal) ** 2
                - self.tissue.stiffness(depth, time) * (at.value @ modal) ** 2
            )
            bias[2:] -= p.linear_density * d_rate * at.value * tip_rate
        return bias

    def acceleration(
        self, state: ArrayLike, force: float = 0.0, torque: float = 0.0, time: float = 0.0
    ) -> FloatArray:
        """
        Forward dynamics, equations (16)-(17).

        Parameters
        ----------
        state : array_like, shape (2 (2 + n),)
            State.
        force : float
            Insertion force f_y at the base [N], positive into the tissue.
        torque : float
            Torque tau about x [N m].
        time : float
            Time [s], for tissue that swells.

        Returns
        -------
        ndarray, shape (2 + n,)
            q_ddot.

        """
        x = self.checked_state(state)
        if not (isfinite(force) and isfinite(torque)):
            raise ParameterError(f'force and torque must be finite, got {force!r} and {torque!r}')
        bias = self.bias_forces(x, time)
        # Q_d = -f_y: what pushes the needle in shortens d.
        drive = force + bias[0]
        applied = np.array(
            [
                self.friction.force(-x[self.coordinates], drive) - force,
                torque,
                *np.zeros(self.modes.count),
            ]
        )
        return np.asarray(np.linalg.solve(self.mass_matrix(x), applied - bias))

    def inverse_dynamics(
        self, state: ArrayLike, acceleration: ArrayLike, time: float = 0.0
    ) -> FloatArray:
        """
        Return the forces that bring about an acceleration, equation (16) the other way.

        Parameters
        ----------
        state : array_like, shape (2 (2 + n),)
            State.
        acceleration : array_like, shape (2 + n,)
            q_ddot. From rest friction acts against the motion that begins; held at rest it
            takes the value within its bounds that asks for the least force.
        time : float
            Time [s], for tissue that swells.

        Returns
        -------
        ndarray, shape (2 + n,)
            Insertion force f_y [N], positive into the tissue, torque tau [N m], and the
            generalized force on each modal coordinate.

        Raises
        ------
        ShapeError
            If a shape is wrong or a number is not finite.

        """
        x, m = self.checked_state(state), self.coordinates
        wanted = np.array(acceleration, dtype=float)
        if wanted.shape != (m,) or not np.isfinite(wanted).all():
            raise ShapeError(f'acceleration must be finite with shape ({m},), got {wanted}')
        forces = self.mass_matrix(x) @ wanted + self.bias_forces(x, time)
        speed = -x[m]
        # At rest an endless drive decides: friction is what it can bear, in that direction.
        drive = -np.sign(wanted[0]) * np.inf if wanted[0] != 0.0 else forces[0]
        forces[0] = -forces[0] + self.friction.force(speed, drive)
        return np.asarray(forces)

    def friction_power(self, state: ArrayLike) -> float:
        """
        Power that friction takes, f_f s_dot with (15).

        Parameters
        ----------
        state : array_like, shape (2 (2 + n),)
            State.

        Returns
        -------
        float
            Power [W], never negative.

        """
        speed = -self.checked_state(state)[self.coordinates]
        return float(self.friction.force(speed, 0.0) * speed)

    def base_reaction(
        self, state: ArrayLike, force: float = 0.0, torque: float = 0.0, time: float = 0.0
    ) -> FloatArray:
        """
        Return what the base exerts on the needle, by balance of momentum over the inserted part.

        Parameters
        ----------
        state : array_like, shape (2 (2 + n),)
            State.
        force, torque : float
            Insertion force [N], positive into the tissue, and torque [N m] on the carriage.
        time : float
            Time [s], for tissue that swells.

        Returns
        -------
        ndarray, shape (3,)
            Axial force along y [N], lateral force along z [N], moment about x at the base [N m].

        """
        p, x, m = self.parameters, self.checked_state(state), self.coordinates
        n, depth, speed = self.modes.count, p.length - x[0], -x[m]
        modal, rate = x[2:m], x[m + 2 :]
        acceleration = self.acceleration(x, force, torque, time)
        at, tissue = self.modes.integrals(depth), self.tissue
        layer = max(int(np.searchsorted(tissue.starts, depth, side='right')) - 1, 0)
        above = tissue.offsets(self.modes)[layer, -2 * n :].reshape(2, n)
        integrals = np.array([at.area, at.moment])
        held = tissue.growth(time) * (tissue.stiffnesses[layer] * integrals + above)
        # The part that enters brings the momentum of the tip, at a lever of the depth.
        entering = speed * (at.value @ rate) * np.array([1.0, depth])
        inertia = p.linear_density * (integrals @ acceleration[2:] + entering)
        lateral, about_entry = inertia + held @ modal + p.tissue_damping * integrals @ rate
        axial = force + p.carriage_mass * acceleration[0]
        return np.array([axial, lateral, about_entry + x[0] * lateral + torque])

    def derivative(
        self, state: ArrayLike, force: float = 0.0, torque: float = 0.0, time: float = 0.0
    ) -> FloatArray:
        """
        Right-hand side of the state equation (18), for any ODE solver.

        Parameters
        ----------
        state : array_like, shape (2 (2 + n),)
            State.
        force : float
            Insertion force f_y [N], positive into the tissue.
        torque : float
            Torque tau about x [N m].
        time : float
            Time [s], for tissue that swells.

        Returns
        -------
        ndarray, shape (2 (2 + n),)
            X_dot.

        """
        x = np.asarray(state, dtype=float)
        return np.concatenate([x[self.coordinates :], self.acceleration(x, force, torque, time)])

    def kinetic_energy(self, state: ArrayLike) -> float:
        """
        Kinetic energy T of (12).

        Parameters
        ----------
        state : array_like, shape (2 (2 + n),)
            State.

        Returns
        -------
        float
            Energy [J].

        """
        rate = self.checked_state(state)[self.coordinates :]
        return float(0.5 * rate @ self.mass_matrix(state) @ rate)

    def potential_energy(self, state: ArrayLike, time: float = 0.0) -> float:
        """
        Potential energy V of needle and tissue, from (12).

        Parameters
        ----------
        state : array_like, shape (2 (2 + n),)
            State.

        Returns
        -------
        float
            Energy [J].

        """
        x = self.checked_state(state)
        modal = x[2 : self.coordinates]
        stiffness = self.stiffness_matrix(self.parameters.length - x[0], time)
        return float(0.5 * modal @ stiffness @ modal)

    def energy(self, state: ArrayLike, time: float = 0.0) -> float:
        """
        Total energy T + V.

        Parameters
        ----------
        state : array_like, shape (2 (2 + n),)
            State.

        Returns
        -------
        float
            Energy [J].

        """
        return self.kinetic_energy(state) + self.potential_energy(state, time)

    def tip_deflection(self, state: ArrayLike) -> float:
        """
        Deflection of the tip Y = w(s, t), the model's output.

        Parameters
        ----------
        state : array_like, shape (2 (2 + n),)
            State.

        Returns
        -------
        float
            Deflection [m] along z.

        """
        x = self.checked_state(state)
        value = self.modes.integrals(self.parameters.length - x[0]).value
        return float(value @ x[2 : self.coordinates])

    def shape(self, state: ArrayLike, points: int = 50) -> FloatArray:
        """
        Points of the inserted needle from the entry point to the tip, equation (10).

        Parameters
        ----------
        state : array_like, shape (2 (2 + n),)
            State.
        points : int
            Number of points, at least 2.

        Returns
        -------
        ndarray, shape (points, 2)
            y and w(y) [m].

        """
        x = self.checked_state(state)
        if not isinstance(points, int) or points < 2:
            raise ShapeError(f'points must be an integer >= 2, got {points!r}')
        y = np.linspace(0.0, self.parameters.length - x[0], points)
        return np.column_stack([y, self.modes.values(y) @ x[2 : self.coordinates]])
