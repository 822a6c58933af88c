# SPDX-License-Identifier: Apache-2.0
"""Claim of the paper, and the statistics for its verdict."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple, TypeAlias

from needle_insertion.report.paper_tables import EXPERIMENTS, TABLE_1, TABLE_2

HOLDS: Final = 'holds'
ONLY_IF: Final = 'holds only if'
FAILS: Final = 'does not hold'

Numbers: TypeAlias = Mapping[str, float | str]


class Finding(NamedTuple):
    """Verdict (`HOLDS`, `ONLY_IF`, `FAILS`), and numbers in the units of the evidence."""

    verdict: str
    numbers: Numbers


def finding(numbers: Numbers, *, always: bool, sometimes: bool = False) -> Finding:
    """Return a finding for a claim that holds ``always``, or ``sometimes``: under a condition."""
    return Finding(HOLDS if always else ONLY_IF if sometimes else FAILS, numbers)


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """Claim of the paper with its verdict."""

    name: str  #: Short name, equal to the name of the function that computes the verdict.
    #: Section of the paper, and its statement.
    section: str
    claim: str
    #: `HOLDS`, `ONLY_IF` or `FAILS`, and the condition of `ONLY_IF`.
    verdict: str
    condition: str = ''
    #: Evidence as text with numbers, and these numbers by name.
    evidence: str
    numbers: Numbers = field(default_factory=dict)
    test: str = ''  #: Test that proves the verdict, if any.

    @property
    def words(self) -> str:
        """Verdict with its condition."""
        return f'{self.verdict} {self.condition}' if self.verdict == ONLY_IF else self.verdict


@dataclass(frozen=True, slots=True, kw_only=True)
class Tables:
    """Statistics for claims about Tables 1 and 2."""

    source: str = 'the printed tables'
    #: Mean and standard deviation by the keys of `TABLE_1`, SI.
    friction: Mapping[str, tuple[float, float]] = field(default_factory=lambda: TABLE_1)
    #: Means and standard deviations at each force level by the keys of `TABLE_2`, SI.
    stiffness: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]] = field(
        default_factory=lambda: TABLE_2
    )
    experiments: int = EXPERIMENTS  #: Number of experiments of each statistic.
