"""Faults of a measurement on its way: what a sensor, its cable or its driver may do to it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, nan
from typing import Final, TypeAlias

from needle_ros.errors import (
    ParameterError,
)
from needle_ros.settings import check_constants, constant
import numpy as np

#: Stamp [ns] and values of a measurement.
Reading: TypeAlias = tuple[int, list[float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultParameters:
    """How often, how late, how much."""

    probability: float = constant(1.0, '1', 'part of the measurements that the fault hits', high=1)
    delay: float = constant(0.05, 's', 'how much later delayed measurements leave', high=10.0)
    size: float = constant(
        0.0, 'SI', 'what a bias adds, or where a measurement saturates (either sign), in its unit',
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
        self.parameters = parameters
        self._random = np.random.default_rng([seed, 2])
        #: Calls until a delayed measurement leaves.
        self.late = ceil(parameters.delay * rate * (1.0 - 1e-9))
        self.frozen: list[float] | None = None
        self._calls = 0
        #: What leaves later, and at which call.
        self._waiting: deque[tuple[int, Reading]] = deque()

    @property
    def has_waiting(self) -> bool:
        """Whether a measurement waits to leave."""
        return bool(self._waiting)

    def later(self, calls: int, reading: Reading) -> None:
        """Let a measurement leave so many calls from now."""
        self._waiting.append((self._calls + calls, reading))

    def leaves(self, stamp: int, values: Sequence[float], biased: int) -> list[Reading]:
        """
        Pass a measurement on.

        Parameters
        ----------
        stamp : int
            Its time [ns].
        values : sequence of float
            Its values.
        biased : int
            How many of the values, from the first, a bias or saturation changes.

        Returns
        -------
        list of tuple
            What leaves now: stamps and values.

        """
        self._calls += 1
        reading = stamp, list(values)
        hit = self._random.random() < self.parameters.probability
        now = self._act(self, reading, biased) if hit else [reading]
        while self._waiting and self._waiting[0][0] <= self._calls:
            now.append(self._waiting.popleft()[1])
        return now


def _drop(_fault: Fault, _reading: Reading, _biased: int) -> list[Reading]:
    return []


def _delay(fault: Fault, reading: Reading, _biased: int) -> list[Reading]:
    fault.later(fault.late, reading)
    return []


def _duplicate(_fault: Fault, reading: Reading, _biased: int) -> list[Reading]:
    return [reading, reading]


def _reorder(fault: Fault, reading: Reading, _biased: int) -> list[Reading]:
    # What waits leaves after the next one, which then does not wait.
    if fault.has_waiting:
        return [reading]
    fault.later(1, reading)
    return []


def _freeze(fault: Fault, reading: Reading, _biased: int) -> list[Reading]:
    if fault.frozen is None:
        fault.frozen = reading[1]
    return [(reading[0], list(fault.frozen))]


def _bias(fault: Fault, reading: Reading, biased: int) -> list[Reading]:
    size, (stamp, values) = fault.parameters.size, reading
    return [(stamp, [value + size for value in values[:biased]] + values[biased:])]


def _nan(_fault: Fault, reading: Reading, _biased: int) -> list[Reading]:
    return [(reading[0], [nan] * len(reading[1]))]


def _saturate(fault: Fault, reading: Reading, biased: int) -> list[Reading]:
    bound, (stamp, values) = abs(fault.parameters.size), reading
    kept = [min(max(value, -bound), bound) for value in values[:biased]]
    return [(stamp, kept + values[biased:])]


#: What a fault does to a measurement that it hits, by name.
FAULTS: Final[Mapping[str, Callable[[Fault, Reading, int], list[Reading]]]] = {
    'drop': _drop,
    'delay': _delay,
    'duplicate': _duplicate,
    'reorder': _reorder,
    'freeze': _freeze,
    'bias': _bias,
    'nan': _nan,
    'saturate': _saturate,
}
