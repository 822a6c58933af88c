"""Steering estimate: constants of needle and medium from steered insertions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from needle_dynamics.arrays import FloatArray
from needle_identification.estimation.estimate import named, ParameterEstimate
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


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MediumEstimate:
    """
    Constants of the needle in a medium.

    Attributes
    ----------
    medium : str
        Name of the medium.
    parameters : tuple of ParameterEstimate
        Bending length, skin, and drift constants.
    rms : float
        Root mean square of the residuals, per axis [m].
    samples, recordings : int
        Number of samples and of recordings.

    """

    medium: str
    parameters: tuple[ParameterEstimate, ...]
    rms: float
    samples: int
    recordings: int

    def __getitem__(self, name: str) -> ParameterEstimate:
        return named(self.parameters, name)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SteeringEstimate:
    """
    Joint fit of several recordings.

    Attributes
    ----------
    free_length : ParameterEstimate
        Free length, common to all recordings.
    media : tuple of MediumEstimate
        Constants by medium; ``estimate[name]`` returns a medium.
    terms : tuple of str
        Terms of the fit.
    order : str
        Order of guide motion and insertion between samples.
    alternatives : mapping of tuple of str to float
        Root mean square of the residuals by set of terms, per axis [m].
    residuals : tuple of ndarray
        Measured minus fitted tip positions of each recording, without missing measurements,
        shape (samples, 2) [m].
    warnings : tuple of str
        Warnings about the validity of the values.

    """

    free_length: ParameterEstimate
    media: tuple[MediumEstimate, ...]
    terms: tuple[str, ...]
    order: str
    alternatives: Mapping[tuple[str, ...], float]
    residuals: tuple[FloatArray, ...]
    warnings: tuple[str, ...] = ()

    def __getitem__(self, medium: str) -> MediumEstimate:
        for one in self.media:
            if one.medium == medium:
                return one
        raise KeyError(f'{medium!r}; valid: {", ".join(one.medium for one in self.media)}')

    @property
    def rms(self) -> float:
        """Root mean square of the residuals, per axis [m]."""
        return float(np.sqrt(np.mean(np.concatenate(self.residuals) ** 2)))
