# SPDX-License-Identifier: Apache-2.0
"""Simulated measurement faults of a sensor, its cable or its driver."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, nan
from typing import Final, TypeAlias

from needle_ros.contract import BASE_WRENCH, JOINT_STATES, TIP_DEFLECTION
from needle_ros.errors import ParameterError
from needle_ros.settings import CheckedSettings, constant
import numpy as np

Reading: TypeAlias = tuple[int, list[float]]  #: stamp [ns] and values of a measurement

#: Topics for fault injection, with the indices of the values changed by a bias or a saturation:
#: position, force and torque, and deflection.
FAULTY: Final[Mapping[str, Sequence[int]]] = {
    JOINT_STATES.name: (0,),
    BASE_WRENCH.name: range(6),
    TIP_DEFLECTION.name: (2,),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultParameters(CheckedSettings):
    """Probability, delay and size of a fault."""

    probability: float = constant(1.0, '1', 'probability that a measurement is affected', high=1)
    delay: float = constant(0.05, 's', 'delay of delayed measurements', high=10.0)
    size: float = constant(
        0.0, 'SI', 'size of a bias, or bound of a saturated measurement (both signs), in its unit',
        low=-1e3, high=1e3,
    )  # fmt: skip


class SensorFault:
    """
    A fault of one measurement stream, with ``rate`` measurements per second [Hz].

    Kinds: ``drop`` discards measurements, ``delay`` publishes them later, ``duplicate`` publishes
    them twice, ``reorder`` after the next one, ``freeze`` repeats the values of the first affected
    measurement with new stamps, ``bias`` adds to the values, ``nan`` replaces them by NaN, and
    ``saturate`` limits them.
    """

    def __init__(self, kind: str, parameters: FaultParameters, rate: float, seed: int) -> None:
        if kind not in FAULTS:
            raise ParameterError(f'must be one of {", ".join(FAULTS)}, got {kind!r}')
        self._act = FAULTS[kind]
        self._parameters = parameters
        self._random = np.random.default_rng([seed, 2])
        #: Number of calls until a delayed measurement is published.
        self._late = ceil(parameters.delay * rate * (1.0 - 1e-9))
        self._frozen: list[float] | None = None
        self._calls = 0
        #: Delayed measurements, with the call at which they are published.
        self._waiting: deque[tuple[int, Reading]] = deque()

    def leaves(self, stamp: int, values: Sequence[float], biased: Sequence[int]) -> list[Reading]:
        """
        Process a measurement (stamp in ns) and return the measurements to publish now.

        ``biased`` are the indices of the values changed by a bias or saturation.
        """
        self._calls += 1
        reading = stamp, list(values)
        hit = self._random.random() < self._parameters.probability
        now = self._act(self, reading, biased) if hit else [reading]
        while self._waiting and self._waiting[0][0] <= self._calls:
            now.append(self._waiting.popleft()[1])
        return now

    def _drop(self, _reading: Reading, _biased: Sequence[int]) -> list[Reading]:
        return []

    def _delay(self, reading: Reading, _biased: Sequence[int]) -> list[Reading]:
        self._waiting.append((self._calls + self._late, reading))
        return []

    def _duplicate(self, reading: Reading, _biased: Sequence[int]) -> list[Reading]:
        return [reading, reading]

    def _reorder(self, reading: Reading, _biased: Sequence[int]) -> list[Reading]:
        # A delayed measurement is published after the next one, which is not delayed.
        if self._waiting:
            return [reading]
        self._waiting.append((self._calls + 1, reading))
        return []

    def _freeze(self, reading: Reading, _biased: Sequence[int]) -> list[Reading]:
        if self._frozen is None:
            self._frozen = reading[1]
        return [(reading[0], list(self._frozen))]

    def _bias(self, reading: Reading, biased: Sequence[int]) -> list[Reading]:
        return [_changed(reading, biased, lambda value: value + self._parameters.size)]

    def _nan(self, reading: Reading, _biased: Sequence[int]) -> list[Reading]:
        return [(reading[0], [nan] * len(reading[1]))]

    def _saturate(self, reading: Reading, biased: Sequence[int]) -> list[Reading]:
        bound = abs(self._parameters.size)
        return [_changed(reading, biased, lambda value: min(max(value, -bound), bound))]


def _changed(reading: Reading, which: Sequence[int], change: Callable[[float], float]) -> Reading:
    stamp, values = reading
    return stamp, [change(value) if k in which else value for k, value in enumerate(values)]


#: Functions that apply a fault to an affected measurement, by kind.
FAULTS: Final[Mapping[str, Callable[[SensorFault, Reading, Sequence[int]], list[Reading]]]] = {
    'drop': SensorFault._drop,
    'delay': SensorFault._delay,
    'duplicate': SensorFault._duplicate,
    'reorder': SensorFault._reorder,
    'freeze': SensorFault._freeze,
    'bias': SensorFault._bias,
    'nan': SensorFault._nan,
    'saturate': SensorFault._saturate,
}
