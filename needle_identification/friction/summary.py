"""Friction over several recordings, as in Table 1."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from needle_identification.errors import IdentificationError
from needle_identification.estimation.estimate import (
    Named,
    ParameterEstimate,
    Statistic,
    statistic,
)
from needle_identification.friction.estimate import FrictionEstimate


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrictionSummary(Named[Statistic]):
    """
    Friction over several recordings.

    Attributes
    ----------
    statistics : tuple of Statistic
        One per parameter; ``summary[name]`` gives one.
    estimates : tuple of FrictionEstimate
        One per recording.

    """

    statistics: tuple[Statistic, ...]
    estimates: tuple[FrictionEstimate, ...]

    def _named(self) -> tuple[Statistic, ...]:
        return self.statistics


def summarize(estimates: Sequence[FrictionEstimate]) -> FrictionSummary:
    """
    Combine the estimates of several recordings, as in Table 1.

    Parameters
    ----------
    estimates : sequence of FrictionEstimate
        One per recording.

    Returns
    -------
    FrictionSummary
        One `statistic` per parameter, then those of the breakaway force and the lag if any
        recording has them.

    Raises
    ------
    IdentificationError
        If there are no estimates.

    """
    if not estimates:
        raise IdentificationError('no recordings to identify from')
    found: dict[str, list[ParameterEstimate]] = {}
    for estimate in estimates:
        for parameter in (*estimate.parameters, estimate.breakaway, estimate.lag):
            if parameter is not None:
                found.setdefault(parameter.name, []).append(parameter)
    return FrictionSummary(
        statistics=tuple(statistic(parameters) for parameters in found.values()),
        estimates=tuple(estimates),
    )
