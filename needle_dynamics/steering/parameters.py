# SPDX-License-Identifier: Apache-2.0
"""Constants of a steered needle in addition to the needle and tissue constants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

from needle_dynamics.arrays import FloatArray
from needle_dynamics.parameters import NeedleParameters
from needle_ros.errors import ParameterError
from needle_ros.settings import check_constants, constant, from_values, positive
import numpy as np

#: Ratio of bending to torsional stiffness of a round steel needle: E I / (G J) = 1 + nu.
STEEL: Final = 1.3

#: Longest element over the bending length; the element series converges up to this value.
_LONGEST: Final = 1.0

_CELLS: Final = 5  #: loads of the path noise per correlation length

#: Constants of `NeedleParameters` used by a steered needle; the others belong to the paper model.
NEEDLE_CONSTANTS: Final = (
    'length', 'density', 'area', 'youngs_modulus', 'area_moment', 'carriage_mass',
    'tissue_stiffness', 'layer_depths', 'layer_stiffnesses', 'coulomb_friction',
    'viscous_friction', 'withdrawal_friction',
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class SteeringParameters:
    """
    Constants of a needle that cuts its path, in addition to `NeedleParameters`, SI units.

    A tuple has one value for each tissue layer, or a single value for all layers.
    """

    free_length: float = constant(0.02, 'm', 'length L0 of the needle between guide and skin')
    skin_stiffness: float = constant(0.0, 'N/m', 'lateral stiffness k_skin of the skin')
    bevel_load: tuple[float, ...] = constant(
        (0.0,), 'N', 'lateral load F_b of the bevel during cutting, by layer; 0 for a trocar'
    )
    cutting_force: tuple[float, ...] = constant(
        (0.0,), 'N', 'axial cutting force on the tip, by layer'
    )
    coulomb_per_length: tuple[float, ...] = constant(
        (0.0,), 'N/m', 'Coulomb friction per inserted length, by layer'
    )
    viscous_per_length: tuple[float, ...] = constant(
        (0.0,), 'N s/m^2', 'viscous friction per inserted length, by layer'
    )
    membrane_depths: tuple[float, ...] = constant((), 'm', 'depths of membranes')
    membrane_strengths: tuple[float, ...] = constant(
        (), 'N', 'axial force that punctures each membrane', open_low=True
    )
    membrane_stiffness: float = positive(
        1e3, 'N/m', 'axial stiffness of a membrane until it is punctured'
    )
    path_noise: float = constant(
        0.0, 'rad^2/m', 'growth of the variance of the path direction per length'
    )
    path_noise_length: float = positive(5e-3, 'm', 'correlation length of the path noise')
    torsional_friction: float = constant(
        0.0, 'N', 'friction torque on the shaft per inserted length'
    )
    torsional_stiffness: float = positive(
        0.0256 / STEEL, 'N m^2', 'torsional stiffness G J of the needle'
    )
    element: float = positive(1e-3, 'm', 'longest element of the beam')

    def __post_init__(self) -> None:
        check_constants(self)
        for name in ('bevel_load', 'cutting_force', 'coulomb_per_length', 'viscous_per_length'):
            if not getattr(self, name):
                raise ParameterError(f'{name} must have one value, or one for each layer')
        if len(self.membrane_depths) != len(self.membrane_strengths):
            raise ParameterError(
                f'membrane_strengths must have one value for each of the '
                f'{len(self.membrane_depths)} membrane_depths, got {len(self.membrane_strengths)}'
            )

    @classmethod
    def preset(cls, name: str, **changes: Any) -> SteeringParameters:
        """Return the constants of a needle of `find_needle` by name, with changed fields."""
        # Imported here: the needles are above this module.
        from needle_dynamics.needles import find_needle

        return from_values(cls, {**asdict(find_needle(name).steering), **changes})


def bending_length(stiffness: float, tissue: float) -> float:
    """
    Return the bending length of a needle in tissue, lambda = (4 E I / k)^(1/4).

    Parameters
    ----------
    stiffness, tissue : float
        Bending stiffness E I [N m^2]; stiffness k of the tissue per length [N/m^2].

    Returns
    -------
    float
        Bending length [m].

    """
    return float((4.0 * stiffness / tissue) ** 0.25)


def tissue_of(stiffness: float, length: float) -> float:
    """Return the tissue stiffness k [N/m^2] for a stiffness E I [N m^2] and bending length [m]."""
    return 4.0 * stiffness / length**4


def turning_load(stiffness: float, tissue: float) -> float:
    """Return the tip load E I / lambda [N] for a path curvature of 1/m; 0 without tissue."""
    return stiffness / bending_length(stiffness, tissue) if tissue > 0.0 else 0.0


def with_lengths(
    needle: NeedleParameters, steering: SteeringParameters, length: float, skin: float = 1.0
) -> tuple[NeedleParameters, SteeringParameters]:
    """Scale the bending length in all layers, and the ratio of skin to tissue stiffness."""
    stiffer = length**-4.0
    return (
        replace(
            needle,
            tissue_stiffness=needle.tissue_stiffness * stiffer,
            layer_stiffnesses=tuple(k * stiffer for k in needle.layer_stiffnesses),
        ),
        replace(steering, skin_stiffness=steering.skin_stiffness * stiffer * skin),
    )


def with_layers(needle: NeedleParameters, factors: Sequence[float]) -> NeedleParameters:
    """Scale the stiffness of each layer, shape (layers,); the skin does not change."""
    first, *others = (k * by for k, by in zip(needle.tissue.stiffnesses, factors, strict=True))
    return replace(needle, tissue_stiffness=first, layer_stiffnesses=tuple(others))


def with_bevel(steering: SteeringParameters, load: float) -> SteeringParameters:
    """
    Scale the load of the bevel in all layers by the same factor.

    Parameters
    ----------
    steering : SteeringParameters
        Constants with one load of the bevel, or one for each layer.
    load : float
        New load in the layer with the largest one [N]; in all layers, if the loads are 0.

    Returns
    -------
    SteeringParameters
        Constants with the new loads.

    """
    most = max(steering.bevel_load)
    parts = tuple(one / most for one in steering.bevel_load) if most else (1.0,)
    return replace(steering, bevel_load=tuple(load * part for part in parts))


def by_layer(name: str, values: tuple[float, ...], layers: int) -> FloatArray:
    """Return a constant as one value per layer, shape (layers,); errors contain ``name``."""
    if len(values) not in (1, layers):
        raise ParameterError(
            f'{name} must have one value, or one for each of the {layers} layers of the tissue, '
            f'got {len(values)}'
        )
    return np.broadcast_to(np.array(values, dtype=np.float64), (layers,)).copy()


def longest_insertion(needle: NeedleParameters, steering: SteeringParameters) -> float:
    """Return the length of a needle without its free length [m]."""
    if steering.free_length >= needle.length:
        raise ParameterError(
            f'free_length must be < length = {needle.length:g} m, got {steering.free_length:g} m'
        )
    return needle.length - steering.free_length


def longest_element(needle: NeedleParameters, steering: SteeringParameters) -> float:
    """Return the element length [m], within bending length and distance of the noise loads."""
    longest = steering.element
    stiffest = max(needle.tissue.stiffnesses)
    if stiffest > 0.0:
        longest = min(longest, _LONGEST * bending_length(needle.bending_stiffness, stiffest))
    return min(longest, noise_cell(steering)) if steering.path_noise > 0.0 else longest


def noise_cell(steering: SteeringParameters) -> float:
    """Return the distance between the lateral loads of the path noise [m]."""
    return steering.path_noise_length / _CELLS
