"""Constants of a needle that cuts its path, beyond those of the needle and the tissue."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import pi
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_dynamics.parameters import NeedleParameters, PRESETS
from needle_ros.errors import ParameterError
from needle_ros.settings import check_constants, constant
import numpy as np

#: Bending over torsional stiffness of a round needle of steel: E I / (G J) = 1 + nu.
_STEEL: Final = 1.3

#: Longest element over the bending length: the series of an element have ended there.
_LONGEST: Final = 1.0

#: Loads of the noise of the path per length over which it forgets itself.
_CELLS: Final = 5

#: Constants of `NeedleParameters` that a steered needle has; the others are of the paper's model.
NEEDLE_CONSTANTS: Final = (
    'length', 'density', 'area', 'youngs_modulus', 'area_moment', 'carriage_mass',
    'tissue_stiffness', 'layer_depths', 'layer_stiffnesses', 'coulomb_friction',
    'viscous_friction', 'withdrawal_friction',
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class SteeringParameters:
    """
    What a needle that cuts its path has beyond `NeedleParameters`, SI units.

    A tuple has one value for each layer of the tissue, or a single one for all.

    Raises
    ------
    ParameterError
        If a constant is not a number or is outside its range.

    """

    free_length: float = constant(0.02, 'm', 'length L0 of the needle between guide and skin')
    skin_stiffness: float = constant(0.0, 'N/m', 'lateral stiffness k_skin of the skin')
    bevel_load: tuple[float, ...] = constant(
        (0.0,), 'N', 'lateral load F_b of the bevel while it cuts, of each layer; 0 for a trocar'
    )
    cutting_force: tuple[float, ...] = constant(
        (0.0,), 'N', 'axial force on the tip that cuts, in each layer'
    )
    coulomb_per_length: tuple[float, ...] = constant(
        (0.0,), 'N/m', 'Coulomb friction per inserted length, in each layer'
    )
    viscous_per_length: tuple[float, ...] = constant(
        (0.0,), 'N s/m^2', 'viscous friction per inserted length, in each layer'
    )
    membrane_depths: tuple[float, ...] = constant((), 'm', 'depths of membranes')
    membrane_strengths: tuple[float, ...] = constant(
        (), 'N', 'axial force that punctures each membrane', open_low=True
    )
    membrane_stiffness: float = constant(
        1e3, 'N/m', 'axial stiffness of a membrane until it is punctured', open_low=True
    )
    path_noise: float = constant(
        0.0, 'rad^2/m', 'variance of the direction of the path that grows per length'
    )
    path_noise_length: float = constant(
        5e-3, 'm', 'length over which that noise forgets itself', open_low=True
    )
    torsional_friction: float = constant(
        0.0, 'N', 'friction torque on the shaft per inserted length'
    )
    torsional_stiffness: float = constant(
        0.0256 / _STEEL, 'N m^2', 'torsional stiffness G J of the needle', open_low=True
    )
    element: float = constant(1e-3, 'm', 'longest element of the beam', open_low=True)

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


def bending_length(stiffness: float, tissue: float) -> float:
    """
    Return the length over which a needle bends in tissue, lambda = (4 E I / k)^(1/4).

    Parameters
    ----------
    stiffness : float
        Bending stiffness E I [N m^2].
    tissue : float
        Stiffness k of the tissue per length [N/m^2].

    Returns
    -------
    float
        The length [m].

    """
    return float((4.0 * stiffness / tissue) ** 0.25)


def tissue_of(stiffness: float, length: float) -> float:
    """
    Return the stiffness of tissue in which a needle has a bending length.

    Parameters
    ----------
    stiffness : float
        Bending stiffness E I [N m^2].
    length : float
        Bending length lambda [m].

    Returns
    -------
    float
        Stiffness k per length [N/m^2].

    """
    return 4.0 * stiffness / length**4


def turning_load(stiffness: float, tissue: float) -> float:
    """
    Return the lateral load on the tip that turns the path of a long needle with 1/m.

    Parameters
    ----------
    stiffness : float
        Bending stiffness E I [N m^2].
    tissue : float
        Stiffness k of the tissue per length [N/m^2].

    Returns
    -------
    float
        The load E I / lambda [N]; none where there is no tissue to turn in.

    """
    return stiffness / bending_length(stiffness, tissue) if tissue > 0.0 else 0.0


def with_lengths(
    needle: NeedleParameters, steering: SteeringParameters, length: float, skin: float = 1.0
) -> tuple[NeedleParameters, SteeringParameters]:
    """
    Return a needle that bends over other lengths, all layers alike.

    Parameters
    ----------
    needle : NeedleParameters
        Needle and tissue.
    steering : SteeringParameters
        What they have beyond.
    length : float
        Bending length over the present one.
    skin : float
        Stiffness of the skin over that of the tissue, over the present one.

    Returns
    -------
    NeedleParameters, SteeringParameters
        The needle in other tissue.

    """
    stiffer = length**-4.0
    return (
        replace(
            needle,
            tissue_stiffness=needle.tissue_stiffness * stiffer,
            layer_stiffnesses=tuple(k * stiffer for k in needle.layer_stiffnesses),
        ),
        replace(steering, skin_stiffness=steering.skin_stiffness * stiffer * skin),
    )


def by_layer(name: str, values: tuple[float, ...], layers: int) -> FloatArray:
    """
    Return one value for each layer.

    Parameters
    ----------
    name : str
        Name of the constant, for the message.
    values : tuple of float
        One value for all, or one for each.
    layers : int
        Number of layers.

    Returns
    -------
    ndarray, shape (layers,)
        The values.

    Raises
    ------
    ParameterError
        If there are other numbers of them.

    """
    if len(values) not in (1, layers):
        raise ParameterError(
            f'{name} must have one value, or one for each of the {layers} layers of the tissue, '
            f'got {len(values)}'
        )
    return np.broadcast_to(np.array(values, dtype=np.float64), (layers,)).copy()


def longest_element(needle: NeedleParameters, steering: SteeringParameters) -> float:
    """
    Return the length of the elements.

    Parameters
    ----------
    needle : NeedleParameters
        Needle and tissue.
    steering : SteeringParameters
        What is wanted.

    Returns
    -------
    float
        That wanted, or a shorter one [m]: at most the bending length in the stiffest layer, and
        the distance between the loads of the noise.

    """
    longest = steering.element
    stiffest = max(needle.tissue.stiffnesses)
    if stiffest > 0.0:
        longest = min(longest, _LONGEST * bending_length(needle.bending_stiffness, stiffest))
    return min(longest, noise_cell(steering)) if steering.path_noise > 0.0 else longest


def noise_cell(steering: SteeringParameters) -> float:
    """
    Return the distance between the lateral loads that stand for the noise of the path.

    Parameters
    ----------
    steering : SteeringParameters
        With that noise.

    Returns
    -------
    float
        The distance [m].

    """
    return steering.path_noise_length / _CELLS


class SteeringPreset(NamedTuple):
    """
    A needle in tissue, and where its constants come from.

    Attributes
    ----------
    needle : NeedleParameters
        Needle and tissue.
    steering : SteeringParameters
        What it has beyond.
    source : str
        Where the constants come from.

    """

    needle: NeedleParameters
    steering: SteeringParameters
    source: str


def _tube(outer: float, inner: float, modulus: float, tissue: float) -> NeedleParameters:
    """Return a round needle of an outer and an inner diameter [m]."""
    return replace(
        PRESETS['phantom'],
        youngs_modulus=modulus,
        area=pi / 4.0 * (outer**2 - inner**2),
        area_moment=pi / 64.0 * (outer**4 - inner**4),
        tissue_stiffness=tissue,
    )


def _literature(
    outer: float, inner: float, modulus: float, tissue: float, source: str
) -> SteeringPreset:
    needle = _tube(outer, inner, modulus, tissue)
    twist = needle.bending_stiffness / _STEEL
    return SteeringPreset(needle, SteeringParameters(torsional_stiffness=twist), source)


def _phantom(length: float) -> SteeringPreset:
    needle = PRESETS['phantom']
    tissue = tissue_of(needle.bending_stiffness, length)
    return SteeringPreset(
        replace(needle, tissue_stiffness=tissue),
        SteeringParameters(free_length=0.04),
        f"the paper's needle where it bends over {1e3 * length:g} mm, as stock needles do in "
        'phantoms and in tissue ex vivo',
    )


#: Needles in tissue by name. What a source does not give is that of the paper's needle.
STEERING_PRESETS: Final[Mapping[str, SteeringPreset]] = {
    'paper': SteeringPreset(
        PRESETS['phantom'], SteeringParameters(), 'Boroomand et al. 2014, Table 3'
    ),
    'bending_25mm': _phantom(0.025),
    'bending_35mm': _phantom(0.035),
    'bending_50mm': _phantom(0.05),
    'abayazid_2013': _literature(0.5e-3, 0.0, 75e9, 167059.0, 'Abayazid et al. 2013, gelatin'),
    'misra_2010': _literature(0.46e-3, 0.0, 50e9, 4830.0, 'Misra et al. 2010, plastisol A'),
    'roesthuis_2012': _literature(0.8e-3, 0.0, 75e9, 1.5e5, 'Roesthuis et al. 2012'),
    'hollow_0.70mm': _literature(0.7e-3, 0.48e-3, 200e9, 2e4, 'ustk, needle of 22 gauge'),
    'hollow_1.05mm': _literature(1.05e-3, 0.838e-3, 200e9, 2e4, 'ustk, needle of 19 gauge'),
}

#: Needles and tissues of all presets by name.
NEEDLES: Final[Mapping[str, NeedleParameters]] = {
    **PRESETS,
    **{name: preset.needle for name, preset in STEERING_PRESETS.items()},
}
