"""Interface of a scenario: variables, metrics, and the simulation of samples."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import inf
from typing import Final, NamedTuple
from typing import Protocol as Interface

from needle_dynamics import FloatArray
from needle_ros.contract import Topic
import numpy as np


class Variable(NamedTuple):
    """A variable that may differ from sample to sample."""

    default: float  #: value if it is not in the population
    #: SI unit.
    unit: str
    meaning: str
    #: Valid range.
    low: float = -inf
    high: float = inf


class Metric(NamedTuple):
    """A metric of a sample."""

    #: SI unit; '' for yes or no.
    unit: str
    meaning: str


class MeasuredRun(NamedTuple):
    """A message of a robot or a sensor in a replayed sample."""

    topic: Topic
    stamp: int  #: [ns]
    values: Sequence[float]  #: numbers of `Topic.quantities`


class Scenario(Interface):
    """Interface of a scenario, which is simulated with each sample."""

    variables: Mapping[str, Variable]  #: variables of a sample
    metrics: Mapping[str, Metric]  #: metrics, the primary metric first

    def run(
        self, samples: Mapping[str, FloatArray], streams: Sequence[np.random.Generator]
    ) -> dict[str, FloatArray]:
        """Simulate samples; return each metric, shape (n,): 1 for yes, NaN for a missing value."""

    def replay(
        self, sample: Mapping[str, float], rng: np.random.Generator
    ) -> Iterator[MeasuredRun]:
        """Simulate one sample again; yield measurements and commands in time order per topic."""


#: Class of each scenario, imported on demand; it is made from the settings of a study.
SCENARIOS: Final[Mapping[str, str]] = {
    'steering': 'needle_study.steering:SteeringScenario',
    'insertion': 'needle_study.insertion:InsertionScenario',
}
