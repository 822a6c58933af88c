"""What a claim is, and what it is judged by."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple, TypeAlias

from needle_insertion.paper.tables import EXPERIMENTS, TABLE_1, TABLE_2

HOLDS: Final = 'holds'
ONLY_IF: Final = 'holds only if'
FAILS: Final = 'does not hold'

Numbers: TypeAlias = Mapping[str, float | str]


class Finding(NamedTuple):
    """
    What a computation says of a claim.

    Attributes
    ----------
    verdict : str
        `HOLDS`, `ONLY_IF` or `FAILS`.
    numbers : Numbers
        Numbers of the evidence by name, in the units of its words.

    """

    verdict: str
    numbers: Numbers


def finding(numbers: Numbers, *, always: bool, sometimes: bool = False) -> Finding:
    """
    Derive a verdict.

    Parameters
    ----------
    numbers : Numbers
        Numbers of the evidence.
    always : bool
        Whether the claim holds.
    sometimes : bool
        Whether it holds under its condition.

    Returns
    -------
    Finding
        Verdict and numbers.

    """
    return Finding(HOLDS if always else ONLY_IF if sometimes else FAILS, numbers)


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """
    One claim of the paper with its verdict.

    Attributes
    ----------
    name : str
        Short name, that of the function that judges it.
    section : str
        Where the paper makes it.
    claim : str
        What it says.
    verdict : str
        `HOLDS`, `ONLY_IF` or `FAILS`.
    condition : str
        The condition of `ONLY_IF`.
    evidence : str
        What the verdict rests on, in words with numbers.
    numbers : Numbers
        The numbers, by name.
    test : str
        The test that proves it, where one does.

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
    Statistics that claims about Tables 1 and 2 are judged by.

    Attributes
    ----------
    source : str
        Where they come from, in words.
    friction : Mapping[str, tuple of float]
        Mean and standard deviation by the keys of `TABLE_1`, SI.
    stiffness : Mapping[str, tuple of tuple of float]
        Means and standard deviations at each force level by the keys of `TABLE_2`, SI.
    experiments : int
        Number of experiments behind each.

    """

    source: str = 'the printed tables'
    friction: Mapping[str, tuple[float, float]] = field(default_factory=lambda: TABLE_1)
    stiffness: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]] = field(
        default_factory=lambda: TABLE_2
    )
    experiments: int = EXPERIMENTS
