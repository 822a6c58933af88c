# SPDX-License-Identifier: Apache-2.0
"""Compare estimates with the true values of the simulated robot that was recorded."""

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
from needle_insertion.report.paper_tables import TABLE_1, TABLE_2
import numpy as np
from reproduction.protocol import indenter_name
from scipy.special import bdtr

#: Coverage of an interval, and the significance level of a shortfall.
LEVEL: Final = 0.95
IMPROBABLE: Final = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class TruthComparison:
    """An estimate and its true value."""

    estimate: ParameterEstimate
    truth: float | None  #: In the unit of the estimate; None if the recording lacks it.
    force: float | None = None  #: Force level of a stiffness [N].

    @property
    def holds(self) -> bool:
        """Whether the interval is determined and contains the true value."""
        low, high = self.estimate.interval
        return self.estimate.determined and self.truth is not None and low <= self.truth <= high


@dataclass(frozen=True, slots=True)
class Coverage:
    """Number of 95 % intervals with a true value (`known`), and that contain it (`held`)."""

    held: int = 0
    known: int = 0

    @classmethod
    def of(cls, comparisons: Iterable[TruthComparison]) -> Coverage:
        known = [one.holds for one in comparisons if one.truth is not None]
        return cls(sum(known), len(known))

    @property
    def least(self) -> int:
        """Least number of intervals with the true value, except with a probability of 1 %."""
        chances = bdtr(np.arange(self.known + 1), self.known, LEVEL)
        return int(np.searchsorted(chances, IMPROBABLE))

    @property
    def is_enough(self) -> bool:
        """Whether the number of intervals with the true value is consistent with 95 %."""
        return self.held >= self.least


def compare_friction(recording: Recording, estimate: FrictionEstimate) -> list[TruthComparison]:
    """Compare the friction estimate with the recorded plant, in the order of Table 1."""
    truth = recording.truth or {}
    return [
        TruthComparison(estimate=estimate[name], truth=truth.get(f'model.{name}'))
        for name in TABLE_1
    ]


def compare_stiffness(
    recording: IndentationRecording, estimate: StiffnessEstimate
) -> list[TruthComparison]:
    """Compare the stiffness estimate with the recorded indenter, by entry of Table 2 and level."""
    return [
        TruthComparison(
            estimate=level[entry],
            truth=_stiffness(recording.truth, entry, level.force),
            force=level.force,
        )
        for entry in TABLE_2
        for level in estimate.levels
    ]


def _stiffness(truth: Mapping[str, Any] | None, entry: str, force: float) -> float | None:
    """Return the true stiffness at the indenter level nearest to a force."""
    known = truth or {}
    values = known.get(f'indenter.{indenter_name(entry)}')
    if values is None:
        return None
    levels = np.array(known['indenter.force_levels'])
    return float(values[int(np.abs(levels - force).argmin())])
