"""Result of a fit of steered insertions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from needle_dynamics.arrays import FloatArray
from needle_identification.estimation.estimate import Named, ParameterEstimate
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
class MediumEstimate(Named[ParameterEstimate]):
    """
    Constants of a needle in one medium.

    Attributes
    ----------
    medium : str
        Name of the medium.
    parameters : tuple of ParameterEstimate
        Bending length, skin, and what makes the needle drift.
    rms : float
        What the fit leaves, per axis [m].
    samples, recordings : int
        Number of samples and of recordings.

    """

    medium: str
    parameters: tuple[ParameterEstimate, ...]
    rms: float
    samples: int
    recordings: int

    def _named(self) -> Sequence[ParameterEstimate]:
        return self.parameters


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SteeringEstimate:
    """
    Result of a fit of several recordings.

    Attributes
    ----------
    free_length : ParameterEstimate
        Free length, which they share.
    media : tuple of MediumEstimate
        Constants by medium; ``estimate[name]`` is that of one.
    terms : tuple of str
        Terms of the fit.
    order : str
        How guide and needle move between samples.
    alternatives : mapping of tuple of str to float
        What fits with these terms leave, per axis [m].
    residuals : tuple of ndarray
        Measured minus fitted positions of the tip, of each recording, where the tip is
        known, shape (samples, 2) [m].
    warnings : tuple of str
        What to know before using the values.

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
        """What the fit leaves, per axis [m]."""
        return float(np.sqrt(np.mean(np.concatenate(self.residuals) ** 2)))
