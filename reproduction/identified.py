# SPDX-License-Identifier: Apache-2.0
"""Tables 1 and 2 of the paper, identified from recordings of a simulated robot."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from math import inf, sqrt
from pathlib import Path
from typing import Any, Final

from needle_identification import (
    identify_friction,
    identify_stiffness,
    read_friction_recording,
    read_indentation_recording,
    Statistic,
    summarize,
    summarize_stiffness,
)
from needle_insertion.report.paper_tables import FORCE_LEVELS, TABLE_1, TABLE_2
from needle_ros.errors import NeedleError
from reproduction.content import Grid, ReportSection
from reproduction.protocol import SHIPPED_BAGS
from reproduction.truth import compare_friction, compare_stiffness, Coverage, LEVEL
from scipy.special import chdtri
from tqdm import tqdm

_HEADS: Final = (
    *('quantity', 'paper: mean ± STD', 'found: mean ± STD', '95 % of the mean'),
    *('95 % of the STD', 'true value inside', 'verdict'),
)

#: Unit of each table, which the paper does not print.
_UNITS: Final[Mapping[str, str]] = {
    'table-1': (
        'The paper prints no unit of mu_v. Here 0.3 is read as N s/mm, 300 N s/m, as on the rig '
        'of the recordings. Figures 4 to 8 show it as N s/m as well.'
    ),
    'table-2': (
        'The paper prints no unit of the stiffness. It is kN/m, if the 0.52 kN/m^2 of the text '
        'are k_zz at 1.5 N.'
    ),
}


#: Verdict on a table by agreement with the paper.
VERDICTS: Final = {True: 'holds', False: 'DOES NOT HOLD'}


class ReproduceError(NeedleError):
    """No recordings to reproduce a result from."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishedValue:
    """Published quantity and its statistics over the recordings."""

    quantity: str  #: With its unit and condition.
    #: Published mean and standard deviation, SI.
    paper: tuple[float, float]
    found: Statistic
    #: Number of recordings whose 95 % interval contains the ground truth.
    truth: Coverage = field(default_factory=Coverage)

    @property
    def deviation_interval(self) -> tuple[float, float]:
        """95 % interval of the standard deviation of a normal population (chi-squared)."""
        deviation, freedom = self.found.deviation, self.found.count - 1
        if deviation is None:
            return 0.0, inf
        low, high = (
            deviation * sqrt(freedom / chdtri(freedom, tail))
            for tail in ((1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0)
        )
        return float(low), float(high)

    @property
    def holds(self) -> bool:
        """Whether both intervals contain the published values."""
        return all(
            low <= value <= high
            for value, (low, high) in zip(
                self.paper, (self.found.interval, self.deviation_interval), strict=True
            )
        )

    @property
    def row(self) -> tuple[str, ...]:
        return (
            self.quantity,
            _plus_minus(*self.paper),
            _plus_minus(self.found.mean, self.found.deviation),
            _interval(self.found.interval),
            _interval(self.deviation_interval),
            f'{self.truth.held}/{self.truth.known}' if self.truth.known else '',
            VERDICTS[self.holds],
        )

    @property
    def document(self) -> dict[str, Any]:
        mean, deviation = self.paper
        return {
            'quantity': self.quantity,
            'paper': {'mean': mean, 'deviation': deviation},
            'found': asdict(self.found),
            'deviation_interval': self.deviation_interval,
            'truth': {'held': self.truth.held, 'of': self.truth.known},
            'holds': self.holds,
        }


def _plus_minus(mean: float, deviation: float | None) -> str:
    return f'{mean:.4g}' if deviation is None else f'{mean:.4g} ± {deviation:.3g}'


def _interval(interval: tuple[float, float]) -> str:
    return '{:.4g} to {:.4g}'.format(*interval)


@dataclass(frozen=True, slots=True, kw_only=True)
class IdentifiedTable:
    """Table ``name``, of `TABLES`, of the paper, identified from recordings."""

    name: str
    bags: tuple[Path, ...]
    lines: tuple[PublishedValue, ...]

    @property
    def title(self) -> str:
        """Title such as ``Table 1``."""
        return self.name.replace('-', ' ').capitalize()

    @property
    def truth(self) -> Coverage:
        """Coverage of the ground truth over all lines."""
        found = [line.truth for line in self.lines]
        return Coverage(sum(one.held for one in found), sum(one.known for one in found))

    @property
    def holds(self) -> bool:
        """Whether the recordings agree with the paper and with their ground truth."""
        return self.truth.is_enough and all(line.holds for line in self.lines)

    @property
    def words(self) -> str:
        """Number of intervals that contain their ground truth, as a sentence."""
        truth = self.truth
        return (
            f'{truth.held} of {truth.known} intervals (95 %) contain the true value of their bag; '
            f'at least {truth.least} are expected with 99 % probability: '
            f'{VERDICTS[truth.is_enough]}'
        )

    @property
    def document(self) -> dict[str, Any]:
        truth = self.truth
        return {
            'unit': 'SI',
            'bags': [str(bag) for bag in self.bags],
            'lines': [line.document for line in self.lines],
            'truth': {
                'held': truth.held,
                'of': truth.known,
                'least': truth.least,
                'holds': truth.is_enough,
            },
            'holds': self.holds,
        }

    @property
    def section(self) -> ReportSection:
        return ReportSection(
            title=self.title,
            paragraphs=(
                _UNITS[self.name],
                (
                    'The paper prints mean and STD over repeated experiments. Both are compared '
                    'with the 95 % intervals from the recordings. The recordings are of a '
                    "simulated rig whose constants are sampled around the paper's: they validate "
                    'the method, not the measurements of the paper. '
                    f'{self.words}.'
                ),
            ),
            tables=(
                Grid(
                    caption=f'{self.title} from {len(self.bags)} simulated recordings',
                    heads=_HEADS,
                    rows=tuple(line.row for line in self.lines),
                ),
            ),
        )


def _table_1(bags: Sequence[Path]) -> list[PublishedValue]:
    recordings = [read_friction_recording(bag) for bag in _shown(bags, 'reading')]
    estimates = [identify_friction(recording) for recording in _shown(recordings, 'fits')]
    compared = list(map(compare_friction, recordings, estimates))
    summary = summarize(estimates)
    lines = []
    for k, (name, paper) in enumerate(TABLE_1.items()):
        truth, found = Coverage.of(one[k] for one in compared), summary[name]
        quantity = f'{found.symbol} [{found.unit}]'
        lines.append(PublishedValue(quantity=quantity, paper=paper, found=found, truth=truth))
    return lines


def _table_2(bags: Sequence[Path]) -> list[PublishedValue]:
    """Return the entries of the stiffness matrix by level over several places, and k_a."""
    recordings = [read_indentation_recording(bag) for bag in _shown(bags, 'reading')]
    estimates = [identify_stiffness(recording) for recording in _shown(recordings, 'fits')]
    for estimate in estimates:
        if len(estimate.levels) != len(FORCE_LEVELS):
            raise ReproduceError(
                f'{estimate.name} must have {len(FORCE_LEVELS)} force levels as Table 2, got '
                f'{[round(level.force, 2) for level in estimate.levels]} N'
            )
    compared = list(map(compare_stiffness, recordings, estimates))
    summary = summarize_stiffness(estimates)
    lines = []
    for k, force in enumerate(FORCE_LEVELS):
        for i, (entry, (means, deviations)) in enumerate(TABLE_2.items()):
            lines.append(
                PublishedValue(
                    quantity=f'{entry} at {force:g} N [N/m]',
                    paper=(means[k], deviations[k]),
                    found=summary.levels[k][entry],
                    truth=Coverage.of(one[i * len(FORCE_LEVELS) + k] for one in compared),
                )
            )
    tissue, (means, deviations) = summary.tissue_stiffness, TABLE_2['k_zz']
    quantity = f'{tissue.symbol} at {FORCE_LEVELS[-1]:g} N [{tissue.unit}]'
    # The paper equates k_a and k_zz, which implies a contact length of 1 m.
    lines.append(
        PublishedValue(quantity=quantity, paper=(means[-1], deviations[-1]), found=tissue)
    )
    return lines


#: Tables by name: experiment, and function that identifies the table from bags.
TABLES: Final[Mapping[str, tuple[str, Callable[[Sequence[Path]], list[PublishedValue]]]]] = {
    'table-1': ('friction', _table_1),
    'table-2': ('stiffness', _table_2),
}


def identify_table(
    name: str, recorded: Mapping[str, Sequence[Path]] | None = None
) -> IdentifiedTable:
    """Identify a table, of `TABLES`, from recordings by experiment; default: shipped bags."""
    experiment, result = TABLES[name]
    bags = (recorded or {}).get(experiment) or sorted(
        path for path in SHIPPED_BAGS.glob(f'{experiment}_*') if path.is_dir()
    )
    if not bags:
        raise ReproduceError(
            f'{SHIPPED_BAGS} holds no {experiment}_*; run from a clone, or use --record DIR'
        )
    return IdentifiedTable(name=name, bags=tuple(bags), lines=tuple(result(bags)))


def _shown(items: Sequence[Any], what: str) -> Any:
    return tqdm(items, desc=what, disable=None, leave=False)
