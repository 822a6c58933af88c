"""Summary of friction over several recordings, as in Table 1."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import log
from sys import float_info

from needle_identification.errors import IdentificationError
from needle_identification.estimation.estimate import (
    Named,
    ParameterEstimate,
    Statistic,
    statistic,
)
from needle_identification.friction.comparison import CandidateFit, SIGNIFICANCE
from needle_identification.friction.estimate import FrictionEstimate
from scipy.special import chdtrc


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrictionSummary(Named[Statistic]):
    """
    Friction over several recordings.

    Attributes
    ----------
    statistics : tuple of Statistic
        One per parameter; ``summary[name]`` returns a statistic.
    estimates : tuple of FrictionEstimate
        One per recording.
    warnings : tuple of str
        Warnings that only all recordings together support.

    """

    statistics: tuple[Statistic, ...]
    estimates: tuple[FrictionEstimate, ...]
    warnings: tuple[str, ...] = ()

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
        One `statistic` per parameter, then breakaway force and lag if any recording has them.

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
        warnings=tuple(_together(estimates)),
    )


def _together(estimates: Sequence[FrictionEstimate]) -> Iterator[str]:
    """Warn of a term that the recordings support only together, by Fisher's test."""
    tried: dict[str, list[CandidateFit]] = {}
    for estimate in estimates:
        for one in estimate.comparison:
            if len(one.terms) == len(estimate.terms) + 1:
                tried.setdefault(one.terms[-1], []).append(one)
    if any(one.supported for ones in tried.values() for one in ones):
        return
    found = {
        term: float(
            chdtrc(2.0 * len(ones), -2.0 * sum(log(max(o.p_value, float_info.min)) for o in ones))
        )
        for term, ones in tried.items()
        if len(ones) > 1
    }
    term = min(found, key=lambda term: found[term], default='')
    if term and found[term] * len(found) < SIGNIFICANCE:
        yield (
            f'together the {len(tried[term])} recordings support {term} '
            f'(p = {found[term] * len(found):.2g}): add the term {term}'
        )
