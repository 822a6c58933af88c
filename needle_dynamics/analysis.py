# SPDX-License-Identifier: Apache-2.0
"""
Controllability and observability analysis of the linearized model.

The rank of [B, AB, A^2 B, ...] in SI units is not meaningful: its columns span more decades than
double precision has digits. The tests use the pair in natural units (`LinearSystem.scaled`) and
orthogonal transformations only: a staircase algorithm finds the controllable subspace, and the
smallest singular value of the Hautus (PBH) pencil [A - lambda I, B] gives the distance to
uncontrollability.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import compress
from typing import Final

from needle_dynamics.arrays import ComplexArray, FloatArray
from needle_dynamics.linearization import linearize, LinearSystem, operating_point
from needle_dynamics.model import NeedleModel
from needle_dynamics.parameters import NeedleParameters
from needle_ros.errors import ShapeError
import numpy as np
from numpy.typing import ArrayLike

RANK_TOLERANCE: Final = 1e-10  #: relative tolerance of the rank decision, in natural units


@dataclass(frozen=True, slots=True, kw_only=True)
class StateStructure:
    """Controllable or observable part of the state space."""

    order: int  #: number of states N
    rank: int  #: dimension of the controllable or observable part
    lost: tuple[str, ...]  #: states that are entirely uncontrollable or unobservable
    combined: tuple[str, ...]  #: states of which only combinations are lost
    eigenvalues: ComplexArray  #: eigenvalues of A, in its unit of time, shape (N,)
    #: Smallest singular value of the PBH pencil at each eigenvalue, shape (N,).
    distances: FloatArray
    #: Least distance within the controllable or observable part: the perturbation that reduces the
    #: rank further.
    margin: float
    weakest: str  #: leading state of the direction with the least margin

    @property
    def deficiency(self) -> int:
        """Rank deficiency N - rank."""
        return self.order - self.rank

    @property
    def distance(self) -> float:
        """Least of `distances`: an upper bound of the perturbation that reduces the rank."""
        return float(self.distances.min())

    @property
    def loss(self) -> str:
        """Names of the lost states and combinations, ``none`` at full rank."""
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
) -> StateStructure:
    """Find the controllable states of (A, B), (N, N) and (N, M), and the PBH distances."""
    # In units of `LinearSystem.scaled`; ``names`` are of the states times ``transform``.
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
    # No input changes w^T z for w in the rest; these are its coefficients on the named states.
    shares = np.linalg.norm(np.linalg.solve(rows.T, rest), axis=1) * sizes
    involved = shares > RANK_TOLERANCE * shares.max(initial=0.0)
    eigenvalues, distances, directions = _hautus(a, b)
    inner = distances
    if 0 < kept.shape[1] < order:
        _, inner, directions = _hautus(kept.T @ a @ kept, kept.T @ b)
        directions = directions @ kept.T
    least = int(np.argmin(inner))
    leading = (scaled_names or names)[np.argmax(np.abs(directions[least]))]
    return StateStructure(
        order=order,
        rank=kept.shape[1],
        lost=tuple(compress(names, ~reached)),
        combined=tuple(compress(names, reached & involved)),
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
) -> StateStructure:
    """Find the observable states of (A, C), shapes as `controllability` of the dual pair."""
    dual = None if transform is None else np.linalg.inv(np.asarray(transform, dtype=float)).T
    a, c = np.asarray(a, dtype=float), np.asarray(c, dtype=float)
    return controllability(a.T, c.T, names, dual, scaled_names)


def _staircase(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return orthonormal bases (columns) of the controllable subspace and its complement."""
    kept = np.zeros((a.shape[0], 0))
    fresh, size, norm = b, np.linalg.norm(b), np.linalg.norm(a)
    while fresh.size:
        for _ in range(2):  # two passes give orthogonality to rounding
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
    """Controllability and observability of a linear system."""

    state: StateStructure  #: state controllability
    observed: StateStructure  #: observability from the tip deflection
    #: Whether the tip deflection is output controllable. With one output the matrix
    #: [CB, CAB, ..., D] needs rank 1: the number of outputs, not of inputs.
    output_controllable: bool
    #: Tip deflection per base travel, the slope ``|w'(s)|`` of the needle at its tip: the effect
    #: of a base displacement on the output before the bending responds.
    output_gain: float


def analyze(system: LinearSystem) -> Analysis:
    """
    Test controllability, observability and output controllability in natural units.

    Parameters
    ----------
    system : LinearSystem
        Result of `linearize`.

    Returns
    -------
    Analysis
        Results, with eigenvalues in rad/s.

    Examples
    --------
    The two inputs move depth and rotation; neither bends a straight needle.

    >>> from needle_dynamics import analyze, linearize, NeedleModel, NeedleParameters
    >>> from needle_dynamics.linearization import operating_point
    >>> model = NeedleModel(NeedleParameters.preset('phantom'))
    >>> found = analyze(linearize(model, operating_point(model, 0.05, velocity=5e-3)))
    >>> found.state.rank, found.observed.rank
    (4, 4)

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
    """Results of `Analysis` over depth and tip deflection."""

    parameters: NeedleParameters  #: constants
    velocity: float  #: insertion velocity [m/s]
    #: Insertion depths, shape (I,), and tip deflections, shape (J,) [m].
    depths: FloatArray
    deflections: FloatArray
    #: State controllability: rank, and distance to a loss of rank, shape (I, J).
    rank: FloatArray
    distance: FloatArray
    #: Observability: rank, and distance to a further loss of rank, shape (I, J).
    observed_rank: FloatArray
    observed_margin: FloatArray
    output_gain: FloatArray  #: tip deflection per base travel, shape (I, J)


def controllability_map(
    parameters: NeedleParameters,
    depths: ArrayLike,
    deflections: ArrayLike,
    velocity: float,
    sliding: str | None = None,
    force: float = 0.0,
    progress: Callable[[], object] | None = None,
) -> ControllabilityMap:
    """Analyze all pairs of depths (I,) and deflections (J,) [m], with `progress` after a depth."""
    model = NeedleModel(parameters)
    depths, deflections = np.array(depths, dtype=float), np.array(deflections, dtype=float)
    for name, values in (('depths', depths), ('deflections', deflections)):
        if values.ndim != 1 or not values.size:
            raise ShapeError(f'{name} must be a list of numbers, got shape {values.shape}')
    results = np.empty((5, depths.size, deflections.size))
    for i, depth in enumerate(depths):
        for j, deflection in enumerate(deflections):
            point = operating_point(model, depth, deflection, velocity)
            found = analyze(linearize(model, point, force, sliding=sliding))
            state, seen = found.state, found.observed
            ranks = (state.rank, state.distance, seen.rank, seen.margin)
            results[:, i, j] = (*ranks, found.output_gain)
        if progress is not None:
            progress()
    return ControllabilityMap(
        parameters=parameters,
        velocity=velocity,
        depths=depths,
        deflections=deflections,
        rank=results[0].astype(int),
        distance=results[1],
        observed_rank=results[2].astype(int),
        observed_margin=results[3],
        output_gain=results[4],
    )
