# SPDX-License-Identifier: Apache-2.0
"""Reproduce the results of the paper as text, as JSON, and as a page."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field
from functools import cache, partial
from itertools import count
from math import nan
from pathlib import Path
from typing import Any, Final

from needle_insertion.progress import ProgressLine
from needle_insertion.report.content import filled, table
from needle_insertion.report.page import write_page
from needle_insertion.report.paper_tables import TABLE_1, TABLE_2
from reproduction import claims, controllability, figures, mismatch, needle_constants
from reproduction.campaign import Campaign
from reproduction.content import ReportSection
from reproduction.identified import (
    IdentifiedTable,
    identify_table,
    ReproduceError,
    TABLES,
    VERDICTS,
)
from reproduction.protocol import PROTOCOLS

#: Tables that decide about a result.
_JUDGED_BY: Final[Mapping[str, tuple[str, ...]]] = {
    **{name: (name,) for name in TABLES},
    'claims': tuple(TABLES),
    'all': tuple(TABLES),
}

VERDICT_HEADS: Final = ('where', 'what', 'verdict')  #: Heads of `Result.verdicts`.


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """Result for the page (`section`), the terminal (`text`) and JSON (`document`)."""

    section: ReportSection
    text: str
    #: Place in the paper, statement, and verdict.
    verdicts: tuple[tuple[str, str, str], ...] = ()
    document: Mapping[str, Any] = field(default_factory=dict)
    holds: bool = True  #: False if a table differs from the paper.


def campaigns(what: str) -> dict[str, Campaign]:
    """Return the campaigns of a result (``table-1``, ``claims``, ``all``), by experiment."""
    if what not in _JUDGED_BY:
        raise ReproduceError(f'{what} is computed: there is nothing to --record')
    names = [TABLES[name][0] for name in _JUDGED_BY[what]]
    return {name: Campaign(protocol=PROTOCOLS[name]) for name in names}


def results(what: str, recorded: Mapping[str, Sequence[Path]] | None = None) -> dict[str, Result]:
    """
    Compute a result (``figure-4``, ``table-1``, ``claims``) or ``all``, in page order.

    ``recorded`` are recordings by experiment, by default the shipped recordings.
    """
    tables = {name: identify_table(name, recorded) for name in _JUDGED_BY.get(what, ())}
    source = f'the {"shipped" if recorded is None else "new"} simulated recordings'
    jobs = _jobs(tables, source)
    chosen = [name for name in jobs if name not in figures.FIGURES] if what == 'all' else [what]
    found = {}
    for name in chosen:
        # These show how far they are.
        own = name in ('claims', 'mismatch')
        with nullcontext() if own else ProgressLine(name, brief=True):
            found[name] = jobs[name]()
    return found


def _jobs(tables: Mapping[str, IdentifiedTable], source: str) -> dict[str, Callable[[], Result]]:
    """Return the functions that compute each result; ``figures`` combines all figures."""
    return {
        'claims': lambda: _of_claims(_judged(tables, source)),
        **{name: partial(_of_table, one) for name, one in tables.items()},
        'table-3': lambda: _of_section(needle_constants.section()),
        **{name: partial(_of_figure, name) for name in figures.FIGURES},
        'figures': lambda: _of_section(figures.section()),
        'controllability': lambda: _of_section(controllability.section()),
        'mismatch': lambda: _of_section(mismatch.section(_study())),
    }


def _of_table(found: IdentifiedTable) -> Result:
    section = found.section
    (grid,) = section.tables
    return Result(
        section=section,
        text=f'{table(grid.rows, grid.heads)}\n\n{found.words}',
        verdicts=((found.title, 'means and STD agree with the paper', VERDICTS[found.holds]),),
        document=found.document,
        holds=found.holds,
    )


def _of_claims(judged: list[claims.Claim]) -> Result:
    section = claims.section(judged)
    rows = [(one.section, one.claim, one.words) for one in judged]
    return Result(
        section=section,
        text=f'{filled(section.paragraphs[0])}\n\n{table(rows, VERDICT_HEADS)}',
        verdicts=tuple((one.section, one.claim, one.verdict) for one in judged),
        document={'claims': [asdict(one) for one in judged]},
    )


def _of_section(section: ReportSection, **more: object) -> Result:
    grids = (f'{one.caption}\n\n{table(one.rows, one.heads)}' for one in section.tables)
    captions = [one.caption for one in section.pictures]
    return Result(
        section=section,
        text='\n\n'.join((*map(filled, section.paragraphs), *grids, *map(filled, captions))),
        document={
            'title': section.title,
            'paragraphs': section.paragraphs,
            'tables': [asdict(one) for one in section.tables],
            'captions': captions,
            **more,
        },
    )


def _of_figure(name: str) -> Result:
    found = figures.FIGURES[name]()
    section = ReportSection(
        title=name.replace('-', ' ').capitalize(),
        paragraphs=(),
        tables=(found.table(),),
        pictures=(found.picture,),
    )
    runs = [{'run': case, **asdict(one)} for case, one in found.outcomes.items()]
    return _of_section(section, runs=runs)


@cache
def _study() -> mismatch.Mismatch:
    with _counted('mismatch', 1001 * len(mismatch.CASES)) as step:
        return mismatch.study(progress=step)


def _judged(tables: Mapping[str, IdentifiedTable], source: str) -> list[claims.Claim]:
    study = _study()
    with _counted('claims') as step:
        return claims.judge_claims(_statistics(tables, source), study, step)


@contextmanager
def _counted(what: str, total: int | None = None) -> Iterator[Callable[[], None]]:
    """Show the number of calls of the result."""
    numbers = count(1)
    with ProgressLine(what, brief=True) as show:

        def step() -> None:
            number = next(numbers)
            show(f'{number}' if total is None else f'{number} of {total}')

        yield step


def _statistics(tables: Mapping[str, IdentifiedTable], source: str) -> claims.Tables:
    """Return identified tables as statistics for the claims."""
    found: dict[str, list[tuple[float, float]]] = {}
    for line in (line for one in tables.values() for line in one.lines):
        mean, deviation = line.found.mean, line.found.deviation
        pairs = found.setdefault(line.found.name, [])
        pairs.append((mean, nan if deviation is None else deviation))
    by_level = {entry: list(zip(*found[entry], strict=True)) for entry in TABLE_2}
    return claims.Tables(
        source=source,
        friction={name: found[name][0] for name in TABLE_1},
        stiffness={entry: (means, scatter) for entry, (means, scatter) in by_level.items()},
        experiments=min(len(one.bags) for one in tables.values()),
    )


def write_results(folder: Path, found: Mapping[str, Result]) -> Path:
    """Write results as a page ``reproduce.html`` with an overview; return its path."""
    cards = []
    if 'claims' in found:
        said = [verdict for _where, _what, verdict in found['claims'].verdicts]
        conditional, failed = said.count(claims.ONLY_IF), said.count(claims.FAILS)
        cards.append(
            (
                'Claims of the paper',
                f'{said.count(claims.HOLDS)} of {len(said)} hold',
                f'{conditional} hold only under a condition, {failed} do not hold',
            )
        )
    for one in (found[name] for name in TABLES if name in found):
        lines, bags = (len(one.document[name]) for name in ('lines', 'bags'))
        note = f'{lines} quantities, means and STD, from {bags} simulated recordings'
        cards.append((one.section.title, VERDICTS[one.holds], note))
    sections = [one.section for one in found.values()]
    path = folder / 'reproduce.html'
    write_page(
        path,
        'sections.html',
        title='The paper, reproduced',
        introduction='A. Boroomand, M. Tavakoli, R. Sloboda, N. Usmani, Dynamical modeling and '
        'controllability analysis of a flexible needle in soft tissue (2014): reproduced figures, '
        'tables and claims.',
        pictures=[picture for section in sections for picture in section.pictures],
        cards=cards,
        sections=sections,
    )
    return path
