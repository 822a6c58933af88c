r"""
Structure-preserving integrator of the needle: frozen-depth modal flow, exact friction flow.

One step of length h from (s, u, q, p), u = s_dot and p = rho A G q_dot, is a symmetric
splitting of the Hamiltonian system:

1. drift the depth to the middle of the step with the speed at its start;
2. with the depth frozen there, the modal part is linear: tissue damping and the rotation in the
   eigenbasis of (E I_y H + k_a G, rho A G) are exact, whatever their frequency. With the
   momenta as variables dG/dt needs no term. The impulse -dH/ds that the modes exert on the
   insertion axis along that rotation is an exact integral too;
3. insertion force and mean modal force being constant over the step, the insertion axis under
   viscous and set-valued Coulomb friction has an exact flow, including stops and sticking.

It is of second order, symplectic without friction and damping (the total displacement then
equals that of drift-kick-drift), sticks exactly, and has no stability limit from the modes nor
from viscous friction. Source of the idea: E. Hairer, C. Lubich, G. Wanner, "Geometric Numerical
Integration", 2nd ed., 2006, sections II.5 and XIII (splitting, highly oscillatory problems).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, cos, exp, expm1, inf, log1p, sin, sqrt
from typing import Final, NamedTuple

from needle_dynamics._compile import compiled
from needle_dynamics.errors import InsertedLengthError, ParameterError
from needle_dynamics.model import COORDINATES, NeedleModel
from needle_dynamics.modes import COLUMNS_OUT, evaluate, FloatArray
from needle_dynamics.parameters import NeedleParameters
import numpy as np
from numpy.typing import ArrayLike

#: Default step [s]. The tip deflection of the source's open-loop run is then good to 1e-4.
DEFAULT_STEP: Final = 1e-5

# Slots of the running sums of `_advance`.
_TIP: Final = 0
_AREA: Final = 1
_MOMENT: Final = 2
_AREA_RATE: Final = 3
_MOMENT_RATE: Final = 4
_FRICTION_WORK: Final = 5
_DAMPING_WORK: Final = 6
_INPUT_WORK: Final = 7
_MODAL_IMPULSE: Final = 8
_SUMS: Final = 9


class _Constants(NamedTuple):
    """What the compiled step needs of `NeedleParameters`."""

    length: float
    linear_density: float
    bending_stiffness: float
    tissue_stiffness: float
    tissue_damping: float
    moving_mass: float
    rotary_inertia: float
    coulomb: float
    viscous: float
    minimum_depth: float
    hub_stop: bool


def _constants(p: NeedleParameters) -> _Constants:
    return _Constants(
        p.length,
        p.linear_density,
        p.bending_stiffness,
        p.tissue_stiffness,
        p.tissue_damping,
        p.moving_mass,
        p.rotary_inertia,
        p.coulomb_friction,
        p.viscous_friction,
        p.minimum_depth,
        p.hub_stop,
    )


@compiled
def decay_means(x: float) -> tuple[float, float]:
    """
    Return the means over [0, 1] of exp(-x r) and of r -> mean of exp(-x r') over [0, r] times r.

    They are (1 - exp(-x)) / x and (x - 1 + exp(-x)) / x^2, without cancellation at small x.
    """
    if x < 1e-4:
        # Taylor: the next terms are below 1e-13.
        return 1.0 - x * (0.5 - x / 6.0), 0.5 - x * (1.0 / 6.0 - x / 24.0)
    mean = -expm1(-x) / x
    return mean, (1.0 - mean) / x


@compiled
def _glide(u: float, a: float, b: float, t: float) -> tuple[float, float]:
    """
    Solve u_dot = a - b u for a time t.

    Returns the final speed and the displacement.
    """
    x = b * t
    mean, ramp = decay_means(x)
    return u * (1.0 - x * mean) + a * t * mean, t * (u * mean + a * t * ramp)


@compiled
def slide(
    u: float, drive: float, mass: float, coulomb: float, viscous: float, t: float
) -> tuple[float, float]:
    """
    Exact flow of the insertion axis under a constant force and friction (15).

    Parameters
    ----------
    u : float
        Insertion speed [m/s].
    drive : float
        Constant force [N], positive into the tissue.
    mass, coulomb, viscous : float
        Moving mass [kg], Coulomb friction [N], viscous friction [N s/m].
    t : float
        Duration [s].

    Returns
    -------
    speed : float
        Speed after ``t`` [m/s]; exactly zero while stuck.
    displacement : float
        Distance moved [m].

    """
    b = viscous / mass
    distance = 0.0
    if u != 0.0:
        sign = 1.0 if u > 0.0 else -1.0
        braking = (coulomb - drive * sign) / mass
        stop = inf
        if braking > 0.0:
            stop = abs(u) / braking
            if b > 0.0:
                stop = log1p(b * stop) / b
        if stop > t:
            return _glide(u, -sign * braking, b, t)
        _, distance = _glide(u, -sign * braking, b, stop)
        t -= stop
    if abs(drive) <= coulomb:
        return 0.0, distance
    excess = drive - coulomb if drive > 0.0 else drive + coulomb
    speed, further = _glide(0.0, excess / mass, b, t)
    return speed, distance + further


@compiled
def _rotate(
    c: _Constants,
    at: FloatArray,
    q1: float,
    q2: float,
    p1: float,
    p2: float,
    h: float,
    decay: float,
    sums: FloatArray,
) -> tuple[float, float, float, float, float]:
    """
    Exact modal flow at frozen depth for a time h, between two half steps of tissue damping.

    Returns q1, q2, p1, p2 and the impulse on the insertion axis [N s] against insertion.
    """
    rho, ei, ka = c.linear_density, c.bending_stiffness, c.tissue_stiffness
    # Cholesky factor of the modal mass rho A G = L L^T.
    l11 = sqrt(rho * at[0])
    l21 = rho * at[1] / l11
    l22 = sqrt(rho * at[2] - l21 * l21)
    i11 = 1.0 / l11
    i22 = 1.0 / l22
    ratio = l21 * i11
    # Stiffness in the coordinates y = L^T q, where the mass is the identity.
    k11 = ei * at[3] + ka * at[0]
    k12 = ei * at[4] + ka * at[1]
    k22 = ei * at[5] + ka * at[2]
    b11 = k11 * i11 * i11
    b12 = (k12 - ratio * k11) * i11 * i22
    b22 = (k22 - 2.0 * ratio * k12 + ratio * ratio * k11) * i22 * i22
    # One Jacobi rotation diagonalizes it.
    tau = (b22 - b11) / (2.0 * b12)
    tangent = (1.0 if tau >= 0.0 else -1.0) / (abs(tau) + sqrt(1.0 + tau * tau))
    cj = 1.0 / sqrt(1.0 + tangent * tangent)
    sj = tangent * cj
    square1 = b11 - tangent * b12
    square2 = b22 + tangent * b12
    omega1 = sqrt(square1)
    omega2 = sqrt(square2)

    y1 = l11 * q1 + l21 * q2
    y2 = l22 * q2
    v1 = p1 * i11
    v2 = (p2 - l21 * v1) * i22
    a1 = cj * y1 - sj * y2
    a2 = sj * y1 + cj * y2
    b1 = cj * v1 - sj * v2
    b2 = sj * v1 + cj * v2

    lost = b1 * b1 + b2 * b2
    b1 *= decay
    b2 *= decay
    lost *= 1.0 - decay * decay

    cos1 = cos(omega1 * h)
    sin1 = sin(omega1 * h)
    cos2 = cos(omega2 * h)
    sin2 = sin(omega2 * h)
    e1 = a1 * cos1 + b1 * sin1 / omega1
    f1 = b1 * cos1 - a1 * omega1 * sin1
    e2 = a2 * cos2 + b2 * sin2 / omega2
    f2 = b2 * cos2 - a2 * omega2 * sin2

    # Integrals over the rotation of a_i a_j and b_i b_j (b = a_dot), from the end values.
    twice1 = (b1 * b1 + square1 * a1 * a1) * h
    twice2 = (b2 * b2 + square2 * a2 * a2) * h
    change1 = e1 * f1 - a1 * b1
    change2 = e2 * f2 - a2 * b2
    aa1 = 0.5 * (twice1 - change1) / square1
    bb1 = 0.5 * (twice1 + change1)
    aa2 = 0.5 * (twice2 - change2) / square2
    bb2 = 0.5 * (twice2 + change2)
    change12 = e1 * f2 - a1 * b2
    change21 = e2 * f1 - a2 * b1
    gap = 1.0 / (square1 - square2)
    aa12 = (change12 - change21) * gap
    bb12 = (square1 * change12 - square2 * change21) * gap

    # Tip value and tip curvature of the two normal modes.
    w1 = at[6] * i11
    w2 = (at[7] - l21 * w1) * i22
    n1 = cj * w1 - sj * w2
    n2 = sj * w1 + cj * w2
    w1 = at[8] * i11
    w2 = (at[9] - l21 * w1) * i22
    m1 = cj * w1 - sj * w2
    m2 = sj * w1 + cj * w2
    elastic = (
        (ei * m1 * m1 + ka * n1 * n1) * aa1
        + (ei * m2 * m2 + ka * n2 * n2) * aa2
        + 2.0 * (ei * m1 * m2 + ka * n1 * n2) * aa12
    )
    inertial = rho * (n1 * n1 * bb1 + n2 * n2 * bb2 + 2.0 * n1 * n2 * bb12)
    impulse = 0.5 * (elastic - inertial)

    # Integral of q over the rotation, for the means that sensors take.
    s1 = (b1 - f1) / square1
    s2 = (b2 - f2) / square2
    sums[_TIP] += n1 * s1 + n2 * s2
    y1 = cj * s1 + sj * s2
    y2 = cj * s2 - sj * s1
    mean2 = y2 * i22
    mean1 = (y1 - l21 * mean2) * i11
    sums[_AREA] += at[10] * mean1 + at[11] * mean2
    sums[_MOMENT] += at[12] * mean1 + at[13] * mean2

    after = f1 * f1 + f2 * f2
    f1 *= decay
    f2 *= decay
    sums[_DAMPING_WORK] += 0.5 * (lost + after * (1.0 - decay * decay))

    y1 = cj * e1 + sj * e2
    y2 = cj * e2 - sj * e1
    v1 = cj * f1 + sj * f2
    v2 = cj * f2 - sj * f1
    r2 = y2 * i22
    r1 = (y1 - l21 * r2) * i11
    sums[_AREA_RATE] += at[10] * (r1 - q1) + at[11] * (r2 - q2)
    sums[_MOMENT_RATE] += at[12] * (r1 - q1) + at[13] * (r2 - q2)
    return r1, r2, l11 * v1, l21 * v1 + l22 * v2, impulse


@compiled
def _advance(
    c: _Constants,
    table: FloatArray,
    work: FloatArray,
    at: FloatArray,
    state: FloatArray,
    force: float,
    torque: float,
    base_speed: float,
    moved: bool,
    h: float,
    steps: int,
    sums: FloatArray,
) -> int:
    """
    Take ``steps`` steps in place under constant inputs; return how many were taken.

    With ``moved`` the speed goes evenly to ``base_speed``, whatever force that takes.
    Fewer steps than asked for means that the inserted length fell below its minimum.
    """
    s = c.length - state[0]
    u = -state[4]
    q1 = state[2]
    q2 = state[3]
    rho = c.linear_density
    evaluate(s / c.length, table, work, at)
    p1 = rho * (at[0] * state[6] + at[1] * state[7])
    p2 = rho * (at[1] * state[6] + at[2] * state[7])
    decay = exp(-0.5 * h * c.tissue_damping / rho)
    change = (base_speed - u) / steps
    taken = 0
    while taken < steps:
        middle = s + 0.5 * h * u
        if c.hub_stop and middle > c.length:
            middle = c.length
        if middle < c.minimum_depth:
            break
        evaluate(middle / c.length, table, work, at)
        r1, r2, t1, t2, impulse = _rotate(c, at, q1, q2, p1, p2, h, decay, sums)
        drive = force - impulse / h
        if moved:
            # Counted from the end, so that a base that shall rest does so exactly.
            new_u = base_speed - (steps - taken - 1) * change
            step = 0.5 * h * (u + new_u)
        else:
            new_u, step = slide(u, drive, c.moving_mass, c.coulomb, c.viscous, h)
        if s + step < c.minimum_depth:
            break
        q1, q2, p1, p2 = r1, r2, t1, t2
        sums[_MODAL_IMPULSE] += impulse
        sums[_INPUT_WORK] += force * step
        sums[_FRICTION_WORK] += drive * step - 0.5 * c.moving_mass * (new_u * new_u - u * u)
        s += step
        u = new_u
        if c.hub_stop and s >= c.length:
            s = c.length
            if u > 0.0:
                u = 0.0
        taken += 1
    evaluate(s / c.length, table, work, at)
    # Back from momenta to rates, by the same Cholesky factor.
    l11 = sqrt(rho * at[0])
    l21 = rho * at[1] / l11
    l22 = sqrt(rho * at[2] - l21 * l21)
    v1 = p1 / l11
    v2 = (p2 - l21 * v1) / l22
    rate2 = v2 / l22
    rate1 = (v1 - l21 * rate2) / l11
    duration = taken * h
    turn = 2.0 * torque / c.rotary_inertia
    sums[_INPUT_WORK] += torque * (state[5] + 0.5 * turn * duration) * duration
    state[0] = c.length - s
    state[1] += (state[5] + 0.5 * turn * duration) * duration
    state[2] = q1
    state[3] = q2
    state[4] = -u
    state[5] += turn * duration
    state[6] = rate1
    state[7] = rate2
    return taken


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """
    What a sensor that averages over an interval would have seen of it.

    Attributes
    ----------
    tip_deflection : float
        Mean deflection of the tip [m].
    axial_force : float
        Mean force of the base on the needle along y [N], positive into the tissue.
    lateral_force : float
        Mean force of the base on the needle along z [N], by balance of momentum.
    moment : float
        Mean moment of the base on the needle about x at the base [N m], with the torque.
    friction_work, damping_work : float
        Energy lost to friction and to tissue damping [J].
    input_work : float
        Work done by force and torque [J].

    """

    tip_deflection: float
    axial_force: float
    lateral_force: float
    moment: float
    friction_work: float
    damping_work: float
    input_work: float


class Integrator:
    """
    Advances one needle in time with its own scratch memory.

    Parameters
    ----------
    parameters : NeedleParameters
        Constants.
    state : array_like, shape (8,)
        Initial state.
    step : float
        Longest step [s].

    Raises
    ------
    ParameterError
        If ``step`` is not positive and finite.
    ShapeError, InsertedLengthError
        If the state is not valid.

    """

    def __init__(
        self, parameters: NeedleParameters, state: ArrayLike, step: float = DEFAULT_STEP
    ) -> None:
        if not 0.0 < step < inf:
            raise ParameterError(f'step must be positive and finite, got {step!r} s')
        self.model = NeedleModel(parameters)
        self.step = step
        self._constants = _constants(parameters)
        self._table = self.model.modes.series
        self._work = np.empty(self._table.shape[1])
        self._at = np.empty(COLUMNS_OUT)
        self._sums = np.zeros(_SUMS)
        self._state = self.model.checked_state(state)

    @property
    def state(self) -> FloatArray:
        """State now, a copy; shape (8,)."""
        return self._state.copy()

    @property
    def depth(self) -> float:
        """Inserted length s [m]."""
        return float(self._constants.length - self._state[0])

    @property
    def speed(self) -> float:
        """Insertion speed s_dot [m/s]."""
        return float(-self._state[COORDINATES])

    def advance(self, duration: float, force: float = 0.0, torque: float = 0.0) -> Interval:
        """
        Advance under a constant force and torque at the base.

        Parameters
        ----------
        duration : float
            Time to advance [s], taken in equal steps no longer than the step.
        force : float
            Insertion force f_y [N], positive into the tissue.
        torque : float
            Torque tau about x [N m].

        Returns
        -------
        Interval
            Means and works over the interval.

        Raises
        ------
        InsertedLengthError
            If the inserted length fell below its minimum; the state is the last valid one.

        """
        return self._run(duration, force, torque, 0.0, moved=False)

    def advance_moved(self, duration: float, speed: float) -> Interval:
        """
        Advance with the base brought evenly to a speed, whatever force that takes.

        Parameters
        ----------
        duration : float
            Time to advance [s].
        speed : float
            Insertion speed at the end [m/s], positive into the tissue.

        Returns
        -------
        Interval
            Means over the interval; the axial force is what the motion took. While the base
            rests, friction takes the value within its bounds that asks for the least force.

        Raises
        ------
        InsertedLengthError
            If the inserted length fell below its minimum; the state is the last valid one.

        """
        return self._run(duration, 0.0, 0.0, speed, moved=True)

    def _run(
        self, duration: float, force: float, torque: float, speed: float, *, moved: bool
    ) -> Interval:
        # A duration of a whole number of steps is not rounded up.
        steps = max(1, ceil(duration / self.step * (1.0 - 1e-9)))
        sums, before = self._sums, self._state.copy()
        sums[:] = 0.0
        taken = _advance(
            self._constants,
            self._table,
            self._work,
            self._at,
            self._state,
            force,
            torque,
            speed,
            moved,
            duration / steps,
            steps,
            sums,
        )
        if taken < steps:
            raise InsertedLengthError(
                f'inserted length {self.depth:.6g} m reached minimum_depth = '
                f'{self._constants.minimum_depth:g} m while withdrawing'
            )
        return self._interval(before, duration, force, torque, moved=moved)

    def _interval(
        self, before: FloatArray, duration: float, force: float, torque: float, *, moved: bool
    ) -> Interval:
        p, after, sums = self.model.parameters, self._state, self._sums
        rho, now = p.linear_density, self.model.modes.integrals
        start, end = now(p.length - before[0]), now(p.length - after[0])
        momentum = rho * (end.area @ after[6:] - start.area @ before[6:])
        angular = rho * (end.moment @ after[6:] - start.moment @ before[6:])
        lateral = (
            momentum + p.tissue_stiffness * sums[_AREA] + p.tissue_damping * sums[_AREA_RATE]
        ) / duration
        about_entry = (
            angular + p.tissue_stiffness * sums[_MOMENT] + p.tissue_damping * sums[_MOMENT_RATE]
        ) / duration
        gain = (before[4] - after[4]) / duration
        if moved:
            resistance = sums[_MODAL_IMPULSE] / duration
            moving = (before[0] - after[0]) / duration
            friction = self.model.friction(moving, -resistance)
            force = p.linear_density * p.length * gain + friction + resistance
        else:
            force = force - p.carriage_mass * gain
        return Interval(
            tip_deflection=float(sums[_TIP] / duration),
            axial_force=float(force),
            lateral_force=float(lateral),
            moment=float(about_entry + 0.5 * (before[0] + after[0]) * lateral + torque),
            friction_work=float(sums[_FRICTION_WORK]),
            damping_work=float(sums[_DAMPING_WORK]),
            input_work=float(sums[_INPUT_WORK]),
        )


@dataclass(frozen=True, slots=True)
class Trajectory:
    """
    A simulated run, sampled evenly.

    Attributes
    ----------
    time : ndarray, shape (n,)
        Time [s].
    states : ndarray, shape (n, 8)
        States.
    tip_deflection : ndarray, shape (n,)
        Deflection of the tip [m] at these times.

    """

    time: FloatArray
    states: FloatArray
    tip_deflection: FloatArray


def simulate(
    parameters: NeedleParameters,
    state: ArrayLike,
    force: float | Callable[[float], float],
    *,
    duration: float,
    interval: float,
    step: float = DEFAULT_STEP,
) -> Trajectory:
    """
    Simulate the needle under a force that is constant over each interval.

    Parameters
    ----------
    parameters : NeedleParameters
        Constants.
    state : array_like, shape (8,)
        Initial state.
    force : float or callable
        Insertion force [N], or a function of time [s] read at the start of each interval.
    duration : float
        Time to simulate [s].
    interval : float
        Time between samples [s].
    step : float
        Longest step of the integrator [s].

    Returns
    -------
    Trajectory
        Samples at 0, ``interval``, ..., ``duration``.

    Raises
    ------
    InsertedLengthError
        If the needle leaves the tissue.

    """
    integrator = Integrator(parameters, state, step)
    count = round(duration / interval)
    time = np.arange(count + 1, dtype=np.float64) * interval
    states = np.empty((count + 1, 2 * COORDINATES))
    states[0] = integrator.state
    for i in range(count):
        integrator.advance(interval, force(time[i]) if callable(force) else force)
        states[i + 1] = integrator.state
    tips = np.array([integrator.model.tip_deflection(x) for x in states])
    return Trajectory(time, states, tips)
