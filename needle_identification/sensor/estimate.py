# SPDX-License-Identifier: Apache-2.0
"""Sensor estimate: errors of a tip sensor."""

from dataclasses import dataclass

from needle_identification.estimation.display import DisplayedEstimate, EstimateRows
from needle_identification.estimation.estimate import named, ParameterEstimate


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SensorEstimate(DisplayedEstimate):
    """Errors of a tip sensor; ``estimate[name]`` is a parameter."""

    name: str  #: name of the recording
    axes: tuple[str, ...]  #: axes of the biases
    parameters: tuple[ParameterEstimate, ...]  #: noise, biases, delay, losses
    rate: float  #: samples per second, from the median interval [Hz]
    samples: int  #: number of samples
    duration: float  #: time from the first to the last sample [s]
    warnings: tuple[str, ...] = ()  #: warnings about the validity of the values

    def __getitem__(self, name: str) -> ParameterEstimate:
        return named(self.parameters, name)

    def rows(self) -> EstimateRows:
        return ((self.name, one) for one in self.parameters)
