"""All claims of ``claims.yaml``, judged in the order of the paper."""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from types import ModuleType
from typing import Any

from needle_insertion.paper.claims import (
    analysis,
    assumptions,
    control,
    identified,
    mismatch,
    needle,
)
from needle_insertion.paper.claims.claim import Claim, FAILS, Finding, HOLDS, ONLY_IF, Tables
from needle_insertion.paper.mismatch import Mismatch
from needle_insertion.report.content import Grid, Section
import yaml


def judge_claims(
    tables: Tables, study: Mismatch, progress: Callable[[], object] | None = None
) -> list[Claim]:
    """
    Judge every claim. The same arguments give the same claims.

    Parameters
    ----------
    tables : Tables
        Statistics behind Tables 1 and 2.
    study : Mismatch
        Insertions of needles that the controllers do not know.
    progress : callable, optional
        Called after each claim.

    Returns
    -------
    list of Claim
        In the order of the paper.

    """
    found = []
    for entry in _entries():
        found.append(Claim(**entry) if 'test' in entry else _judged(entry, tables, study))
        if progress is not None:
            progress()
    return found


def _entries() -> list[dict[str, Any]]:
    text = files(__package__).joinpath('claims.yaml').read_text(encoding='utf-8')
    entries: list[dict[str, Any]] = yaml.safe_load(text)
    return entries


def _judged(entry: dict[str, Any], tables: Tables, study: Mismatch) -> Claim:
    """Judge a claim by the function of its name, which is private to its module."""
    name = f'_{entry["name"]}'
    modules: tuple[tuple[ModuleType, tuple[Any, ...]], ...] = (
        *((needle, ()), (assumptions, ()), (identified, (tables,)), (analysis, ()), (control, ())),
        (mismatch, (study,)),
    )
    judge, arguments = next(
        (getattr(module, name), arguments)
        for module, arguments in modules
        if hasattr(module, name)
    )
    finding: Finding = judge(*arguments)
    words = {
        key: text.format(source=tables.source, **finding.numbers) for key, text in entry.items()
    }
    return Claim(**words, verdict=finding.verdict, numbers=finding.numbers)


def section(found: list[Claim]) -> Section:
    """
    Return the claims for the page.

    Parameters
    ----------
    found : list of Claim
        From `judge_claims`.

    Returns
    -------
    Section
        A count of the verdicts, and a table.

    """
    verdicts = [one.verdict for one in found]
    return Section(
        title='What the paper claims',
        paragraphs=(
            (
                f'{len(found)} claims: {verdicts.count(HOLDS)} hold, {verdicts.count(ONLY_IF)} '
                f'hold only if a condition is met, {verdicts.count(FAILS)} do not hold. The '
                'numbers beside most of them are computed in this run, and decide. The others '
                'are proved by the test of the package that stands beside them. Where a claim '
                'turns on a unit, on a cause that data cannot tell or on what it leaves unsaid, '
                'numbers can refute it, but the condition is our judgment. Statements on the '
                'literature and on clinical practice are not among them.'
            ),
        ),
        tables=(
            Grid(
                caption='Claims with verdict and evidence',
                heads=('claim', 'where', 'verdict', 'evidence'),
                rows=tuple(
                    (
                        one.claim,
                        one.section,
                        one.words,
                        f'{one.evidence} (Test: {one.test})' if one.test else one.evidence,
                    )
                    for one in found
                ),
            ),
        ),
    )
