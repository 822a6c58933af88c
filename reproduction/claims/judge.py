# SPDX-License-Identifier: Apache-2.0
"""Compute the verdicts on all claims of ``claims.yaml`` in the order of the paper."""

from collections.abc import Callable
from importlib.resources import files
from types import ModuleType
from typing import Any

from reproduction.claims import analysis, assumptions, control, identified, mismatch, needle
from reproduction.claims.claim import Claim, FAILS, Finding, HOLDS, ONLY_IF, Tables
from reproduction.content import Grid, ReportSection
from reproduction.mismatch import Mismatch
import yaml


def judge_claims(
    tables: Tables, study: Mismatch, progress: Callable[[], object] | None = None
) -> list[Claim]:
    """Compute the verdict on every claim, in the order of the paper, with progress after each."""
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
    """Compute a verdict by the private function of the same name in its module."""
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


def section(found: list[Claim]) -> ReportSection:
    """Return the section of the results page: number of verdicts, and table of claims."""
    verdicts = [one.verdict for one in found]
    return ReportSection(
        title='Claims of the paper',
        paragraphs=(
            (
                f'{len(found)} claims: {verdicts.count(HOLDS)} hold, {verdicts.count(ONLY_IF)} '
                f'hold only if a condition is met, {verdicts.count(FAILS)} do not hold. The '
                'verdict on most of them is computed in this run from the listed numbers. The '
                'others are proved by the listed test of the package. If a claim depends on a '
                'unit, on a cause that the data do not identify or on an unstated assumption, '
                'numbers can refute it, but the condition is our judgment. Statements on the '
                'literature and on clinical practice are not included.'
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
