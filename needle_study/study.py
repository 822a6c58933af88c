# SPDX-License-Identifier: Apache-2.0
"""Define a study: a population, a scenario, and the columns of each sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any, Final, TYPE_CHECKING

from needle_dynamics import FloatArray
from needle_dynamics.display import Displayed, new_figure, Progress, progress_of, shown
from needle_ros.errors import ParameterError
from needle_ros.files import read_yaml
from needle_ros.settings import check_choice, check_whole, find_class, is_number, LARGEST_SEED
from needle_study.designs import BELOW, DESIGNS, INSIDE, RandomDesign, SobolDesign
from needle_study.distribution import Distribution, distribution, from_table
from needle_study.scenario import check_names, class_files, mapping, Scenario, SCENARIOS
import numpy as np

if TYPE_CHECKING:
    # Take half a second to import.
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Keys of a study file.
_KEYS: Final = ('scenario', 'samples', 'seed', 'design', 'settings', 'population', 'correlations')
_FILES: Final = 'files'  #: key of the checksums of the files that the scenario reads

#: Metrics of samples that may have no other metric.
FAILURES: Final = ('refused', 'stopped')

_PARTS: Final = 50  #: largest number of parts of a study that shows its progress
_MOST: Final = 2**30  #: largest number of samples, as limited by the Sobol sequence


@dataclass(frozen=True, eq=False)
class Study:
    """A study, as read from a file."""

    scenario: Scenario
    design: RandomDesign  #: samples, with their seed
    population: Mapping[str, Distribution]  #: by variable; the others have their defaults
    document: Mapping[str, Any]  #: content of the study file

    def draw(self, first: int, count: int) -> dict[str, FloatArray]:
        """Return the values of samples from a number on, by variable, shape (count,) each."""
        parts = self.design.parts(first, count)
        of = dict(zip(dimensions(self.population), parts.T, strict=True))
        return {name: one.quantiles(of[one.rows or name]) for name, one in self.population.items()}

    @property
    def samples(self) -> int:
        return self.design.samples

    @property
    def units(self) -> dict[str, str]:
        """SI unit of each column, '1' for numbers and for yes or no."""
        parts = self.scenario.variables, self.scenario.metrics
        known = {name: one.unit or '1' for part in parts for name, one in part.items()}
        return {'sample': '1', **known}

    def simulate(self, progress: Progress | None = None) -> StudyTable:
        """Simulate all samples in this process; `needle study` uses all cores, and files."""
        parts, count = [], min(self.samples, _PARTS) if progress else 1
        with progress_of(progress, count, 'parts') as advance:
            for share in np.array_split(np.arange(self.samples), count):
                parts.append(self.rows(int(share[0]), len(share)))
                advance()
        values = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        return StudyTable(self, values)

    def rows(self, first: int, count: int) -> dict[str, FloatArray]:
        """Compute samples from a number on: number, sampled values and metrics."""
        numbers = range(first, first + count)
        drawn = self.draw(first, count)
        streams = [self.design.noise(number) for number in numbers]
        return {
            'sample': np.arange(first, first + count, dtype=np.float64),
            **drawn,
            **self.scenario.run(drawn, streams),
        }


@dataclass(frozen=True, eq=False, repr=False)
class StudyTable(Displayed):
    """Samples of a study: number, variables of the population and metrics."""

    study: Study
    values: Mapping[str, FloatArray]  #: by name, each of shape (n,); 1 for yes, NaN if missing

    def __repr__(self) -> str:
        samples = len(self.values['sample'])
        parts = [f'{samples} samples']
        for name, one in list(self.study.scenario.metrics.items())[:2]:
            known = self.values[name][np.isfinite(self.values[name])]
            if not len(known):
                parts.append(f'no value of {name}')
                continue
            median = f'median {name} {np.median(known):.4g} {one.unit}'.removesuffix(' 1')
            of = f' of {len(known)} samples' * (len(known) < samples)
            parts.append(f'{median}{of}' if one.unit else f'{name} {known.mean():.1%}')
        parts += [
            f'{count} {name}'
            for name in FAILURES
            if (count := int(np.nansum(self.values.get(name, np.zeros(1)))))
        ]
        return f'<StudyTable: {", ".join(parts)}>'

    def columns(self) -> dict[str, FloatArray]:
        units = self.study.units
        return {f'{name} [{units[name]}]': one for name, one in self.values.items()}

    def plot(self, figure: Figure | None = None) -> list[Axes]:
        """Draw the distribution of the primary metric, and the metric over each variable."""
        scenario, (name, *_) = self.study.scenario, self.study.scenario.metrics
        label, factor = shown(f'{name} [{scenario.metrics[name].unit}]')
        values = factor * self.values[name]
        figure = figure or new_figure(3.0)
        found = list(figure.subplots(1, 1 + len(self.study.population), squeeze=False).flat)
        found[0].hist(values[np.isfinite(values)], bins='auto')
        found[0].set(xlabel=label, ylabel='samples')
        for axes, variable in zip(found[1:], self.study.population, strict=True):
            text, scale = shown(f'{variable} [{scenario.variables[variable].unit}]')
            axes.plot(scale * self.values[variable], values, '.')
            axes.set(xlabel=text, ylabel=label)
        return found


def dimensions(population: Mapping[str, Distribution]) -> list[str]:
    """Return the independent dimensions of a population: variables, and tables of variables."""
    return list(dict.fromkeys(one.rows or name for name, one in population.items()))


def read_study(path: Path | str) -> Study:
    """
    Read a study file.

    Parameters
    ----------
    path : Path or str
        File in YAML; its tables are relative to its folder.

    Raises
    ------
    ParameterError
        If it is not readable or invalid, with its name.
    """
    path = Path(path)
    document = read_yaml(path)
    try:
        study = build_study(document, path.parent)
        study.scenario.check()
        return study
    except ParameterError as error:
        raise ParameterError(f'{path}: {error}') from error


def build_study(document: Any, folder: Path | str = '') -> Study:
    """
    Build a study from the content of a study file.

    Parameters
    ----------
    document : mapping
        Keys and values of the file, in SI units or as text with a unit.
    folder : Path or str
        Folder of its tables, by default the current folder.

    Raises
    ------
    ParameterError
        If a key or a value is invalid, with the valid ones.
    """
    if not isinstance(document, Mapping):
        raise ParameterError(f'a study has {", ".join(_KEYS)}, got {document!r}')
    check_names('', (key for key in document if key != _FILES), _KEYS)
    of_class = find_class('scenario', document.get('scenario'), SCENARIOS)
    if not (isinstance(of_class, type) and Scenario in of_class.__mro__):
        raise ParameterError(f'scenario {document["scenario"]!r} is not a subclass of Scenario')
    samples, seed = (
        _whole(document, *limits) for limits in (('samples', 1, _MOST), ('seed', 0, LARGEST_SEED))
    )
    design = document.get('design', SobolDesign.name)
    check_choice('design', design, DESIGNS)
    settings, given = (mapping(key, document.get(key)) for key in ('settings', 'population'))
    scenario: Scenario = of_class(settings)
    known = scenario.variables
    for name in given:
        if name in scenario.absent:
            raise ParameterError(f'population: {name} {scenario.absent[name]}')
    check_names('population: ', given, known)
    given = {
        name: from_table(f'population: {name}', one, Path(folder), known[name].unit)
        for name, one in given.items()
    }
    # The dimension of a variable must not depend on its order in the file: workers sort it.
    population = {
        name: distribution(f'population: {name}', given[name], known[name].unit)
        for name in sorted(given)
    }
    _check_tables(population)
    for name, one in population.items():
        least, most = one.ends(INSIDE, BELOW)
        low, high, unit = known[name].low, known[name].high, known[name].unit
        if not low <= least <= most <= high or not isfinite(least) or not isfinite(most):
            raise ParameterError(
                f'population: {name} must be finite and in [{low:g}, {high:g}] {unit}, and would '
                f'be from {least:g} to {most:g}; truncate it with within: [low, high]'
            )
    of_own = class_files(document['scenario'], of_class)
    for one in population.values():
        if ':' in one.kind:
            of_own |= class_files(one.kind, find_class('a distribution', one.kind, {}))
    factor = _factor(document.get('correlations', []), dimensions(population))
    begun, files = mapping(_FILES, document.get(_FILES)), {**of_own, **scenario.files}
    if changed := [name for name, checksum in begun.items() if files.get(name) != checksum]:
        raise ParameterError(f'{changed[0]} is not the file with which the study was begun')
    # The workers have no tables.
    content = {**document, 'population': given} if given else dict(document)
    content |= {_FILES: files} if files else {}
    return Study(scenario, DESIGNS[design](samples, seed, factor), population, content)


def _check_tables(population: Mapping[str, Distribution]) -> None:
    lengths = {(one.rows, len(one.numbers)) for one in population.values() if one.rows}
    if len({rows for rows, _ in lengths}) < len(lengths):
        raise ParameterError('population: variables of the same table must have as many rows')
    alone = [name for name, one in population.items() if not one.rows]
    for name, one in population.items():
        # Correlations and indices have one name for each independent dimension.
        if one.rows in alone:
            raise ParameterError(
                f'population: the table of {name} must not have the name of a variable without '
                f'a table ({", ".join(alone)}), got {one.rows!r}'
            )


def _whole(document: Mapping[str, Any], key: str, low: int, high: int) -> int:
    value = document.get(key, 1)
    check_whole(key, value, low, high)
    return int(value)


def _factor(given: Any, names: Sequence[str]) -> FloatArray:
    """Return the Cholesky factor of correlations given as ``[[name, name, value], ...]``."""
    matrix = np.eye(len(names))
    form = 'correlations takes [[name, name, value between -1 and 1], ...] of the population'
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise ParameterError(f'{form}, got {given!r}')
    for one in given:
        valid = isinstance(one, Sequence) and not isinstance(one, str) and len(one) == 3
        valid = valid and one[0] in names and one[1] in names and one[0] != one[1]
        if not (valid and is_number(one[2]) and abs(one[2]) < 1.0):
            raise ParameterError(f'{form}, got {one!r}')
        i, k = names.index(one[0]), names.index(one[1])
        if matrix[i, k] != 0.0:
            raise ParameterError(f'correlations has {one[0]} with {one[1]} twice')
        matrix[i, k] = matrix[k, i] = one[2]
    try:
        return np.asarray(np.linalg.cholesky(matrix))
    except np.linalg.LinAlgError as error:
        raise ParameterError(
            'correlations are inconsistent: the matrix is not positive definite'
        ) from error
