# SPDX-License-Identifier: Apache-2.0
r"""
Identify the tissue stiffness in the plane of deflection, section 3.2.2.3 of the paper.

The end-effector presses the tissue with force F and displaces it by d; the reaction is -F. For
each force level the stiffness matrix K of F = K d is fitted to the presses. A summary over several
places is as in Table 2.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, pairwise
from math import degrees, hypot, nan, sqrt
from typing import Final

from needle_dynamics.arrays import BoolArray, FloatArray
from needle_identification.errors import IdentificationError
from needle_identification.estimation.estimate import (
    DisplayedEstimate,
    EstimateRows,
    measured,
    named,
    ParameterEstimate,
    Statistic,
    statistic,
)
from needle_identification.estimation.prediction import (
    Moments,
    moments,
    predicted,
    RecordingPrediction,
)
from needle_identification.recordings.recording import IndentationRecording
from needle_identification.stiffness import checks, matrix
from needle_identification.stiffness.plateaus import find_plateaus, StiffnessSettings
from needle_identification.stiffness.presses import find_presses, grouped, Presses
import numpy as np

_WORTH_WARNING: Final = 0.1  # relative deviation above which a warning is given
_LARGEST_SCATTER: Final = 2.0  # largest ratio of scatter to noise for presses that follow a matrix
_CLEARLY: Final = 3.0  # significant change [standard errors]
_FEWEST_DIRECTIONS: Final = 4  # smallest number of directions without a warning


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class LevelEstimate(DisplayedEstimate):
    """Stiffness at a force level; ``level[name]`` is a parameter."""

    force: float  #: mean magnitude [N]
    parameters: tuple[ParameterEstimate, ...]  #: k_xx, k_xz, k_zx, k_zz [N/m]
    curl: ParameterEstimate  #: k_zx - k_xz [N/m], the curl of the force of the tissue -K d
    #: Frobenius norm of the antisymmetric part of K over the norm of the symmetric part [1]. It is
    #: nonnegative and biased upward near zero. Its interval has the nominal coverage and contains
    #: zero if the interval of the curl does.
    spring: ParameterEstimate
    is_spring: bool  #: whether the interval of ``spring`` is within ``largest_asymmetry``
    words: str  #: whether the tissue is a spring, and why
    principal: tuple[ParameterEstimate, ParameterEstimate]  #: larger, smaller [N/m]
    #: Direction of the larger stiffness, from x toward z, in (-pi/2, pi/2] [rad]; not determined
    #: if the two agree within their errors.
    angle: ParameterEstimate
    tissue_stiffness: ParameterEstimate  #: k_a = k_zz / contact length [N/m^2]
    presses: int  #: number of used presses
    directions: int  #: number of directions
    residual: float  #: root mean square of force minus K d [N]
    determination: float  #: coefficient of determination R^2
    condition: float  #: of the displacements; large for a single direction
    rotation: ParameterEstimate  #: of the axes of force that makes K symmetric [rad]
    moments: Moments  #: for the prediction of other places

    def __getitem__(self, name: str) -> ParameterEstimate:
        others = (
            self.curl, self.spring, self.rotation, *self.principal, self.angle,
            self.tissue_stiffness,
        )  # fmt: skip
        return named((*self.parameters, *others), name)

    def __repr__(self) -> str:
        (k_xx, k_xz), (k_zx, k_zz) = self.matrix.tolist()
        text = f'[[{k_xx:.4g}, {k_xz:.4g}], [{k_zx:.4g}, {k_zz:.4g}]] N/m'
        return f'<LevelEstimate at {self.force:.3g} N: K = {text}>'

    def rows(self) -> EstimateRows:
        return ((f'{self.force:.3g} N', one) for one in self.parameters)

    @property
    def matrix(self) -> FloatArray:
        """K [N/m], shape (2, 2), rows of force, columns of displacement; nan if undetermined."""
        return np.array([p.value for p in self.parameters]).reshape(2, 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class StiffnessEstimate(DisplayedEstimate):
    """Tissue stiffness at a place."""

    name: str  #: name of the recording
    levels: tuple[LevelEstimate, ...]  #: by force, in ascending order
    off_plane: float  #: largest ratio of displacement out of the plane to displacement in it
    warnings: tuple[str, ...]  #: warnings about the validity of the estimate
    presses: Presses  #: fitted presses

    def __repr__(self) -> str:
        forces = ', '.join(f'{level.force:.3g}' for level in self.levels)
        return f'<StiffnessEstimate of {self.name}: force levels {forces} N>'

    def rows(self) -> EstimateRows:
        return chain.from_iterable(level.rows() for level in self.levels)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class LevelSummary(DisplayedEstimate):
    """Force level over several places, a column of Table 2; ``level[name]`` is a statistic."""

    force: float  #: mean magnitude [N]
    statistics: tuple[Statistic, ...]  #: k_xx, k_xz, k_zx, k_zz, curl and tissue_stiffness
    prediction: RecordingPrediction | None  #: error of places predicted from the others

    def __getitem__(self, name: str) -> Statistic:
        return named(self.statistics, name)

    def rows(self) -> EstimateRows:
        return ((f'{self.force:.3g} N', one) for one in self.statistics)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class StiffnessSummary(DisplayedEstimate):
    """Stiffness over several places, as in Table 2."""

    levels: tuple[LevelSummary, ...]  #: by force, in ascending order
    tissue_stiffness: Statistic  #: k_a [N/m^2] at the chosen level
    estimates: tuple[StiffnessEstimate, ...]  #: one per place
    warnings: tuple[str, ...] = ()  #: warnings about all places

    def __repr__(self) -> str:
        one = self.tissue_stiffness
        found = measured(one.mean, one.error, one.unit)
        return f'<StiffnessSummary: {one.symbol} = {found}, n = {one.count}>'

    def rows(self) -> EstimateRows:
        return chain.from_iterable(level.rows() for level in self.levels)


def summarize_stiffness(
    estimates: Sequence[StiffnessEstimate],
    *,
    force: float | None = None,
    level_tolerance: float = StiffnessSettings().level_tolerance,
) -> StiffnessSummary:
    """
    Combine the estimates of several places, as in Table 2.

    Parameters
    ----------
    estimates : sequence of StiffnessEstimate
        One per place. A missing level of a place is replaced by the mean of the other places.
    force : float, optional
        Force level of the resulting tissue stiffness [N]; default the largest, as in the paper.
    level_tolerance : float, optional
        Tolerance within which levels of different places are grouped [N].

    Returns
    -------
    StiffnessSummary
        Means, standard deviations and standard errors by level.

    Raises
    ------
    IdentificationError
        If there are no estimates at all, or at the chosen force.

    """
    levels = [level for estimate in estimates for level in estimate.levels]
    if not levels:
        raise IdentificationError('no recordings to identify from')
    group = grouped(np.array([level.force for level in levels]), level_tolerance)
    summaries = []
    for number in range(int(group.max()) + 1):
        members = [level for level, of in zip(levels, group, strict=True) if of == number]
        mean = float(np.mean([level.force for level in members]))
        names = (*matrix.ENTRIES, 'curl', 'tissue_stiffness')
        found = tuple(statistic([level[name] for level in members]) for name in names)
        prediction = predicted([level.moments for level in members])
        summaries.append(LevelSummary(force=mean, statistics=found, prediction=prediction))
    chosen = summaries[-1]
    if force is not None:
        chosen = min(summaries, key=lambda summary: abs(summary.force - force))
        if not abs(chosen.force - force) <= level_tolerance:
            raise IdentificationError(
                f'no level at {force:g} N; there are '
                f'{", ".join(f"{summary.force:.3g}" for summary in summaries)} N'
            )
    return StiffnessSummary(
        levels=tuple(summaries),
        tissue_stiffness=chosen['tissue_stiffness'],
        estimates=tuple(estimates),
        warnings=tuple(
            f'{one.prediction.warning} (at {one.force:.3g} N)'
            for one in summaries
            if one.prediction is not None and one.prediction.warning
        ),
    )


def identify_stiffness(
    recording: IndentationRecording, settings: StiffnessSettings | None = None
) -> StiffnessEstimate:
    """
    Estimate the stiffness matrix at each force level of a recording.

    A hold is the longest interval of steady force and position. Rests are the steady intervals at
    the most frequent force. The zeros of force and position are tracked over the rests, which
    removes slow drift and the sensor bias. Standard errors are computed from the scatter of the
    presses about the matrix, intervals from Student's t.

    Parameters
    ----------
    recording : IndentationRecording
        Presses in any number of directions and levels, with rests in between.
    settings : StiffnessSettings, optional
        Thresholds of holds and rests, and the estimator.

    Returns
    -------
    StiffnessEstimate
        Matrix of each level; undetermined parameters are marked.

    Raises
    ------
    IdentificationError
        If there is no press, if the stiffness is negative, or if nearly each press has
        its own level of force.

    Examples
    --------
    Presses of 1.2 N in eight directions on a tissue of 800 N/m:

    >>> import numpy as np
    >>> angles = np.repeat(np.arange(8) * np.pi / 4, 2)
    >>> size = np.tile([1.2, 0.0], 8)
    >>> force = np.repeat(np.column_stack([size * np.cos(angles), size * np.sin(angles)]), 100, 0)
    >>> time = np.arange(len(force)) / 250.0
    >>> recording = IndentationRecording(time=time, position=force / 800.0, force=force)
    >>> estimate = identify_stiffness(recording)
    >>> [round(estimate.levels[0][name].value) for name in ('k_xx', 'k_xz', 'k_zx', 'k_zz')]
    [800, 0, 0, 800]

    """
    settings = settings or StiffnessSettings()
    try:
        plateaus = find_plateaus(recording, settings)
        presses, noise, warnings = find_presses(recording, plateaus, settings)
        members = [presses.level == index for index in range(int(presses.level.max()) + 1)]
        fit = partial(matrix.fit_matrix, presses, noise, estimator=settings.estimator)
        fits = [fit(np.flatnonzero(chosen)) for chosen in members]
        levels = [_level(presses, *pair, settings) for pair in zip(members, fits, strict=True)]
        for level, one in zip(levels, fits, strict=True):
            checks.check_axes(one, (level['k_xx'], level['k_zz']), level.principal[1])
        checks.check_levels(presses, fits, settings)
    except IdentificationError as error:
        raise type(error)(f'{recording.name}: {error}') from None
    by_doubt: dict[str, list[str]] = {}
    for index, (level, one) in enumerate(zip(levels, fits, strict=True)):
        for doubt, detail in _doubts(level, one, presses.displacement[members[index]]):
            by_doubt.setdefault(doubt, []).append(f'{detail} at {level.force:.3g} N')
    warnings += [f'{doubt} ({"; ".join(details)})' for doubt, details in by_doubt.items()]
    warnings += checks.unit_warnings(presses.force)
    if not all(one.known.all() for one in fits):
        warnings += checks.lag_warnings(recording)
    size = np.maximum(np.hypot(*presses.displacement.T), 1e-15)
    off_plane = float((np.abs(presses.off_plane) / size).max())
    if off_plane > _WORTH_WARNING:
        warnings.append(
            f'the end-effector moved out of the plane by up to {off_plane:.0%} of its '
            f'displacement in it (more than {_WORTH_WARNING:.0%}): the stiffness may be wrong'
        )
    return StiffnessEstimate(
        name=recording.name,
        levels=tuple(levels),
        off_plane=off_plane,
        warnings=tuple(warnings + _falling(presses, levels)),
        presses=presses,
    )


def _level(
    presses: Presses, chosen: BoolArray, fit: matrix.MatrixFit, settings: StiffnessSettings
) -> LevelEstimate:
    k_zz, length = float(fit.matrix[1, 1]), settings.contact_length
    curl, spring, is_spring, words = matrix.spring_estimates(fit, settings.largest_asymmetry)
    first, second, angle = matrix.principal_estimates(fit)
    force = presses.force[chosen]
    residual = float((fit.residual**2).sum())
    variation = float(((force - force.mean(axis=0)) ** 2).sum())
    is_known = fit.known.any()
    # Gradients of the entries of the matrix.
    units = np.eye(4).reshape(4, 2, 2)
    return LevelEstimate(
        force=float(np.hypot(*force.T).mean()),
        parameters=tuple(
            fit.derived(name, name, 'N/m', float(value), unit)
            for name, value, unit in zip(matrix.ENTRIES, fit.matrix.ravel(), units, strict=True)
        ),
        curl=curl,
        spring=spring,
        is_spring=is_spring,
        words=words,
        principal=(first, second),
        angle=angle,
        tissue_stiffness=fit.derived(
            'tissue_stiffness', 'k_a', 'N/m^2', k_zz / length, units[3] / length
        ),
        presses=len(force),
        directions=len(np.unique(presses.direction[chosen])),
        residual=sqrt(residual / len(force)) if is_known else nan,
        determination=1.0 - residual / variation if is_known and variation > 0.0 else nan,
        condition=fit.condition,
        rotation=matrix.rotation_estimate(fit),
        moments=moments(
            np.asarray(np.kron(np.eye(2), presses.displacement[chosen]), dtype=np.float64),
            fit.residual.T.ravel() if is_known else np.zeros(2 * len(force)),
            fit.matrix.ravel(),
        ),
    )


def _doubts(
    level: LevelEstimate, fit: matrix.MatrixFit, displacement: FloatArray
) -> Iterator[tuple[str, str]]:
    """Yield warnings about the matrix of a level, each with a detail of this level."""
    if not fit.known.all():
        lacking = ', '.join(p.symbol for p in level.parameters if not p.determined)
        yield (
            f'{lacking} not determined: {checks.unknown_because(displacement, fit)}',
            f'{level.presses} in {level.directions}',
        )
        return
    if words := checks.axes_doubt(fit, level.rotation):
        yield words, f'{degrees(level.rotation.value):.3g} deg'
    if level.directions < _FEWEST_DIRECTIONS:
        yield 'few directions; the paper has 8', f'{level.directions}'
    if fit.scatter > _LARGEST_SCATTER:
        yield (
            'the presses scatter more than their noise: F = K d does not hold exactly',
            f'{fit.scatter:.2g} times',
        )
    k_xx, k_zz = level['k_xx'].value, level['k_zz'].value
    low, high = fit.derived('', '', '', k_xx - k_zz, np.diag([1.0, -1.0])).interval
    if (low > 0.0 or high < 0.0) and abs(k_xx - k_zz) > _WORTH_WARNING * abs(k_zz):
        yield (
            'k_xx differs from k_zz: the tissue is anisotropic, or the motion left the plane',
            f'{k_xx:.3g} and {k_zz:.3g} N/m',
        )


def _falling(presses: Presses, levels: Sequence[LevelEstimate]) -> list[str]:
    along = (presses.force * presses.displacement).sum(axis=1) / np.hypot(*presses.force.T)
    error = np.hypot(*presses.displacement_error.T)
    falls: dict[tuple[int, int], int] = {}
    directions = range(int(presses.direction.max()) + 1)
    for direction in directions:
        same = presses.direction == direction
        met = np.unique(presses.level[same])
        where = [same & (presses.level == level) for level in met]
        for (low, before), (high, after) in pairwise(zip(met, where, strict=True)):
            rise = along[after].mean() - along[before].mean()
            if rise < -_CLEARLY * hypot(error[after].mean(), error[before].mean()):
                falls[low, high] = falls.get((low, high), 0) + 1
    return [
        f'in {count} of {len(directions)} directions the displacement decreases as the force '
        f'increases from {levels[low].force:.3g} to {levels[high].force:.3g} N'
        for (low, high), count in sorted(falls.items())
    ]
