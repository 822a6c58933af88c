r"""
The deflection as axes, and the sampled laws on all coordinates at once (`modal` actuation).

At an inserted length the modal rows of (16) are linear: rho A G q_ddot + c_a G q_dot +
(E I_y H + k_a G) q = Q. Their normal modes are oscillators of unit mass that do not know of each
other, with an exact response over a period. Coordinates are q = V eta, forces V^T Q. Gains are
one set for all q1..qn, as the source has them: k_p and k_v of inverse dynamics are the same in
normal coordinates, while k_p of PID, a force on each q_i, couples these through V^T V; so the law
is solved for all deflections together.

While the needle moves, dG/dt adds rho A d_dot g q_dot to the modal rows and the deflection pulls
on the row of d. The laws take both from the predicted state as loads, held over a period.

Tissue that swells is refused: a measurement does not say since when it has, and the check of
stability would have to hold for every stiffness that it comes to.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass, field, replace
from typing import Final

from needle_controller.compiled import laws as kernels
from needle_controller.compiled.laws import deflection_predict, deflection_step, separate
from needle_controller.laws.axis import Axis, Law, law_constants, no_memory, SampledLoop, Setpoint
from needle_controller.laws.inverse_dynamics import InverseDynamicsGains
from needle_controller.laws.pid import PidGains
from needle_dynamics import (
    FloatArray,
    NeedleModel,
)
from needle_dynamics.compiled.kernels import evaluate, evaluate_many
from needle_ros.errors import (
    ParameterError,
    ShapeError,
)
import numpy as np
from numpy.typing import ArrayLike

#: Forces that a modal loop answers with, beside those on q1..qn: f_y and tau.
_BASE: Final = 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NormalModes:
    """
    Normal modes of the inserted part at one depth.

    Attributes
    ----------
    depth : float
        Inserted length s [m].
    damping : float
        c_a / (rho A) [1/s], the same for all.
    table : ndarray, shape (2 n + TABLE, n)
        As from `needle_controller.compiled.laws.normal_modes`.

    """

    depth: float
    damping: float
    table: FloatArray

    @property
    def shapes(self) -> FloatArray:
        """V with V^T rho A G V = 1, shape (n, n)."""
        return self.table[: self.table.shape[1]]

    @property
    def inverse(self) -> FloatArray:
        """Inverse of V, shape (n, n)."""
        n = self.table.shape[1]
        return self.table[n : 2 * n]

    @property
    def squares(self) -> FloatArray:
        """Squares of the natural frequencies [1/s^2], ascending, shape (n,)."""
        return np.asarray(self.table[2 * self.table.shape[1] + kernels.SQUARES])

    @property
    def frequencies(self) -> FloatArray:
        """Natural frequencies [Hz], shape (n,)."""
        return np.asarray(np.sqrt(self.squares) / (2.0 * np.pi))

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Each mode as an axis of unit inertia."""
        return tuple(
            Axis(inertia=1.0, viscous=self.damping, stiffness=float(square))
            for square in self.squares
        )

    def to_normal(self, deflections: ArrayLike) -> FloatArray:
        """Return the normal coordinates of deflections, or of their rates, shape (n,)."""
        return np.asarray(self.inverse @ np.asarray(deflections, dtype=float))

    def from_normal(self, normal: ArrayLike) -> FloatArray:
        """Return the deflections q1..qn, or their rates, of normal coordinates, shape (n,)."""
        return np.asarray(self.shapes @ np.asarray(normal, dtype=float))

    def to_normal_force(self, forces: ArrayLike) -> FloatArray:
        """Return the force on each mode of generalized forces on q1..qn, shape (n,)."""
        return np.asarray(self.shapes.T @ np.asarray(forces, dtype=float))

    def from_normal_force(self, forces: ArrayLike) -> FloatArray:
        """Return the generalized forces on q1..qn of forces on each mode, shape (n,)."""
        return np.asarray(self.inverse.T @ np.asarray(forces, dtype=float))


class _Tabulate:
    """Evaluates `compiled.laws.normal_modes` at any depth, without a new array."""

    def __init__(self, model: NeedleModel, period: float) -> None:
        p, modes, self._tissue = model.parameters, model.modes, model.tissue
        n = modes.count
        self._length, self._series, self._terms = p.length, modes.series, modes.terms
        self._constants = modes.constants
        self._offsets = np.ascontiguousarray(model.tissue.offsets(modes))
        self._material = p.linear_density, p.bending_stiffness
        self._rest = p.tissue_damping, period
        self._at = np.empty(n * (n + 1) + 4 * n)
        self._work = np.empty(self._series.shape[1] + 4 * n)

    def __call__(self, depth: float, table: FloatArray) -> None:
        xi, work, at, starts = depth / self._length, self._work, self._at, self._tissue.starts
        if table.shape[1] == 2:
            evaluate(xi, self._series, self._terms, work, at)
        else:
            evaluate_many(xi, self._length, self._constants, self._series, work, at)
        layer = bisect_right(starts, depth) - 1
        stiffness = self._tissue.stiffnesses[layer]
        kernels.normal_modes(
            at, self._offsets[layer], *self._material, stiffness, *self._rest, table
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class DeflectionLaw:
    """
    A sampled law on the deflections q1..qn, by one set of gains.

    What it remembers is an array of shape (MEMORY, n) that is written in place.

    Attributes
    ----------
    model : NeedleModel
        Needle and tissue as the law believes them to be.
    gains : InverseDynamicsGains or PidGains
        Gains; they say which law it is. The tolerance and the anti-windup of PID have no
        meaning here: there is no Coulomb friction and no limit.
    period : float
        Sample period h [s].
    constants : ndarray, shape (CONSTANTS,)
        The law as the functions of `needle_controller.compiled.laws` take it.

    Raises
    ------
    ParameterError
        If the tissue of the model swells.

    """

    model: NeedleModel
    gains: InverseDynamicsGains | PidGains
    period: float
    constants: FloatArray = field(init=False, repr=False, compare=False)
    _tabulate: _Tabulate = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        gains = self.gains
        if self.model.parameters.swelling != 0.0:
            raise ParameterError(
                'swelling must be 0 with modal actuation, whose gains are for tissue that stays '
                f'as it is, got {self.model.parameters.swelling!r}'
            )
        slots = gains.slots(self.period) if isinstance(gains, PidGains) else gains.slots()
        p = self.model.parameters
        if p.formulation == 'complete':
            slots |= {'DENSITY': p.linear_density, 'BENDING': p.bending_stiffness, 'COUPLED': 1.0}
        constants = law_constants(self.period, gains.breakaway_speed, **slots)
        object.__setattr__(self, 'constants', constants)
        object.__setattr__(self, '_tabulate', _Tabulate(self.model, self.period))

    @property
    def count(self) -> int:
        """Number of deflections n."""
        return self.model.modes.count

    def scaled(self, factor: float) -> DeflectionLaw:
        """Return the same law with all gains times a factor."""
        return replace(self, gains=self.gains.scaled(factor))

    def at(self, depth: float) -> NormalModes:
        """
        Return the axes that the law acts on at an inserted length.

        Parameters
        ----------
        depth : float
            Inserted length s [m].

        Returns
        -------
        NormalModes
            With responses over the law's period.

        Raises
        ------
        ParameterError
            If ``depth`` is beyond the modes' reach or the needle is not inserted.

        """
        p, modes = self.model.parameters, self.model.modes
        if not 0.0 < depth <= modes.reach * p.length:
            raise ParameterError(
                f'inserted length must be > 0 m and <= {modes.reach * p.length:g} m, got {depth!r}'
            )
        table = np.empty((2 * self.count + kernels.TABLE, self.count))
        self.tabulate(depth, table)
        return NormalModes(depth=depth, damping=p.tissue_damping / p.linear_density, table=table)

    def tabulate(self, depth: float, table: FloatArray) -> None:
        """Write the table of `at` for a valid inserted length [m] into an array."""
        self._tabulate(depth, table)


class DeflectionLoop:
    """
    A law on the deflections with the delay of the graph.

    Parameters
    ----------
    law : DeflectionLaw
        Law.
    delay : int
        Periods from measurement to effect.

    """

    def __init__(self, law: DeflectionLaw, delay: int) -> None:
        self.law = law
        self.on_the_way: deque[FloatArray] = deque(
            [np.zeros(law.count) for _ in range(delay)], maxlen=delay
        )
        self.memory = no_memory(law.count)
        self.last = np.zeros(law.count)
        self._take_over = False

    def stop(self) -> None:
        """Nothing is on the way any more; what the law remembers stays as it is."""
        for i in range(len(self.on_the_way)):
            self.on_the_way[i] = np.zeros(self.law.count)
        self.last = np.zeros(self.law.count)
        self._take_over = False

    def reset(self) -> None:
        """Forget the past: nothing on the way, nothing remembered."""
        self.stop()
        self.memory[:] = 0.0

    def switch(self, law: DeflectionLaw) -> None:
        """Go on with another law, or other gains: its first forces are the last ones again."""
        if (law.period, law.count) != (self.law.period, self.law.count):
            raise ParameterError(
                f'period and number of modes must stay {self.law.period:g} s and '
                f'{self.law.count}, got {law.period!r} s and {law.count}'
            )
        self.law = law
        self._take_over = True

    def command(self, modes: NormalModes, x: FloatArray, target: FloatArray) -> FloatArray:
        """Return the forces on q1..qn while the base rests; arguments as in `answer`."""
        for force in self.on_the_way:
            x, _ = self.predict(modes, x, 0.0, force)
        return self.answer(modes, x, target, 0.0)[0]

    def predict(
        self, modes: NormalModes, x: FloatArray, speed: float, force: FloatArray
    ) -> tuple[FloatArray, float]:
        """
        Predict a period.

        Parameters
        ----------
        modes : NormalModes
            Axes at the depth.
        x : ndarray, shape (2, n)
            Deflections and rates.
        speed : float
            Insertion speed [m/s].
        force : ndarray, shape (n,)
            Generalized forces on q1..qn.

        Returns
        -------
        ndarray of shape (2, n), float
            Deflections and rates at its end, and the force of the bent needle against insertion
            at its beginning [N].

        """
        end = x.copy()
        against = deflection_predict(self.law.constants, modes.table, end, speed, force)
        return end, against

    def answer(
        self, modes: NormalModes, x: FloatArray, target: FloatArray, speed: float
    ) -> tuple[FloatArray, float]:
        """
        Return the forces from the state when they take effect.

        Parameters
        ----------
        modes : NormalModes
            Axes at the depth.
        x : ndarray, shape (2, n)
            Deflections and rates.
        target : ndarray, shape (3, n)
            Wanted deflections, rates and accelerations.
        speed : float
            Insertion speed [m/s].

        Returns
        -------
        ndarray of shape (n,), float
            Generalized forces on q1..qn, and the force of the bent needle against insertion [N].

        """
        return self.step(modes.table, x, target, speed)

    def step(
        self, table: FloatArray, x: FloatArray, target: FloatArray, speed: float
    ) -> tuple[FloatArray, float]:
        """Do what `answer` does, given the table of the modes."""
        force = self.last.copy()
        against = deflection_step(
            self.law.constants, self.memory, table, x, target, speed, self._take_over, force
        )
        self._take_over, self.last = False, force
        self.on_the_way.append(force)
        return force, against


class ModalLoop:
    """
    Laws on all coordinates at once, one generalized force on each (`modal` actuation).

    The modes are those at the depth in the middle of the time that the law looks ahead.

    Parameters
    ----------
    insertion, rotation : Law
        Laws of the base.
    deflection : DeflectionLaw
        Law of q1..qn; its model also gives the loads.
    delay : int
        Periods from measurement to effect.
    force_limit, torque_limit : float
        Largest insertion force [N] and torque [N m].

    Raises
    ------
    ParameterError
        If the laws do not have one period.

    """

    def __init__(
        self,
        insertion: Law,
        rotation: Law,
        deflection: DeflectionLaw,
        delay: int,
        *,
        force_limit: float,
        torque_limit: float,
    ) -> None:
        periods = insertion.period, rotation.period, deflection.period
        if len(set(periods)) > 1:
            raise ParameterError(f'all laws must have one period, got {periods} s')
        self.insertion = SampledLoop(insertion, delay, force_limit)
        self.rotation = SampledLoop(rotation, delay, torque_limit)
        self.deflection = DeflectionLoop(deflection, delay)
        n, model = deflection.count, deflection.model
        p = model.parameters
        self._delay, self._depths = delay, (p.minimum_depth, model.modes.reach * p.length)
        self._table, self._x = np.empty((2 * n + kernels.TABLE, n)), np.empty((2, n))

    def stop(self) -> None:
        """Nothing is on the way any more; what the laws remember stays as it is."""
        for loop in (self.insertion, self.rotation, self.deflection):
            loop.stop()

    def reset(self) -> None:
        """Forget the past: nothing on the way, nothing remembered."""
        for loop in (self.insertion, self.rotation, self.deflection):
            loop.reset()

    def switch(self, insertion: Law, rotation: Law, deflection: DeflectionLaw) -> None:
        """Go on with other laws or gains: their first forces are the last ones again."""
        self.insertion.switch(insertion)
        self.rotation.switch(rotation)
        self.deflection.switch(deflection)

    def command(
        self,
        state: ArrayLike,
        insertion: Setpoint,
        rotation: Setpoint,
        deflection: ArrayLike,
    ) -> FloatArray:
        """
        Return the forces to apply.

        Parameters
        ----------
        state : array_like, shape (2 (2 + n),)
            State X = [d, theta, q1, ..., qn] and rates, measured or estimated now.
        insertion, rotation : Setpoint
            References of inserted length and angle at the time the command takes effect.
        deflection : array_like, shape (3, n)
            Wanted q1..qn, rates and accelerations at that time.

        Returns
        -------
        ndarray, shape (2 + n,)
            f_y [N], positive into the tissue, tau [N m], and the generalized force on each q_i,
            as `NeedleModel.inverse_dynamics` gives them.

        Raises
        ------
        ShapeError, InsertedLengthError
            If the state is not valid.

        """
        law, sliding, turning = (
            self.deflection.law,
            self.insertion.law.axis,
            self.rotation.law.axis,
        )
        h, m = law.period, law.count + _BASE
        table, x = self._table, self._x
        now = np.ascontiguousarray(state, dtype=float)
        target = np.ascontiguousarray(deflection, dtype=float)
        if now.shape != (2 * m,) or target.shape != (3, law.count) or not separate(now, target, x):
            law.model.checked_state(state)
            raise ShapeError(
                f'deflection must be finite with shape (3, {law.count}), got {target.tolist()}'
            )
        low, high = self._depths
        depth, speed = law.model.parameters.length - now.item(0), -now.item(m)
        angle, turn = now.item(1), now.item(m + 1)
        if not low <= depth <= high:
            # Unless it is rounding.
            law.model.checked_state(state)
        middle = depth + 0.5 * (self._delay + 1) * h * speed
        law.tabulate(min(max(middle, low), high), table)
        for force, torque, forces in zip(
            self.insertion.on_the_way,
            self.rotation.on_the_way,
            self.deflection.on_the_way,
            strict=True,
        ):
            against = deflection_predict(law.constants, table, x, speed, forces)
            depth, speed = sliding.propagate(depth, speed, force - against, h)
            angle, turn = turning.propagate(angle, turn, torque, h)
        forces, against = self.deflection.step(table, x, target, speed)
        answer = np.empty(m)
        answer[0] = self.insertion.answer(depth, speed, insertion, against)
        answer[1] = self.rotation.answer(angle, turn, rotation)
        answer[_BASE:] = forces
        return answer
