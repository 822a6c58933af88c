"""What is done with each sample of a population."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from math import inf
from typing import Any, Final, NamedTuple
from typing import Protocol as Interface

from needle_dynamics import FloatArray
from needle_ros.contract import Topic
import numpy as np


class Quantity(NamedTuple):
    """
    A number that may differ from sample to sample.

    Attributes
    ----------
    default : float
        Its value where the population does not say.
    unit : str
        SI unit.
    meaning : str
        What it is.
    low, high : float
        Valid range.

    """

    default: float
    unit: str
    meaning: str
    low: float = -inf
    high: float = inf


class Figure(NamedTuple):
    """
    A figure of merit.

    Attributes
    ----------
    unit : str
        SI unit; '' for yes or no.
    meaning : str
        What it is.

    """

    unit: str
    meaning: str


class Seen(NamedTuple):
    """
    What a robot or a sensor would have said in a sample.

    Attributes
    ----------
    topic : Topic
        Where.
    stamp : int
        When [ns].
    values : sequence of float
        Its numbers, see `Topic.quantities`.

    """

    topic: Topic
    stamp: int
    values: Sequence[float]


class Protocol(Interface):
    """
    What is done with a sample.

    Attributes
    ----------
    quantities : dict of str to Quantity
        What may differ.
    figures : dict of str to Figure
        What comes out, the one that matters most first.

    """

    quantities: Mapping[str, Quantity]
    figures: Mapping[str, Figure]

    def run(
        self, drawn: Mapping[str, FloatArray], streams: Sequence[np.random.Generator]
    ) -> dict[str, FloatArray]:
        """
        Do it with some samples.

        Parameters
        ----------
        drawn : dict of str to ndarray, shape (n,)
            What differs.
        streams : sequence of Generator
            Source of chance of each sample.

        Returns
        -------
        dict of str to ndarray, shape (n,)
            Figures of merit; yes is 1, and what does not exist nan.

        """

    def replay(self, drawn: Mapping[str, float], rng: np.random.Generator) -> Iterator[Seen]:
        """
        Do it with one sample again.

        Parameters
        ----------
        drawn : dict of str to float
            What differs.
        rng : Generator
            Its source of chance.

        Yields
        ------
        Seen
            What was measured and commanded, in the order of time within each topic.

        """


# Imported when they are made: a study needs one of them.


def _steering(settings: Mapping[str, Any]) -> Protocol:
    from needle_insertion.study.steering import SteeringProtocol

    return SteeringProtocol(settings)


def _insertion(settings: Mapping[str, Any]) -> Protocol:
    from needle_insertion.study.insertion import InsertionProtocol

    return InsertionProtocol(settings)


#: Makes each protocol from the settings of a study.
PROTOCOLS: Final[Mapping[str, Callable[[Mapping[str, Any]], Protocol]]] = {
    'steering': _steering,
    'insertion': _insertion,
}
