"""`needle reproduce`: the paper's results anew, each beside what the paper prints."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache, cached_property
import json
from math import nan, pi, sqrt
from pathlib import Path
import sys
from typing import Any, Final

from needle_dynamics import NeedleError, NeedleParameters, ParameterError
from needle_identification import (
    identify_friction,
    identify_stiffness,
    ParameterEstimate,
    read_friction_recording,
    read_indentation_recording,
    Statistic,
    summarize,
    summarize_stiffness,
)
from needle_insertion.commands import analyze
from needle_insertion.experiment.campaign import Campaign
from needle_insertion.experiment.protocol import indenter_name, PROTOCOLS, SHIPPED_BAGS
from needle_insertion.paper import claims, figures, mismatch
from needle_insertion.paper.figures import FIGURES
from needle_insertion.paper.tables import FORCE_LEVELS, TABLE_1, TABLE_2
from needle_insertion.report.page import (
    grid,
    heading,
    headline,
    paragraph,
    Picture,
    table,
    write_document,
)
from needle_insertion.report.section import Grid, Section
import numpy as np
from scipy.stats import binom, chi2
from tqdm import tqdm

#: Confidence of the intervals, and probability below which a shortfall is no chance.
LEVEL, IMPROBABLE = 0.95, 0.01


class ReproduceError(NeedleError):
    """There is nothing to reproduce a result from."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """
    One published quantity beside what the recordings give.

    Attributes
    ----------
    quantity : str
        With the condition it holds under.
    paper : (float, float)
        Published mean and standard deviation, SI.
    found : Statistic
        The same over the recordings.
    held, known : int
        Recordings whose own true value is known, and those of them whose 95 % interval holds it.

    """

    quantity: str
    paper: tuple[float, float]
    found: Statistic
    held: int = 0
    known: int = 0

    @property
    def deviation_interval(self) -> tuple[float, float]:
        """95 % confidence interval of the standard deviation, as of a normal population."""
        return deviation_interval(self.found.deviation, self.found.count)

    @property
    def holds(self) -> bool:
        """Whether both intervals hold what is published."""
        return all(
            low <= value <= high
            for value, (low, high) in zip(
                self.paper, (self.found.interval, self.deviation_interval), strict=True
            )
        )


def deviation_interval(deviation: float | None, count: int) -> tuple[float, float]:
    """
    Return the confidence interval of a standard deviation, by the chi-squared distribution.

    Parameters
    ----------
    deviation : float or None
        Standard deviation of a sample; None if there is none.
    count : int
        Size of the sample.

    Returns
    -------
    (float, float)
        Of the population, were it normal.

    """
    if deviation is None:
        return 0.0, float('inf')
    low, high = (
        deviation * sqrt((count - 1) / chi2.ppf(tail, count - 1))
        for tail in ((1.0 + LEVEL) / 2.0, (1.0 - LEVEL) / 2.0)
    )
    return float(low), float(high)


def fewest(trials: int) -> int:
    """Return how many of that many 95 % intervals hold the truth at least, but for 1 %."""
    return int(binom.ppf(IMPROBABLE, trials, LEVEL))


def count_held(
    estimates: Sequence[ParameterEstimate], truths: Sequence[float | None]
) -> tuple[int, int]:
    """Return how many intervals hold their truth, and how many truths are known."""
    known = [
        (estimate, truth)
        for estimate, truth in zip(estimates, truths, strict=True)
        if truth is not None
    ]
    held = sum(e.determined and e.interval[0] <= t <= e.interval[1] for e, t in known)
    return held, len(known)


def table_1(bags: Sequence[Path]) -> list[Line]:
    """
    Friction coefficients over repeated experiments, Table 1.

    Parameters
    ----------
    bags : sequence of Path
        Recordings of the friction experiment.

    Returns
    -------
    list of Line
        mu_s and mu_v.

    """
    recordings = [read_friction_recording(bag) for bag in tqdm(bags, **_bar('reading'))]
    estimates = [identify_friction(recording) for recording in tqdm(recordings, **_bar('fits'))]
    summary = summarize(estimates)
    lines = []
    for name, paper in TABLE_1.items():
        held, known = count_held(
            [estimate[name] for estimate in estimates],
            [friction_truth(recording.truth, name) for recording in recordings],
        )
        found = summary[name]
        quantity = f'{found.symbol} [{found.unit}]'
        lines.append(Line(quantity=quantity, paper=paper, found=found, held=held, known=known))
    return lines


def table_2(bags: Sequence[Path]) -> list[Line]:
    """
    Stiffness of the tissue over several places, by force level, Table 2.

    Parameters
    ----------
    bags : sequence of Path
        Recordings of the stiffness experiment, one per place.

    Returns
    -------
    list of Line
        Each entry of the matrix at each level, and k_a.

    Raises
    ------
    ReproduceError
        If a recording has other force levels.

    """
    recordings = [read_indentation_recording(bag) for bag in tqdm(bags, **_bar('reading'))]
    estimates = [identify_stiffness(recording) for recording in tqdm(recordings, **_bar('fits'))]
    for estimate in estimates:
        if len(estimate.levels) != len(FORCE_LEVELS):
            raise ReproduceError(
                f'{estimate.name} must have {len(FORCE_LEVELS)} force levels as Table 2, got '
                f'{[round(level.force, 2) for level in estimate.levels]} N'
            )
    summary = summarize_stiffness(estimates)
    lines = []
    for k, force in enumerate(FORCE_LEVELS):
        found = {statistic.name: statistic for statistic in summary.levels[k].statistics}
        for entry, (means, deviations) in TABLE_2.items():
            held, known = count_held(
                [estimate.levels[k][entry] for estimate in estimates],
                [stiffness_truth(recording.truth, entry, force) for recording in recordings],
            )
            lines.append(
                Line(
                    quantity=f'{entry} at {force:g} N [N/m]',
                    paper=(means[k], deviations[k]),
                    found=found[entry],
                    held=held,
                    known=known,
                )
            )
    tissue = summary.tissue_stiffness
    lines.append(
        Line(
            quantity=f'{tissue.symbol} at {force:g} N [{tissue.unit}]',
            # The paper takes k_zz for it, as a contact length of 1 m does.
            paper=(means[-1], deviations[-1]),
            found=tissue,
        )
    )
    return lines


def friction_truth(truth: Mapping[str, Any] | None, name: str) -> float | None:
    """Return a model constant of the recorded plant, None if it is not known."""
    return (truth or {}).get(f'model.{name}')


def stiffness_truth(truth: Mapping[str, Any] | None, entry: str, force: float) -> float | None:
    """Return the stand-in's stiffness at its level nearest to a force, None if it is not known."""
    known = truth or {}
    values = known.get(f'indenter.{indenter_name(entry)}')
    if values is None:
        return None
    levels = np.array(known['indenter.force_levels'])
    return float(values[int(np.abs(levels - force).argmin())])


#: Results of the paper that come from recordings: the experiment, and what is made of its bags.
TABLES: Final[Mapping[str, tuple[str, Callable[[Sequence[Path]], list[Line]]]]] = {
    'table-1': ('friction', table_1),
    'table-2': ('stiffness', table_2),
}


#: What there is to reproduce.
RESULTS: Final = (
    *FIGURES,
    *TABLES,
    *('table-3', 'controllability', 'claims', 'mismatch', 'all'),
)

#: Tables that a result is judged by.
_JUDGED_BY: Final[Mapping[str, tuple[str, ...]]] = {
    **{name: (name,) for name in TABLES},
    'claims': tuple(TABLES),
    'all': tuple(TABLES),
}

#: The unit that each table does not print.
_UNITS: Final[Mapping[str, str]] = {
    'table-1': (
        'The paper prints no unit of mu_v. Here 0.3 is read as N s/mm, 300 N s/m, as on the rig '
        'of the recordings; figures 4 to 8 show it as N s/m as well.'
    ),
    'table-2': (
        'The paper prints no unit of the stiffness. It is kN/m, if the 0.52 kN/m^2 of the text '
        'are k_zz at 1.5 N.'
    ),
}

#: Folder of the whole page if none is given.
_OUTPUT: Final = Path('reproduce_output')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument('what', choices=RESULTS)
    parser.add_argument(
        '-o',
        '--output',
        type=Path,
        metavar='DIR',
        help=f'folder for a page of HTML with its pictures (all: default {_OUTPUT})',
    )
    parser.add_argument(
        '--record',
        type=Path,
        metavar='DIR',
        help='tables and claims: record anew to this folder, or go on there',
    )
    parser.add_argument('--json', action='store_true', help='print JSON instead of a table')


def campaigns(what: str) -> dict[str, Campaign]:
    """Return the experiments behind a result, by name."""
    if what not in _JUDGED_BY:
        raise ReproduceError(f'{what} is computed: there is nothing to --record')
    names = [TABLES[name][0] for name in _JUDGED_BY[what]]
    return {name: Campaign(protocol=PROTOCOLS[name]) for name in names}


@dataclass(frozen=True, kw_only=True)
class Identified:
    """
    A table of the paper, anew from recordings.

    Attributes
    ----------
    name : str
        One of `TABLES`.
    bags : tuple of Path
        Recordings.
    lines : tuple of Line
        What they give.

    """

    name: str
    bags: tuple[Path, ...]
    lines: tuple[Line, ...]

    @cached_property
    def truth(self) -> tuple[int, int]:
        """Intervals that hold their own truth, and truths that are known."""
        return sum(line.held for line in self.lines), sum(line.known for line in self.lines)

    @property
    def is_true(self) -> bool:
        """Whether no fewer intervals hold their truth than chance allows."""
        held, known = self.truth
        return held >= fewest(known)

    @property
    def holds(self) -> bool:
        """Whether the recordings agree with the paper and with their own truth."""
        return self.is_true and all(line.holds for line in self.lines)

    @property
    def words(self) -> str:
        """What their own truths say of the intervals."""
        held, known = self.truth
        return (
            f'95 % intervals of the {len(self.bags)} bags that hold their own truth: {held} of '
            f'{known} (at least {fewest(known)} but for 1 % chance): {_verdict(self.is_true)}'
        )

    def document(self) -> dict[str, Any]:
        """Return it for JSON."""
        held, known = self.truth
        return {
            'unit': 'SI',
            'bags': [str(bag) for bag in self.bags],
            'lines': [_as_json(line) for line in self.lines],
            'truth': {'held': held, 'of': known, 'least': fewest(known), 'holds': self.is_true},
            'holds': self.holds,
        }

    def section(self) -> Section:
        """Return it for the page."""
        return Section(
            title=_title(self.name),
            paragraphs=(
                _UNITS[self.name],
                (
                    'The paper prints mean and STD over repeated experiments. Both are compared '
                    'with the 95 % intervals that the recordings give. The recordings are of a '
                    "simulated rig whose constants are drawn around the paper's: they show that "
                    'the method finds what is there, not that the paper measured well. '
                    f'{self.words}.'
                ),
            ),
            tables=(
                Grid(
                    caption=f'{_title(self.name)} from {len(self.bags)} recordings',
                    heads=_HEADS,
                    rows=tuple(_rows(self.lines)),
                ),
            ),
        )


def identify(name: str, recorded: Mapping[str, Sequence[Path]] | None = None) -> Identified:
    """
    Make a table of the paper anew.

    Parameters
    ----------
    name : str
        One of `TABLES`.
    recorded : Mapping[str, sequence of Path], optional
        Recordings by experiment; the shipped ones if not given.

    Returns
    -------
    Identified
        What they give.

    Raises
    ------
    ReproduceError
        If there are no recordings.

    """
    experiment, result = TABLES[name]
    bags = (recorded or {}).get(experiment) or sorted(
        path for path in SHIPPED_BAGS.glob(f'{experiment}_*') if path.is_dir()
    )
    if not bags:
        raise ReproduceError(
            f'{SHIPPED_BAGS} holds no {experiment}_*; run from a clone, or give --record DIR'
        )
    return Identified(name=name, bags=tuple(bags), lines=tuple(result(bags)))


def statistics(tables: Mapping[str, Identified], source: str) -> claims.Tables:
    """
    Return identified tables as claims are judged by them: mu_v in N s/mm, stiffness in kN/m.

    Parameters
    ----------
    tables : Mapping[str, Identified]
        All of `TABLES`.
    source : str
        Where they come from.

    Returns
    -------
    claims.Tables
        Means and STD.

    """

    def found(table_name: str, name: str, scale: float) -> list[tuple[float, float]]:
        return [
            (scale * one.mean, nan if one.deviation is None else scale * one.deviation)
            for one in (line.found for line in tables[table_name].lines)
            if one.name == name
        ]

    means_and_deviations = {
        entry: list(zip(*found('table-2', entry, 1e-3), strict=True)) for entry in TABLE_2
    }
    return claims.Tables(
        source=source,
        friction={
            'mu_s': found('table-1', 'coulomb_friction', 1.0)[0],
            'mu_v': found('table-1', 'viscous_friction', 1e-3)[0],
        },
        stiffness={entry: (each[0], each[1]) for entry, each in means_and_deviations.items()},
        repeats=min(len(one.bags) for one in tables.values()),
    )


def table_3() -> Section:
    """
    Return the constants of the needle, Table 3, beside those of a round wire.

    Returns
    -------
    Section
        For the page.

    """
    p, diameter = NeedleParameters(), 1.27e-3
    rows = (
        ('l [m]', p.length, None),
        ('rho [kg/m^3]', p.density, None),
        ('E [Pa]', p.youngs_modulus, None),
        ('A [m^2]', p.area, pi / 4.0 * diameter**2),
        ('I_y [m^4]', p.area_moment, pi / 64.0 * diameter**4),
        ('I_x [m^4] in the paper, [kg m^2] here', p.rotary_inertia, pi / 32.0 * diameter**4),
    )
    return Section(
        title=_title('table-3'),
        paragraphs=(
            (
                'A and I_y are those of a round needle of 1.27 mm. I_x is not its polar moment of '
                'area; the equations need a mass moment of inertia and get the same number in '
                'kg m^2, which only the rotation depends on. g (9.89 m/s^2 in the paper) is in no '
                'equation: the plane of motion is level.'
            ),
        ),
        tables=(
            Grid(
                caption='Constants of the needle',
                heads=('constant', 'value', 'round wire of 1.27 mm', 'ratio'),
                rows=tuple(
                    (name, f'{value:.5g}')
                    + (('', '') if round_ is None else (f'{round_:.4g}', f'{value / round_:.4g}'))
                    for name, value, round_ in rows
                ),
            ),
        ),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """
    One result, for the page, for the terminal and for machines.

    Attributes
    ----------
    section : Section
        What the page says.
    text : str
        What the terminal says.
    verdicts : tuple of (str, str, str)
        Where, what, and the verdict on it.
    document : Mapping[str, object]
        For JSON.
    holds : bool
        False if a table does not come out as the paper has it.

    """

    section: Section
    text: str
    verdicts: tuple[tuple[str, str, str], ...] = ()
    document: Mapping[str, Any] = field(default_factory=dict)
    holds: bool = True


_VERDICTS = ('where', 'what', 'verdict')


def _of_table(found: Identified) -> Result:
    return Result(
        section=found.section(),
        text=f'{as_table(found.lines)}\n\n{found.words}',
        verdicts=((_title(found.name), 'means and STD are those printed', _verdict(found.holds)),),
        document=found.document(),
        holds=found.holds,
    )


def _of_claims(judged: list[claims.Claim]) -> Result:
    section = claims.section(judged)
    rows = [(one.section, one.claim, one.words) for one in judged]
    return Result(
        section=section,
        text=f'{section.paragraphs[0]}\n\n{table(rows, _VERDICTS)}',
        verdicts=tuple((one.section, one.claim, one.verdict) for one in judged),
        document={'claims': [asdict(one) for one in judged]},
    )


def _of_section(section: Section, **more: object) -> Result:
    grids = (f'{one.caption}\n\n{table(one.rows, one.heads)}' for one in section.tables)
    captions = (one.caption for one in section.pictures)
    return Result(
        section=section,
        text='\n\n'.join((*section.paragraphs, *grids, *captions)),
        document={
            'title': section.title,
            'paragraphs': section.paragraphs,
            'tables': [asdict(one) for one in section.tables],
            'captions': [one.caption for one in section.pictures],
            **more,
        },
    )


def _figure(name: str) -> Result:
    found = FIGURES[name]()
    return _of_section(
        Section(
            title=_title(name),
            paragraphs=(),
            tables=(found.table(),),
            pictures=(found.picture,),
        ),
        runs=[{'run': case, **asdict(one)} for case, one in found.outcomes.items()],
    )


@cache
def _study() -> mismatch.Mismatch:
    with tqdm(total=2002, unit=' insertions', **_bar('mismatch')) as bar:
        return mismatch.study(progress=bar.update)


def _judge(tables: Mapping[str, Identified], *, shipped: bool) -> Result:
    source = 'the shipped recordings' if shipped else 'the recordings'
    study = _study()
    with tqdm(unit=' claims', **_bar('claims')) as bar:
        return _of_claims(claims.claims(statistics(tables, source), study, bar.update))


def results(what: str, recorded: Mapping[str, Sequence[Path]] | None = None) -> dict[str, Result]:
    """
    Make a result of the paper anew, or all of them.

    Parameters
    ----------
    what : str
        One of `RESULTS`.
    recorded : Mapping[str, sequence of Path], optional
        Recordings by experiment; the shipped ones if not given.

    Returns
    -------
    dict[str, Result]
        By name, in the order of the page.

    """
    tables = {name: identify(name, recorded) for name in _JUDGED_BY.get(what, ())}
    jobs: dict[str, Callable[[], Result]] = {
        'claims': lambda: _judge(tables, shipped=recorded is None),
        **{name: lambda name=name: _of_table(tables[name]) for name in TABLES},  # type: ignore[misc]
        'table-3': lambda: _of_section(table_3()),
        **{name: lambda name=name: _figure(name) for name in FIGURES},  # type: ignore[misc]
        'figures': lambda: _of_section(figures.section()),
        'controllability': lambda: _of_section(analyze.section()),
        'mismatch': lambda: _of_section(mismatch.section(_study())),
    }
    chosen = [name for name in jobs if name not in FIGURES] if what == 'all' else [what]
    found = {}
    for name in tqdm(chosen, **_bar('results')):
        found[name] = jobs[name]()
    return found


def run(options: argparse.Namespace) -> int:
    """
    Print a result, and write its page.

    Parameters
    ----------
    options : Namespace
        As declared by `add_arguments`.

    Returns
    -------
    int
        0, or 1 if a table does not come out as the paper has it. A claim that does not hold is a
        finding, not a failure.

    """
    recorded = None
    if options.record is not None:
        wanted = campaigns(options.what)
        # Needs ROS; the shipped recordings are read without it.
        from needle_insertion.experiment.record import record

        recorded = {name: record(one, options.record) for name, one in wanted.items()}
    folder = options.output or (_OUTPUT if options.what == 'all' else None)
    if folder is not None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ParameterError(f'{folder} cannot be written: {error.strerror}') from error
    found = results(options.what, recorded)
    passed = all(one.holds for one in found.values())
    if options.json:
        document: dict[str, Any] = {'result': options.what}
        if options.what == 'all':
            document['results'] = {name: one.document for name, one in found.items()}
            document['holds'] = passed
        else:
            document |= found[options.what].document
        # What is not finite, as of a single recording, is null.
        finite = json.loads(json.dumps(document), parse_constant=lambda _name: None)
        sys.stdout.write(f'{json.dumps(finite, indent=2)}\n')
    elif options.what == 'all':
        verdicts = [row for one in found.values() for row in one.verdicts]
        sys.stdout.write(f'{table(verdicts, _VERDICTS)}\n')
    else:
        sys.stdout.write(f'{found[options.what].text}\n')
    if folder is not None:
        page = folder / 'reproduce.html'
        write_document(page, _PAGE, _INTRODUCTION, _blocks(found))
        if not options.json:
            sys.stdout.write(f'\nwrote {page}\n')
    return 0 if passed else 1


_PAGE = 'The paper, reproduced'
_INTRODUCTION = (
    'A. Boroomand, M. Tavakoli, R. Sloboda, N. Usmani, Dynamical modeling and controllability '
    'analysis of a flexible needle in soft tissue (2014): its figures, tables and claims, '
    'computed anew.'
)


def _blocks(found: Mapping[str, Result]) -> list[str | Picture]:
    """Return the page: what came out in short, then each result."""
    cards = []
    if 'claims' in found:
        said = [verdict for _where, _what, verdict in found['claims'].verdicts]
        cards.append(
            (
                'Claims of the paper',
                f'{said.count(claims.HOLDS)} of {len(said)} hold',
                (
                    f'{said.count(claims.ONLY_IF)} more under a condition, '
                    f'{said.count(claims.FAILS)} do not'
                ),
            )
        )
    cards += [
        (
            _title(name),
            _verdict(found[name].holds),
            (
                f'{len(found[name].document["lines"])} quantities, means and STD, from '
                f'{len(found[name].document["bags"])} recordings'
            ),
        )
        for name in TABLES
        if name in found
    ]
    blocks: list[str | Picture] = [headline(cards)] if cards else []
    for result in found.values():
        section = result.section
        blocks += [heading(section.title), *map(paragraph, section.paragraphs)]
        blocks += [
            *section.pictures,
            *(grid(one.rows, one.heads, one.caption) for one in section.tables),
        ]
    return blocks


def _title(name: str) -> str:
    return name.replace('-', ' ').capitalize()


_HEADS = (
    *('quantity', 'paper: mean ± STD', 'found: mean ± STD', '95 % of the mean'),
    *('95 % of the STD', 'truth held', 'verdict'),
)


def as_table(lines: Sequence[Line]) -> str:
    """Return lines as aligned text."""
    return table(_rows(lines), _HEADS)


def _rows(lines: Sequence[Line]) -> list[tuple[str, ...]]:
    return [
        (
            line.quantity,
            _plus_minus(*line.paper),
            _plus_minus(line.found.mean, line.found.deviation),
            _interval(line.found.interval),
            _interval(line.deviation_interval),
            f'{line.held}/{line.known}' if line.known else '',
            _verdict(line.holds),
        )
        for line in lines
    ]


def _as_json(line: Line) -> dict[str, Any]:
    mean, deviation = line.paper
    return {
        'quantity': line.quantity,
        'paper': {'mean': mean, 'deviation': deviation},
        'found': asdict(line.found),
        'deviation_interval': line.deviation_interval,
        'truth': {'held': line.held, 'of': line.known},
        'holds': line.holds,
    }


def _plus_minus(mean: float, deviation: float | None) -> str:
    return f'{mean:.4g} ± {deviation:.3g}' if deviation is not None else f'{mean:.4g}'


def _interval(interval: tuple[float, float]) -> str:
    return f'{interval[0]:.4g} to {interval[1]:.4g}'


def _verdict(holds: bool) -> str:
    return 'holds' if holds else 'DOES NOT HOLD'


def _bar(what: str) -> dict[str, Any]:
    return {'desc': what, 'disable': None, 'leave': False}
