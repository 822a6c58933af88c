"""`needle reproduce`: the paper's results anew, each beside what the paper prints."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
import json
from math import sqrt
from pathlib import Path
import sys
from typing import Any, Final

from needle_dynamics import NeedleError
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
from needle_insertion.draw import FORCE_LEVELS, TABLE_1, TABLE_2
from needle_insertion.protocol import Campaign, node_name, PROTOCOLS, SHIPPED_BAGS
from needle_insertion.report import table
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
    values = known.get(f'indenter.{node_name(entry)}')
    if values is None:
        return None
    levels = np.array(known['indenter.force_levels'])
    return float(values[int(np.abs(levels - force).argmin())])


#: Results of the paper that come from recordings: the experiment, and what is made of its bags.
TABLES: Final[Mapping[str, tuple[str, Callable[[Sequence[Path]], list[Line]]]]] = {
    'table-1': ('friction', table_1),
    'table-2': ('stiffness', table_2),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument('what', choices=tuple(TABLES))
    parser.add_argument(
        '--record', type=Path, metavar='DIR', help='record anew to this folder, or go on there'
    )
    parser.add_argument('--json', action='store_true', help='print JSON instead of a table')


def campaign(what: str) -> Campaign:
    """Return the experiment behind a result."""
    return Campaign(protocol=PROTOCOLS[TABLES[what][0]])


def run(options: argparse.Namespace, bags: Sequence[Path] | None = None) -> int:
    """Identify from the recordings, the shipped ones if none are given; return the exit status."""
    experiment, result = TABLES[options.what]
    bags = bags or sorted(path for path in SHIPPED_BAGS.glob(f'{experiment}_*') if path.is_dir())
    if not bags:
        raise ReproduceError(
            f'{SHIPPED_BAGS} holds no {experiment}_*; run from a clone, or give --record DIR'
        )
    lines = result(bags)
    held, known = sum(line.held for line in lines), sum(line.known for line in lines)
    true = held >= fewest(known)
    passed = true and all(line.holds for line in lines)
    if options.json:
        document = {
            'result': options.what,
            'unit': 'SI',
            'bags': [str(bag) for bag in bags],
            'lines': [_as_json(line) for line in lines],
            'truth': {'held': held, 'of': known, 'least': fewest(known), 'holds': true},
            'holds': passed,
        }
        # What is not finite, as of a single recording, is null.
        finite = json.loads(json.dumps(document), parse_constant=lambda _name: None)
        sys.stdout.write(f'{json.dumps(finite, indent=2)}\n')
    else:
        sys.stdout.write(
            f'{as_table(lines)}\n\n'
            f'95 % intervals of the {len(bags)} bags that hold their own truth: {held} of {known} '
            f'(at least {fewest(known)} but for 1 % chance): {_verdict(true)}\n'
        )
    return 0 if passed else 1


def as_table(lines: Sequence[Line]) -> str:
    """Return lines as aligned text."""
    rows = [
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
    heads = (
        *('quantity', 'paper: mean ± STD', 'found: mean ± STD', '95 % of the mean'),
        *('95 % of the STD', 'truth held', 'verdict'),
    )
    return table(rows, heads)


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
