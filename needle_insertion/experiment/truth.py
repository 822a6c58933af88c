"""Estimates beside the true values of the simulated robot that was recorded."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from needle_identification import (
    FrictionEstimate,
    IndentationRecording,
    ParameterEstimate,
    Recording,
    StiffnessEstimate,
)
from needle_insertion.experiment.protocol import indenter_name
from needle_insertion.paper.tables import TABLE_1, TABLE_2
import numpy as np
from scipy.special import bdtr

#: Probability with which an interval holds the true value, and the probability of a shortfall
#: below which it is not taken for chance.
LEVEL: Final = 0.95
IMPROBABLE: Final = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """
    An estimate beside its true value.

    Attributes
    ----------
    estimate : ParameterEstimate
        The estimate.
    truth : float or None
        The true value in the unit of the estimate; None if the recording does not hold it.
    force : float or None
        Force level of a stiffness [N].

    """

    estimate: ParameterEstimate
    truth: float | None
    force: float | None = None

    @property
    def holds(self) -> bool:
        """Whether the interval is known and holds the true value."""
        low, high = self.estimate.interval
        return self.estimate.determined and self.truth is not None and low <= self.truth <= high


@dataclass(frozen=True, slots=True)
class Coverage:
    """
    How many 95 % intervals hold the true value.

    Attributes
    ----------
    held, known : int
        Intervals that hold it, and intervals whose true value is known.

    """

    held: int = 0
    known: int = 0

    @classmethod
    def of(cls, comparisons: Iterable[Comparison]) -> Coverage:
        """
        Count intervals.

        Parameters
        ----------
        comparisons : iterable of Comparison
            Estimates beside their true values.

        Returns
        -------
        Coverage
            Over all of them.

        """
        known = [one.holds for one in comparisons if one.truth is not None]
        return cls(sum(known), len(known))

    @property
    def least(self) -> int:
        """Number of intervals that hold the true value at least, except by 1 % chance."""
        chances = bdtr(np.arange(self.known + 1), self.known, LEVEL)
        return int(np.searchsorted(chances, IMPROBABLE))

    @property
    def is_enough(self) -> bool:
        """Whether no fewer intervals hold the true value than chance allows."""
        return self.held >= self.least


def compare_friction(recording: Recording, estimate: FrictionEstimate) -> list[Comparison]:
    """
    Compare friction with that of the recorded plant.

    Parameters
    ----------
    recording : Recording
        The recording, with the configuration of its plant.
    estimate : FrictionEstimate
        What was identified from it.

    Returns
    -------
    list of Comparison
        In the order of Table 1.

    """
    truth = recording.truth or {}
    return [
        Comparison(estimate=estimate[name], truth=truth.get(f'model.{name}')) for name in TABLE_1
    ]


def compare_stiffness(
    recording: IndentationRecording, estimate: StiffnessEstimate
) -> list[Comparison]:
    """
    Compare the stiffness at each force with that of the recorded indenter.

    Parameters
    ----------
    recording : IndentationRecording
        The recording, with the configuration of its plant.
    estimate : StiffnessEstimate
        What was identified from it.

    Returns
    -------
    list of Comparison
        Entries in the order of Table 2, at all levels each.

    """
    return [
        Comparison(
            estimate=level[entry],
            truth=_stiffness(recording.truth, entry, level.force),
            force=level.force,
        )
        for entry in TABLE_2
        for level in estimate.levels
    ]


def _stiffness(truth: Mapping[str, Any] | None, entry: str, force: float) -> float | None:
    """Return the true stiffness at the level of the indenter that is nearest to a force."""
    known = truth or {}
    values = known.get(f'indenter.{indenter_name(entry)}')
    if values is None:
        return None
    levels = np.array(known['indenter.force_levels'])
    return float(values[int(np.abs(levels - force).argmin())])
