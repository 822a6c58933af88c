# SPDX-License-Identifier: Apache-2.0
"""Steering estimate: constants of needle and medium from steered insertions."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_dynamics.parameters import NeedleParameters
from needle_identification.errors import UnknownNameError
from needle_identification.estimation.estimate import (
    DisplayedEstimate,
    EstimateRows,
    named,
    ParameterEstimate,
)
import numpy as np

#: Symbol and unit of each constant.
CONSTANTS: Mapping[str, tuple[str, str]] = {
    'free_length': ('L0', 'm'),
    'bending_length': ('lambda', 'm'),
    'skin': ('k_skin/k', 'm'),
    'tilt_x': ('beta_x', 'rad'),
    'tilt_z': ('beta_z', 'rad'),
    'frame_x': ('rho_x', 'rad'),
    'frame_z': ('rho_z', 'rad'),
    'frame_y': ('rho_y', 'rad'),
    'curvature_z': ('kappa_z', '1/m'),
    'curvature_x': ('kappa_x', '1/m'),
}

#: Name of the stiffness of a layer over its nominal one, with its number from 1.
LAYER: Final = 'layer_'


def symbol_and_unit(name: str) -> tuple[str, str]:
    if name.startswith(LAYER):
        return f'k_{name.removeprefix(LAYER)}/k_nominal', '1'
    return CONSTANTS[name]


class HeldOut(NamedTuple):
    """Errors of recordings that are predicted from the others of their medium."""

    rms: float  #: root mean square beyond the first depths, which determine the offset [m]
    interval: tuple[float, float]  #: 95 % interval of the rms [m]
    #: Fraction of tips within their 95 % interval, whose width is from the errors of the others.
    coverage: float


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MediumEstimate(DisplayedEstimate):
    """Constants of the needle in a medium; ``estimate[name]`` is a parameter."""

    medium: str  #: name of the medium
    #: Bending length (of the first layer), skin, stiffness of layers, and drift constants.
    parameters: tuple[ParameterEstimate, ...]
    rms: float  #: root mean square of the residuals, per axis [m]
    noise: float  #: standard deviation of the white noise of a reading [m]
    path_noise: float  #: growth of the variance of the path direction per length [rad^2/m]
    slope: float  #: standard deviation of the slope of a recording [rad]
    held_out: HeldOut | None  #: prediction from other recordings; None for a single one
    samples: int  #: number of readings; successive rows at rest are one reading
    recordings: int  #: number of recordings

    def __getitem__(self, name: str) -> ParameterEstimate:
        return named(self.parameters, name)

    @property
    def layers(self) -> tuple[ParameterEstimate, ...]:
        """Stiffness of each layer over its nominal one; empty for uniform tissue."""
        return tuple(one for one in self.parameters if one.name.startswith(LAYER))

    def rows(self) -> EstimateRows:
        return ((self.medium, one) for one in self.parameters)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SteeringEstimate(DisplayedEstimate):
    """Joint fit of several recordings; ``estimate[name]`` is a medium."""

    free_length: ParameterEstimate  #: common to all recordings
    media: tuple[MediumEstimate, ...]  #: constants by medium
    terms: tuple[str, ...]  #: terms of the fit
    order: str  #: order of guide motion and insertion between samples
    residuals: tuple[FloatArray, ...]  #: measured minus fitted tips, (samples, 2) [m]
    optima: int  #: number of distinct optima
    warnings: tuple[str, ...] = ()  #: warnings about the validity of the values
    tissue: NeedleParameters | None = None  #: nominal needle in its tissue, if it was given

    def __getitem__(self, medium: str) -> MediumEstimate:
        for one in self.media:
            if one.medium == medium:
                return one
        valid = ', '.join(one.medium for one in self.media)
        raise UnknownNameError(f'{medium!r}; valid: {valid}')

    def rows(self) -> EstimateRows:
        media = (medium.rows() for medium in self.media)
        return chain([('all', self.free_length)], *media)

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean(np.concatenate(self.residuals) ** 2)))
