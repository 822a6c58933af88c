"""Faults of measurements, as a sensor, its cable or its driver may have."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, nan
from typing import Final, TypeAlias

from needle_ros.contract import BASE_WRENCH, JOINT_STATES, TIP_DEFLECTION
from needle_ros.errors import ParameterError
from needle_ros.settings import check_constants, constant
import numpy as np

#: Stamp [ns] and values of a measurement.
Reading: TypeAlias = tuple[int, list[float]]

#: Topics that a fault can hit, and which of their values a bias or a saturation changes: the
#: position, force and torque, and the deflection.
FAULTY: Final[Mapping[str, Sequence[int]]] = {
    JOINT_STATES.name: (0,),
    BASE_WRENCH.name: range(6),
    TIP_DEFLECTION.name: (2,),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultParameters:
    """Probability, delay and size of a fault."""

    probability: float = constant(1.0, '1', 'probability that a measurement is affected', high=1)
    delay: float = constant(0.05, 's', 'delay of delayed measurements', high=10.0)
    size: float = constant(
        0.0, 'SI', 'size of a bias, or bound of a saturated measurement (both signs), in its unit',
        low=-1e3, high=1e3,
    )  # fmt: skip

    def __post_init__(self) -> None:
        check_constants(self)


class Fault:
    """
    One kind of fault of one stream of measurements.

    Parameters
    ----------
    kind : str
        One of `FAULTS`: ``drop`` loses measurements, ``delay`` lets them leave later,
        ``duplicate`` lets them leave twice, ``reorder`` after the next one, ``freeze`` repeats
        the values of the first one that it hits under new stamps, ``bias`` adds to the values,
        ``nan`` makes them not a number, ``saturate`` bounds them.
    parameters : FaultParameters
        How often, how late, how much.
    rate : float
        Measurements per second [Hz].
    seed : int
        Seed of what is hit.

    Raises
    ------
    ParameterError
        If the kind is unknown.

    """

    def __init__(self, kind: str, parameters: FaultParameters, rate: float, seed: int) -> None:
        if kind not in FAULTS:
            raise ParameterError(f'must be one of {", ".join(FAULTS)}, got {kind!r}')
        self._act = FAULTS[kind]
        self._parameters = parameters
        self._random = np.random.default_rng([seed, 2])
        #: Calls until a delayed measurement leaves.
        self._late = ceil(parameters.delay * rate * (1.0 - 1e-9))
        self._frozen: list[float] | None = None
        self._calls = 0
        #: What leaves later, and at which call.
        self._waiting: deque[tuple[int, Reading]] = deque()

    def leaves(self, stamp: int, values: Sequence[float], biased: Sequence[int]) -> list[Reading]:
        """
        Pass a measurement on.

        Parameters
        ----------
        stamp : int
            Its time [ns].
        values : sequence of float
            Its values.
        biased : sequence of int
            Which of the values a bias or saturation changes.

        Returns
        -------
        list of tuple
            What leaves now: stamps and values.

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
        # What waits leaves after the next one, which then does not wait.
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


#: What a fault does to a measurement that it hits, by name.
FAULTS: Final[Mapping[str, Callable[[Fault, Reading, Sequence[int]], list[Reading]]]] = {
    'drop': Fault._drop,
    'delay': Fault._delay,
    'duplicate': Fault._duplicate,
    'reorder': Fault._reorder,
    'freeze': Fault._freeze,
    'bias': Fault._bias,
    'nan': Fault._nan,
    'saturate': Fault._saturate,
}
