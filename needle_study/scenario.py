# SPDX-License-Identifier: Apache-2.0
"""Interface of a scenario, and checks of the content of a study file."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import inf, nan
from numbers import Real
from pathlib import Path
import sys
from typing import Any, Final, NamedTuple, TypeAlias
from zlib import crc32

from needle_dynamics import FloatArray
from needle_dynamics.needles import FILES, NEEDLES
from needle_ros.contract import Topic
from needle_ros.errors import ParameterError
from needle_ros.settings import unknown_name
import numpy as np

#: Modules whose versions are in the identity of a study.
_VERSIONED: Final = {
    'needle_controller', 'needle_dynamics', 'needle_planning', 'needle_ros', 'needle_study',
    'numpy', 'scipy', *sys.stdlib_module_names,
}  # fmt: skip

Row: TypeAlias = Mapping[str, float]  #: value of each variable of a sample
Streams: TypeAlias = Sequence[np.random.Generator]  #: random numbers of each sample


class Variable(NamedTuple):
    """A variable that may differ from sample to sample."""

    default: float  #: value if it is not in the population
    unit: str  #: SI unit
    meaning: str
    low: float = -inf  #: valid range
    high: float = inf


class Metric(NamedTuple):
    """A metric of a sample."""

    unit: str  #: SI unit; '' for yes or no
    meaning: str


class MeasuredRun(NamedTuple):
    """A message of a robot or a sensor in a replayed sample."""

    topic: Topic
    stamp: int  #: [ns]
    values: Sequence[float]  #: numbers of `Topic.quantities`


class Scenario(ABC):
    """Base of scenarios, which are simulated with each sample."""

    variables: Mapping[str, Variable]  #: variables of a sample
    metrics: Mapping[str, Metric]  #: metrics, the primary metric first
    at_once: int  #: samples that are simulated together
    #: Checksum of each file that it reads: with another content, the study is another one.
    files: Mapping[str, str] = {}
    absent: Mapping[str, str] = {}  #: Reason why a variable is not in this study, by its name.

    def check(self) -> None:  # noqa: B027
        """Raise `ParameterError` for invalid content of files, before a folder is made."""

    def run(self, samples: Mapping[str, FloatArray], streams: Streams) -> dict[str, FloatArray]:
        """Simulate samples; return each metric, shape (n,): 1 for yes, NaN for a missing value."""
        rows = [
            self.row({name: float(values[k]) for name, values in samples.items()})
            for k in range(len(streams))
        ]
        found = list[dict[str, float]]()
        for k in range(0, len(rows), self.at_once):
            part = slice(k, k + self.at_once)
            # A function without yield returns None.
            some = [*map(self._checked, self.insert(rows[part], streams[part]) or ())]
            if len(some) != len(rows[part]):
                raise ParameterError(
                    f'{type(self).__name__}.insert must yield the metrics of each of '
                    f'{len(rows[part])} samples by name, got {len(some)}'
                )
            found += some
        return {name: np.array([one.get(name, nan) for one in found]) for name in self.metrics}

    def _checked(self, found: object) -> dict[str, float]:
        """Return the metrics of a sample as numbers, as soon as it is simulated."""
        where = f'{type(self).__name__}.insert'
        if not isinstance(found, Mapping):
            raise ParameterError(
                f'{where} must yield the metrics of a sample by name, got {found!r}'
            )
        where = f'{where}: the metric'
        for name, value in found.items():
            if name not in self.metrics:
                raise ParameterError(
                    f'{where} {name!r} is not one of metrics: {", ".join(self.metrics)}'
                )
            if not isinstance(value, (Real, np.bool_)) or abs(value) == inf:
                raise ParameterError(
                    f'{where} {name} must be a finite number, or NaN, got {value!r}'
                )
            if not self.metrics[name].unit and value not in (0, 1) and value == value:
                raise ParameterError(f'{where} {name} is yes or no: 1, 0 or NaN, got {value!r}')
        return {name: float(value) for name, value in found.items()}

    def row(self, sample: Row) -> dict[str, float]:
        """Return the value of each variable, by default its default."""
        return {name: sample.get(name, one.default) for name, one in self.variables.items()}

    @abstractmethod
    def insert(self, rows: Sequence[Row], streams: Streams) -> Iterable[Mapping[str, float]]:
        """Simulate samples with a value of each variable; return the known metrics of each."""

    @abstractmethod
    def replay(self, sample: Row, rng: np.random.Generator) -> Iterator[MeasuredRun]:
        """Simulate one sample again; yield measurements and commands in time order per topic."""


#: Class of each scenario, imported on demand; it is made from the settings of a study.
SCENARIOS: Final[Mapping[str, str]] = {
    'steering': 'needle_study.steering:SteeringScenario',
    'insertion': 'needle_study.insertion:InsertionScenario',
    'plan': 'needle_planning.plan_scenario:PlanScenario',
}


def check_names(where: str, given: Iterable[Any], valid: Iterable[str]) -> None:
    """Raise `ParameterError`, with the prefix `where`, if a name is not valid."""
    known = list(valid)
    for name in given:
        if name not in known:
            raise ParameterError(f'{where}{unknown_name(str(name), known)}')


def checksum(name: str, paths: Iterable[Path] = ()) -> str:
    """Return the checksum of the file `name` of the settings, or of the paths that it means."""
    value = 0
    try:
        for path in paths or [Path(name).expanduser()]:
            value = crc32(path.read_bytes(), value)
    except OSError as error:
        raise ParameterError(f'settings: {name}: {error.strerror}') from error
    return f'{value:08x}'


def needle_files(needle: Any) -> dict[str, str]:
    """Return the checksum of the file of a needle by its name, nothing for a known needle."""
    needle = str(needle) if isinstance(needle, Path) else needle
    is_file = isinstance(needle, str) and needle not in NEEDLES and needle.endswith(FILES)
    return {needle: checksum(needle)} if is_file else {}


def class_files(address: str, found: Any) -> dict[str, str]:
    """
    Return the checksum of the source files of a class by its address ``module:Class``.

    These are the files of its module and of its base classes, without files of this package,
    NumPy and SciPy: nothing for a class of these.
    """
    if ':' not in address:
        return {}
    bases = found.__mro__ if isinstance(found, type) else type(found).__mro__
    names = dict.fromkeys((address.partition(':')[0], *(one.__module__ for one in bases)))
    files = {
        Path(file)
        for name in names
        if name.partition('.')[0] not in _VERSIONED
        and (file := getattr(sys.modules.get(name), '__file__', None))
    }
    # In the order of the names: folders of workers differ.
    return {address: checksum(address, sorted(files, key=lambda one: one.name))} if files else {}


def mapping(name: str, value: Any) -> Mapping[str, Any]:
    """Return a mapping of the file, empty for None; raise `ParameterError` otherwise."""
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise ParameterError(f'{name} must be names with values, got {value!r}')
    return value
