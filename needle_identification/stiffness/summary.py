"""Summary of stiffness over several places, as in Table 2."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from needle_identification.errors import IdentificationError
from needle_identification.estimation.estimate import Named, Statistic, statistic
from needle_identification.stiffness.estimate import StiffnessEstimate
from needle_identification.stiffness.matrix import ENTRIES
from needle_identification.stiffness.presses import grouped
from needle_identification.stiffness.settings import StiffnessSettings
import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelSummary(Named[Statistic]):
    """
    Force level over several places: a column of Table 2.

    Attributes
    ----------
    force : float
        Mean magnitude of the force [N].
    statistics : tuple of Statistic
        k_xx, k_xz, k_zx, k_zz, curl and tissue_stiffness; ``level[name]`` returns a statistic.

    """

    force: float
    statistics: tuple[Statistic, ...]

    def _named(self) -> tuple[Statistic, ...]:
        return self.statistics


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StiffnessSummary:
    """
    Stiffness over several places, as in Table 2.

    Attributes
    ----------
    levels : tuple of LevelSummary
        By force, in ascending order.
    tissue_stiffness : Statistic
        k_a [N/m^2] at the chosen level.
    estimates : tuple of StiffnessEstimate
        One per place.
    warnings : tuple of str
        Warnings about all places.

    """

    levels: tuple[LevelSummary, ...]
    tissue_stiffness: Statistic
    estimates: tuple[StiffnessEstimate, ...]
    warnings: tuple[str, ...] = ()


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
        summaries.append(
            LevelSummary(
                force=float(np.mean([level.force for level in members])),
                statistics=tuple(
                    statistic([level[name] for level in members])
                    for name in (*ENTRIES, 'curl', 'tissue_stiffness')
                ),
            )
        )
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
    )
