# SPDX-License-Identifier: Apache-2.0
"""Simulated measurement faults of a sensor, its cable or its driver."""

from collections import deque
from collections.abc import Mapping, Sequence
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


#: Kinds of faults: ``drop`` discards measurements, ``delay`` publishes them later, ``duplicate``
#: publishes them twice, ``reorder`` after the next one, ``freeze`` repeats the values of the first
#: affected measurement with new stamps, ``bias`` adds to the values, ``nan`` replaces them by NaN,
#: and ``saturate`` limits them.
FAULTS: Final = ('drop', 'delay', 'duplicate', 'reorder', 'freeze', 'bias', 'nan', 'saturate')


class SensorFault:
    """A fault of one measurement stream, with ``rate`` measurements per second [Hz]."""

    def __init__(self, kind: str, parameters: FaultParameters, rate: float, seed: int) -> None:
        if kind not in FAULTS:
            raise ParameterError(f'must be one of {", ".join(FAULTS)}, got {kind!r}')
        self._kind, self._parameters = kind, parameters
        self._random = np.random.default_rng([seed, 2])
        #: Number of calls until a delayed measurement is published.
        self._late = ceil(parameters.delay * rate * (1.0 - 1e-9))
        self._frozen: list[float] | None = None
        self._calls = 0
        #: Delayed measurements, with the call at which they are published.
        self._waiting: deque[tuple[int, Reading]] = deque()

    def apply(self, stamp: int, values: Sequence[float], biased: Sequence[int]) -> list[Reading]:
        """Process a measurement (stamp in ns) and return the measurements to publish now."""
        # ``biased`` are the indices of the values changed by a bias or saturation.
        self._calls += 1
        hit = self._random.random() < self._parameters.probability
        now = self._affected(stamp, list(values), biased) if hit else [(stamp, list(values))]
        while self._waiting and self._waiting[0][0] <= self._calls:
            now.append(self._waiting.popleft()[1])
        return now

    def _affected(self, stamp: int, values: list[float], biased: Sequence[int]) -> list[Reading]:
        reading = stamp, values
        match self._kind:
            case 'drop':
                return []
            case 'delay':
                self._waiting.append((self._calls + self._late, reading))
                return []
            case 'duplicate':
                return [reading, reading]
            case 'reorder':
                # A delayed measurement is published after the next one, which is not delayed.
                if self._waiting:
                    return [reading]
                self._waiting.append((self._calls + 1, reading))
                return []
        return [(stamp, self._changed(values, biased))]

    def _changed(self, values: list[float], biased: Sequence[int]) -> list[float]:
        size = self._parameters.size
        if self._kind == 'freeze':
            self._frozen = self._frozen or values
            return list(self._frozen)
        if self._kind == 'nan':
            return [nan] * len(values)
        for k in biased:
            bias = self._kind == 'bias'
            values[k] = values[k] + size if bias else min(max(values[k], -abs(size)), abs(size))
        return values
