# SPDX-License-Identifier: Apache-2.0
"""Tissue stiffness at a place, by force level, and summary over places, as in Table 2."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

from needle_dynamics.arrays import FloatArray
from needle_identification.errors import IdentificationError
from needle_identification.estimation.display import DisplayedEstimate, EstimateRows
from needle_identification.estimation.estimate import (
    named,
    ParameterEstimate,
    Statistic,
    statistic,
)
from needle_identification.estimation.formatting import measured
from needle_identification.estimation.prediction import Moments, predicted, RecordingPrediction
from needle_identification.stiffness.matrix import ENTRIES
from needle_identification.stiffness.presses import grouped, Presses
from needle_identification.stiffness.settings import StiffnessSettings
import numpy as np


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
        matrix = f'[[{k_xx:.4g}, {k_xz:.4g}], [{k_zx:.4g}, {k_zz:.4g}]] N/m'
        return f'<LevelEstimate at {self.force:.3g} N: K = {matrix}>'

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
        names = (*ENTRIES, 'curl', 'tissue_stiffness')
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
