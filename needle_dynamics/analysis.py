r"""
Linearization (19) of the model at an operating point, and what it can steer and see.

A rank of [B, AB, A^2 B, ...] in SI units says nothing here: its columns span more decades than
double precision has digits. The tests below work on the pair in natural units (`scaled`), with
orthogonal transformations only: a staircase finds what the inputs reach, and the smallest singular
value of the Hautus (PBH) pencil [A - lambda I, B] says how far that is from being lost.

The only equilibria of the model are straight needles. Elsewhere (19) holds along a motion, with
its coefficients frozen at the instant that is looked at.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import exp, inf, isfinite, tanh
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_dynamics.friction import Friction
from needle_dynamics.model import NeedleModel
from needle_dynamics.parameters import NeedleParameters
from needle_ros.errors import (
    NeedleError,
    ParameterError,
    ShapeError,
)
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eigh

ComplexArray = NDArray[np.complex128]

#: Ways to slide, with the sign of the insertion speed.
SLIDING: Final = {'insertion': 1.0, 'withdrawal': -1.0}

#: What couples by less than this part of the norm, in natural units, counts as not coupled.
RANK_TOLERANCE: Final = 1e-10


class StuckError(NeedleError):
    """Friction has no derivative: the needle is at rest and nothing says which way it slides."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearSystem:
    """
    The linear system (19) at one operating point, SI units.

    Deviations x of the state, u = [f_y, tau] of the input and y of the tip deflection obey
    x_dot = drift + A x + B u and y = C x + D u. The order N is 2 (2 + n).

    Attributes
    ----------
    A : ndarray, shape (N, N)
        State matrix.
    B : ndarray, shape (N, 2)
        Input matrix.
    C : ndarray, shape (1, N)
        Output matrix.
    D : ndarray, shape (1, 2)
        Feedthrough, zero.
    drift : ndarray, shape (N,)
        X_dot at the operating point; zero at an equilibrium.
    names : tuple of str
        Names of the states: d, theta, q1, ..., qn, d_dot, ...
    frequencies : ndarray, shape (n,)
        Natural frequencies of the inserted part, ascending [rad/s].
    transform : ndarray, shape (N, N)
        Natural units: the state is ``transform`` times the scaled state.
    input_scales : ndarray, shape (2,)
        Force [N] and torque [N m] that count as one.
    output_scale : float
        Deflection that counts as one [m].

    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    drift: FloatArray
    names: tuple[str, ...]
    frequencies: FloatArray
    transform: FloatArray
    input_scales: FloatArray
    output_scale: float

    @property
    def scaled_names(self) -> tuple[str, ...]:
        """Names of what the scaled states belong to, rates like their coordinates."""
        bending = (f'bending {i + 1}' for i in range(len(self.frequencies)))
        return ('d', 'theta', *bending) * 2

    def scaled(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """
        Return A, B, C in natural units, all numbers without dimension.

        Time counts in 1 / omega_1 of the slowest mode of the inserted part, d and the deflection
        in inserted lengths s, theta in radians, the force and torque in what moves needle and
        rotor by these within that time. The bending is split into its normal modes, displacement
        and rate in the norm of energy: the state of mode 1 is its root mean square deflection
        over s.

        Returns
        -------
        tuple of ndarray, shapes (N, N), (N, 2) and (1, N)
            A, B, C.

        """
        slowest = self.frequencies[0]
        back = np.linalg.inv(self.transform)
        return (
            back @ self.A @ self.transform / slowest,
            back @ self.B * self.input_scales / slowest,
            self.C @ self.transform / self.output_scale,
        )


def operating_point(
    model: NeedleModel, depth: float, tip_deflection: float = 0.0, speed: float = 0.0
) -> FloatArray:
    """
    Return the state of a needle that moves with its shape held, see `NeedleModel.state_at`.

    Parameters
    ----------
    model : NeedleModel
        The model.
    depth, tip_deflection : float
        Inserted length s and tip deflection w(s) [m].
    speed : float
        Insertion speed s_dot [m/s], positive into the tissue.

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
    state = model.state_at(depth, tip_deflection)
    state[model.coordinates] = -speed
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
        Operating point, SI units. At the border of two layers the lower one counts.
    force : float
        Insertion force f_y [N]; it enters the drift, and decides which way a needle at rest goes.
    torque : float
        Torque tau [N m]; it enters the drift.
    time : float
        Time [s], for tissue that swells; frozen.
    sliding : str, optional
        ``insertion`` or ``withdrawal``: the branch of the friction law to differentiate at rest,
        the limit of slow motion that way. It is not looked at while the needle moves, or breaks
        away under the forces given.

    Returns
    -------
    LinearSystem
        A, B, C, D and the natural units.

    Raises
    ------
    StuckError
        If the needle is at rest, friction there has no derivative, and ``sliding`` is not given.
    ParameterError
        If an input is not finite or ``sliding`` is unknown.
    ShapeError, InsertedLengthError
        If the state is not valid.

    """
    for name, number in (('force', force), ('torque', torque), ('time', time)):
        if not isfinite(number):
            raise ParameterError(f'{name} must be finite, got {number!r}')
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
    pace = frequencies[0]
    energy = depth * pace * np.sqrt(density * depth)
    transform = np.zeros_like(a)
    transform[0, 0], transform[m, m] = depth, depth * pace
    transform[1, 1], transform[m + 1, m + 1] = 1.0, pace
    transform[2:m, 2:m] = energy * normal / frequencies
    transform[m + 2 :, m + 2 :] = energy * normal
    push = (p.moving_mass * pace + abs(drag)) * depth * pace
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
        input_scales=np.array([push, 0.5 * p.rotary_inertia * pace**2]),
        output_scale=depth,
    )


def _friction(
    law: Friction, speed: float, drive: float, sliding: str | None
) -> tuple[float, float]:
    """Return the friction force [N] and its derivative by the speed [N s/m]; speed into tissue."""
    if sliding is not None and sliding not in SLIDING:
        raise ParameterError(f'sliding must be one of {", ".join(SLIDING)}, got {sliding!r}')
    if speed != 0.0:
        return law.force(speed, drive), _drag(law, speed, np.sign(speed))
    ahead, back = law.force(0.0, inf), law.force(0.0, -inf)
    if drive > ahead or drive < back:
        sign = 1.0 if drive > ahead else -1.0
    elif sliding is not None:
        sign = SLIDING[sliding]
    elif ahead == back and _drag(law, 0.0, 1.0) == _drag(law, 0.0, -1.0):
        sign = 1.0
    else:
        raise StuckError(
            f'the needle is at rest and {drive:.3g} N does not move it: friction there, from '
            f'{back:.3g} to {ahead:.3g} N, has no derivative; give a speed, a force beyond it, '
            f'or the branch to slide on ({" or ".join(SLIDING)})'
        )
    return (ahead if sign > 0.0 else back), _drag(law, 0.0, sign)


def _drag(law: Friction, speed: float, sign: float) -> float:
    """Differentiate the friction force on the side of the given sign."""
    drag = law.viscous
    if law.law == 'stribeck':
        ratio = abs(speed) / law.stribeck_speed
        fall = (law.breakaway - 1.0) * exp(-(ratio**2))
        drag -= law.coulomb * fall * 2.0 * ratio / law.stribeck_speed
    elif law.law == 'tanh':
        steep = 1.0 - tanh(abs(speed) / law.smoothing_speed) ** 2
        drag += law.coulomb * steep / law.smoothing_speed
    return drag if sign > 0.0 else law.withdrawal * drag


@dataclass(frozen=True, slots=True, kw_only=True)
class Structure:
    """
    What of the state a set of inputs can steer, or a set of outputs can see.

    Attributes
    ----------
    order, rank : int
        Number of states, and how many dimensions of them are kept.
    lost : tuple of str
        States that are lost by themselves.
    combined : tuple of str
        States of which only combinations are lost.
    eigenvalues : ndarray, shape (N,)
        Eigenvalues of A, in its unit of time.
    distances : ndarray, shape (N,)
        Smallest singular value of the PBH pencil at each of them.
    margin : float
        As `distance`, of the part that is kept alone: what it takes to lose more.
    weakest : str
        The state that leads in what would be lost next.

    """

    order: int
    rank: int
    lost: tuple[str, ...]
    combined: tuple[str, ...]
    eigenvalues: ComplexArray
    distances: FloatArray
    margin: float
    weakest: str

    @property
    def deficiency(self) -> int:
        """Number of dimensions that are lost."""
        return self.order - self.rank

    @property
    def distance(self) -> float:
        """Least of `distances`: no smaller than the change of the pair that loses rank."""
        return float(self.distances.min())

    @property
    def loss(self) -> str:
        """What is lost, in words."""
        words = [', '.join(self.lost)] if self.lost else []
        number = self.deficiency - len(self.lost)
        if number:
            of = ', '.join(self.combined)
            words.append(f'{number} combination{"s" if number > 1 else ""} of {of}')
        return ' and '.join(words) or 'none'


def controllability(
    a: ArrayLike,
    b: ArrayLike,
    names: tuple[str, ...],
    transform: ArrayLike | None = None,
    scaled_names: tuple[str, ...] | None = None,
) -> Structure:
    """
    Find which states the inputs of (A, B) steer, and how far the rest is from being lost.

    The pair has to be in units in which its entries compare, as from `LinearSystem.scaled`.

    Parameters
    ----------
    a : array_like, shape (N, N)
        State matrix.
    b : array_like, shape (N, M)
        Input matrix.
    names : tuple of str
        Names of the N states that are to be named.
    transform : array_like, shape (N, N), optional
        These states are ``transform`` times those of the pair; the identity if not given.
    scaled_names : tuple of str, optional
        Names of the states of the pair, for `Structure.weakest`; ``names`` if not given.

    Returns
    -------
    Structure
        Rank, lost states, distances.

    Raises
    ------
    ShapeError
        If shapes do not fit or a number is not finite.

    """
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    order = len(names)
    if a.shape != (order, order) or b.ndim != 2 or b.shape[0] != order:
        raise ShapeError(
            f'A and B, or the transposes of A and C, must have shapes ({order}, {order}) and '
            f'({order}, M) for {order} names, got {a.shape} and {b.shape}'
        )
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ShapeError('A and B, or A and C, must be finite')
    rows = np.eye(order) if transform is None else np.asarray(transform, dtype=float)
    kept, rest = _staircase(a, b)
    sizes = np.linalg.norm(rows, axis=1)
    reached = np.linalg.norm(rows @ kept, axis=1) > RANK_TOLERANCE * sizes
    # w^T z with w in the rest is what no input changes: its coefficients on the named states.
    shares = np.linalg.norm(np.linalg.solve(rows.T, rest), axis=1) * sizes
    involved = shares > RANK_TOLERANCE * shares.max(initial=0.0)
    eigenvalues, distances, directions = _hautus(a, b)
    inner = distances
    if 0 < kept.shape[1] < order:
        _, inner, directions = _hautus(kept.T @ a @ kept, kept.T @ b)
        directions = directions @ kept.T
    least = int(np.argmin(inner))
    leading = (scaled_names or names)[np.argmax(np.abs(directions[least]))]
    return Structure(
        order=order,
        rank=kept.shape[1],
        lost=tuple(name for name, held in zip(names, reached, strict=True) if not held),
        combined=tuple(
            name
            for name, held, mixed in zip(names, reached, involved, strict=True)
            if held and mixed
        ),
        eigenvalues=eigenvalues,
        distances=distances,
        margin=float(inner[least]) if kept.size else 0.0,
        weakest=leading if kept.size else 'none',
    )


def observability(
    a: ArrayLike,
    c: ArrayLike,
    names: tuple[str, ...],
    transform: ArrayLike | None = None,
    scaled_names: tuple[str, ...] | None = None,
) -> Structure:
    """
    Find which states the outputs of (A, C) show: `controllability` of the dual pair.

    Parameters
    ----------
    a : array_like, shape (N, N)
        State matrix.
    c : array_like, shape (P, N)
        Output matrix.
    names, transform, scaled_names
        As for `controllability`.

    Returns
    -------
    Structure
        Rank, lost states, distances.

    Raises
    ------
    ShapeError
        If shapes do not fit or a number is not finite.

    """
    dual = None if transform is None else np.linalg.inv(np.asarray(transform, dtype=float)).T
    a, c = np.asarray(a, dtype=float), np.asarray(c, dtype=float)
    return controllability(a.T, c.T, names, dual, scaled_names)


def _staircase(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return orthonormal bases, as columns, of what the inputs reach and of the rest."""
    kept = np.zeros((a.shape[0], 0))
    fresh, size, norm = b, np.linalg.norm(b), np.linalg.norm(a)
    while fresh.size:
        for _ in range(2):  # twice is enough for orthogonality to rounding
            fresh = fresh - kept @ (kept.T @ fresh)
        left, sizes, _ = np.linalg.svd(fresh, full_matrices=False)
        step = left[:, sizes > RANK_TOLERANCE * size]
        kept = np.hstack([kept, step])
        fresh, size = a @ step, norm
    full = np.linalg.qr(kept, mode='complete')[0] if kept.size else np.eye(a.shape[0])
    return kept, full[:, kept.shape[1] :]


def _hautus(a: FloatArray, b: FloatArray) -> tuple[ComplexArray, FloatArray, ComplexArray]:
    """Return eigenvalues, least singular values of [A - lambda I, B], and their left vectors."""
    eigenvalues = np.linalg.eigvals(a).astype(complex)
    order = a.shape[0]
    pencils = np.empty((order, order, order + b.shape[1]), dtype=complex)
    pencils[:, :, :order] = a - eigenvalues[:, np.newaxis, np.newaxis] * np.eye(order)
    pencils[:, :, order:] = b
    left, sizes, _ = np.linalg.svd(pencils, full_matrices=False)
    return eigenvalues, np.asarray(sizes[:, -1], dtype=float), left[:, :, -1]


@dataclass(frozen=True, slots=True, kw_only=True)
class Analysis:
    """
    What a linear system can steer and see.

    Attributes
    ----------
    state : Structure
        State controllability.
    observed : Structure
        Observability from the tip deflection.
    output_controllable : bool
        Whether the tip deflection can be steered. With one output the matrix
        [CB, CAB, ..., D] needs rank 1: the number of outputs, not of inputs.
    output_gain : float
        Tip deflection per base travel, the slope ``|w'(s)|`` of the needle at its tip: what a move
        of the base does to the output before the bending answers.

    """

    state: Structure
    observed: Structure
    output_controllable: bool
    output_gain: float


def analyze(system: LinearSystem) -> Analysis:
    """
    Test controllability, observability and output controllability in natural units.

    Parameters
    ----------
    system : LinearSystem
        From `linearize`.

    Returns
    -------
    Analysis
        The results; eigenvalues in rad/s.

    """
    a, b, c = system.scaled()
    labels = (system.names, system.transform, system.scaled_names)
    state, observed = (
        replace(found, eigenvalues=found.eigenvalues * system.frequencies[0])
        for found in (controllability(a, b, *labels), observability(a, c, *labels))
    )
    kept, _ = _staircase(a, b)
    steers = bool(np.linalg.norm(c @ kept) > RANK_TOLERANCE * np.linalg.norm(c))
    return Analysis(
        state=state,
        observed=observed,
        output_controllable=steers,
        output_gain=abs(float(system.C[0, 0])),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllabilityMap:
    """
    `Analysis` over depth and tip deflection; all results have shape (depths, deflections).

    Attributes
    ----------
    depths, deflections : ndarray
        Inserted lengths and tip deflections [m].
    rank, distance : ndarray
        State controllability: rank, and distance from losing it.
    observed_rank, observed_margin : ndarray
        Observability: rank, and distance of what is seen from losing more.
    output_gain : ndarray
        Tip deflection per base travel.

    """

    depths: FloatArray
    deflections: FloatArray
    rank: FloatArray
    distance: FloatArray
    observed_rank: FloatArray
    observed_margin: FloatArray
    output_gain: FloatArray


def controllability_map(
    parameters: NeedleParameters,
    depths: ArrayLike,
    deflections: ArrayLike,
    speed: float,
    sliding: str | None = None,
    force: float = 0.0,
) -> ControllabilityMap:
    """
    Analyze every pair of a depth and a tip deflection.

    Parameters
    ----------
    parameters : NeedleParameters
        Constants.
    depths, deflections : array_like, shapes (I,) and (J,)
        Inserted lengths and tip deflections [m].
    speed : float
        Insertion speed [m/s], positive into the tissue.
    sliding : str, optional
        As for `linearize`.
    force : float
        Insertion force [N].

    Returns
    -------
    ControllabilityMap
        Results, shape (I, J).

    Raises
    ------
    ShapeError
        If the depths or the deflections are not a list of finite numbers.
    InsertedLengthError, ParameterError, StuckError
        As `linearize`.

    """
    model = NeedleModel(parameters)
    depths, deflections = np.array(depths, dtype=float), np.array(deflections, dtype=float)
    for name, values in (('depths', depths), ('deflections', deflections)):
        if values.ndim != 1 or not values.size:
            raise ShapeError(f'{name} must be a list of numbers, got shape {values.shape}')
    results = np.empty((5, depths.size, deflections.size))
    for i, depth in enumerate(depths):
        for j, deflection in enumerate(deflections):
            state = operating_point(model, depth, deflection, speed)
            found = analyze(linearize(model, state, force, sliding=sliding))
            results[:, i, j] = (
                found.state.rank,
                found.state.distance,
                found.observed.rank,
                found.observed.margin,
                found.output_gain,
            )
    return ControllabilityMap(
        depths=depths,
        deflections=deflections,
        rank=results[0].astype(int),
        distance=results[1],
        observed_rank=results[2].astype(int),
        observed_margin=results[3],
        output_gain=results[4],
    )
