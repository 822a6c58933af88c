"""Claim of the paper, and the statistics for its verdict."""

from __future__ import annotations

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
    """
    Claim of the paper with its verdict.

    Attributes
    ----------
    name : str
        Short name, equal to the name of the function that computes the verdict.
    section : str
        Section of the paper.
    claim : str
        Statement of the paper.
    verdict : str
        `HOLDS`, `ONLY_IF` or `FAILS`.
    condition : str
        Condition of `ONLY_IF`.
    evidence : str
        Evidence as text with numbers.
    numbers : Numbers
        Numbers of the evidence, by name.
    test : str
        Test that proves the verdict, if any.

    """

    name: str
    section: str
    claim: str
    verdict: str
    condition: str = ''
    evidence: str
    numbers: Numbers = field(default_factory=dict)
    test: str = ''

    @property
    def words(self) -> str:
        """Verdict with its condition."""
        return f'{self.verdict} {self.condition}' if self.verdict == ONLY_IF else self.verdict


@dataclass(frozen=True, slots=True, kw_only=True)
class Tables:
    """
    Statistics for claims about Tables 1 and 2.

    Attributes
    ----------
    source : str
        Source as text.
    friction : Mapping[str, tuple of float]
        Mean and standard deviation by the keys of `TABLE_1`, SI.
    stiffness : Mapping[str, tuple of tuple of float]
        Means and standard deviations at each force level by the keys of `TABLE_2`, SI.
    experiments : int
        Number of experiments of each statistic.

    """

    source: str = 'the printed tables'
    friction: Mapping[str, tuple[float, float]] = field(default_factory=lambda: TABLE_1)
    stiffness: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]] = field(
        default_factory=lambda: TABLE_2
    )
    experiments: int = EXPERIMENTS
