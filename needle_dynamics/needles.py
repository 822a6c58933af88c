# SPDX-License-Identifier: Apache-2.0
"""Needles in tissue by name: the paper's, needles that bend, and needles of YAML files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from difflib import get_close_matches
from math import pi
from os import fspath, PathLike
from pathlib import Path
from typing import Any, Final, NamedTuple

from needle_dynamics.parameters import NeedleParameters, PAPER_NEEDLE, PRESETS
from needle_dynamics.steering.parameters import STEEL, SteeringParameters, tissue_of
from needle_ros.errors import ParameterError
from needle_ros.files import read_yaml
from needle_ros.parameter_file import sections_of
from needle_ros.quantities import quantity
from needle_ros.settings import from_values, is_number, unknown_name

#: Needle of new commands, studies and environments, and of the node `steering`.
DEFAULT_NEEDLE: Final = 'bending_35mm'

FILES: Final = ('.yaml', '.yml')  #: Ends of the names of files of needles.
DIAMETERS: Final = ('outer_diameter', 'inner_diameter')  #: of a tube, in place of its area
_WIDEST: Final = 0.02  # largest diameter [m]: a value in mm is an error
_PREFIXES: Final = ('model.', 'steering.')  #: Prefixes of the constants in a ROS parameter file.


class NeedlePreset(NamedTuple):
    """Constants of a needle in tissue, with their source."""

    needle: NeedleParameters  #: needle and tissue
    steering: SteeringParameters  #: constants of a needle that bends about the path that it cuts
    source: str  #: source of the constants

    @property
    def bends(self) -> bool:
        """Whether constants of bending are known; the needles of the paper have none."""
        return self.steering != SteeringParameters()

    def changed(self, values: Mapping[str, Any]) -> NeedlePreset:
        """Return these constants with other values by name, also the diameters of a tube [m]."""
        # One number may replace a tuple.
        values = of_tube(values)
        known = [item.name for part in (self.needle, self.steering) for item in fields(part)]
        for name in values:
            if name not in known:
                raise ParameterError(unknown_name(str(name), [*known, *DIAMETERS]))

        def replaced(part: Any) -> Any:
            own = {item.name: values[item.name] for item in fields(part) if item.name in values}
            return from_values(type(part), {**asdict(part), **own})

        needle = replaced(self.needle)
        if self.bends and 'torsional_stiffness' not in values:
            # Both stiffnesses are proportional to the moment of the section and to the modulus.
            stiffer = needle.bending_stiffness / self.needle.bending_stiffness
            twist = self.steering.torsional_stiffness * stiffer
            values = {**values, 'torsional_stiffness': twist}
        return NeedlePreset(needle, replaced(self.steering), self.source)


def tube(outer: float, inner: float = 0.0) -> tuple[float, float]:
    """Return area [m^2] and area moment [m^4] of a tube with these diameters [m]."""
    return pi / 4.0 * (outer**2 - inner**2), pi / 64.0 * (outer**4 - inner**4)


def of_tube(values: Mapping[str, Any]) -> dict[str, Any]:
    """Replace the diameters of a tube by its area and area moment."""
    others = {name: value for name, value in values.items() if name not in DIAMETERS}
    if len(others) == len(values):
        return others
    outer, inner = (
        quantity(value, 'm') if isinstance(value := values.get(name, 0.0), str) else value
        for name in DIAMETERS
    )
    if not (is_number(outer) and is_number(inner) and 0.0 <= inner < outer <= _WIDEST):
        hint = ' (in mm?)' if is_number(outer) and outer > _WIDEST else ''
        raise ParameterError(
            f'outer_diameter and inner_diameter must be 0 <= inner < outer <= {_WIDEST:g} m, got '
            f'{outer!r}{hint} and {inner!r}'
        )
    if clash := [name for name in ('area', 'area_moment') if name in others]:
        raise ParameterError(f'{clash[0]} is given by the diameters, too: omit one of them')
    area, moment = tube(outer, inner)
    return {**others, 'area': area, 'area_moment': moment}


def _literature(
    outer: float, inner: float, modulus: float, tissue: float, source: str
) -> NeedlePreset:
    """Return a round needle with outer and inner diameter [m]; other constants are the paper's."""
    area, moment = tube(outer, inner)
    needle = replace(
        PRESETS['phantom'],
        youngs_modulus=modulus,
        area=area,
        area_moment=moment,
        tissue_stiffness=tissue,
    )
    twist = needle.bending_stiffness / STEEL
    return NeedlePreset(needle, SteeringParameters(torsional_stiffness=twist), source)


def _phantom(length: float) -> NeedlePreset:
    needle = PRESETS['phantom']
    tissue = tissue_of(needle.bending_stiffness, length)
    return NeedlePreset(
        replace(needle, tissue_stiffness=tissue),
        SteeringParameters(free_length=0.04),
        f"the paper's needle with a bending length of {1e3 * length:g} mm, as stock needles in "
        'phantoms and in tissue ex vivo',
    )


#: Needles in tissue by name. Constants missing in a source are taken from the paper's needle.
NEEDLES: Final[Mapping[str, NeedlePreset]] = {
    **{
        name: NeedlePreset(needle, SteeringParameters(), 'Boroomand et al. 2014, Tables 1 to 3')
        for name, needle in PRESETS.items()
    },
    'bending_25mm': _phantom(0.025),
    'bending_35mm': _phantom(0.035),
    'bending_50mm': _phantom(0.05),
    'abayazid_2013': _literature(0.5e-3, 0.0, 75e9, 167059.0, 'Abayazid et al. 2013, gelatin'),
    'misra_2010': _literature(0.46e-3, 0.0, 50e9, 4830.0, 'Misra et al. 2010, plastisol A'),
    'roesthuis_2012': _literature(0.8e-3, 0.0, 75e9, 1.5e5, 'Roesthuis et al. 2012'),
    'hollow_0.70mm': _literature(0.7e-3, 0.48e-3, 200e9, 2e4, 'ustk, needle of 22 gauge'),
    'hollow_1.05mm': _literature(1.05e-3, 0.838e-3, 200e9, 2e4, 'ustk, needle of 19 gauge'),
}


def find_needle(name: str | PathLike[str]) -> NeedlePreset:
    """
    Return a needle of `NEEDLES`, or of a YAML file.

    A file has names and values of constants, and the name of the needle to which the other
    constants belong as ``needle`` (default bending_35mm). A ROS parameter file is accepted, too.

    Parameters
    ----------
    name : str or path
        Key of `NEEDLES`, or file name (.yaml).

    Returns
    -------
    NeedlePreset
        The constants.

    Examples
    --------
    >>> find_needle('bending_35mm').steering.free_length
    0.04

    """
    name = fspath(name) if isinstance(name, PathLike) else name
    if not isinstance(name, str) or (name not in NEEDLES and not name.endswith(FILES)):
        near = get_close_matches(str(name), NEEDLES, 1)
        meant = f'; did you mean {near[0]}?' if near else ''
        raise ParameterError(f'needle must be {NEEDLE_HELP}, got {name!r}{meant}')
    if name in NEEDLES:
        return NEEDLES[name]
    return _based(name, read_yaml(Path(name).expanduser()))


def usable_needle(name: str) -> str:
    """Return the name of a valid needle, or of the paper's: nodes reject names in `configure`."""
    try:
        find_needle(name)
    except ParameterError:
        return PAPER_NEEDLE
    return name


def _based(name: str, document: object) -> NeedlePreset:
    given = document if isinstance(document, dict) else {}
    values: dict[str, Any] = {str(key): value for key, value in given.items()}
    sections = [section for _, section in sections_of(document)]
    if sections:
        found = {str(key): value for section in sections for key, value in section.items()}
        values = {
            key.rpartition('.')[2]: value
            for key, value in found.items()
            if key == 'needle' or key.startswith(_PREFIXES)
        }
        if not values:
            raise ParameterError(
                f'{name} must have constants {" or ".join(f"{one}*" for one in _PREFIXES)}, got '
                f'{", ".join(found)}'
            )
    base = str(values.pop('needle', DEFAULT_NEEDLE))
    if base not in NEEDLES or not values:
        raise ParameterError(
            f'{name} must have constants by name, and as needle one of {", ".join(NEEDLES)}'
        )
    try:
        return NEEDLES[base].changed(values)._replace(source=name)
    except ParameterError as error:
        raise ParameterError(f'{name}: {error}') from error


#: Help text of the choice of a needle.
NEEDLE_HELP: Final = f'one of {", ".join(NEEDLES)}, or a file of your own (.yaml)'
