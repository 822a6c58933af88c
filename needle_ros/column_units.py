# SPDX-License-Identifier: Apache-2.0
"""Units of table columns by role, and units in their names."""

from collections.abc import Mapping
from math import pi
import re
from typing import Final

from needle_ros.errors import ParameterError
from needle_ros.quantities import factors

_INCH: Final = 0.0254  #: [m]
_MICRO: Final = ('u', 'µ', '\u03bc')  #: Prefixes of 1e-6: letter u, micro sign, Greek letter.
_LENGTHS: Final = {
    'm': 1.0,
    'mm': 1e-3,
    'cm': 1e-2,
    'in': _INCH,
    'inch': _INCH,
    'inches': _INCH,
    **dict.fromkeys((*(f'{micro}m' for micro in _MICRO), 'micron', 'microns'), 1e-6),
}
_ANGLES: Final = {'rad': 1.0, 'deg': pi / 180.0}

#: Units by role, in SI units.
UNITS: Final[Mapping[str, Mapping[str, float]]] = {
    'time': {
        's': 1.0,
        'sec': 1.0,
        'ms': 1e-3,
        **{f'{micro}s': 1e-6 for micro in _MICRO},
        'ns': 1e-9,
        'min': 60.0,
        'h': 3600.0,
    },
    'depth': _LENGTHS,
    'speed': {
        **{f'{length}/s': size for length, size in _LENGTHS.items()},
        **{f'{length}/min': size / 60.0 for length, size in _LENGTHS.items()},
    },
    'force': {'N': 1.0, 'mN': 1e-3, 'kN': 1e3, 'kgf': 9.80665, 'gf': 9.80665e-3, 'lbf': 4.4482216},
    **dict.fromkeys(('guide_x', 'guide_z', 'tip_x', 'tip_y', 'tip_z'), _LENGTHS),
    **dict.fromkeys(('roll', 'tilt_x', 'tilt_z'), _ANGLES),
}

#: Further units of columns, by SI unit.
_OTHERS: Final = {
    's': UNITS['time'], 'm': _LENGTHS, 'm/s': UNITS['speed'], 'N': UNITS['force'], 'rad': _ANGLES
}  # fmt: skip

ONLY_IN_BRACKETS: Final = ('in', 'h')  #: Units that are usual endings of names.

#: A name with a word in brackets after it.
BRACKETS: Final = re.compile(r'^(.*?)\s*[\[(]([^\])]*)[\])]\s*$')


def unit_of(name: str, role: str) -> str | None:
    return _stated(name, UNITS[role])


def factor_of(name: str, unit: str) -> float:
    """Return the factor of a column to an SI unit, 1 without a unit in its name."""
    known = {**factors(unit), **_OTHERS.get(unit, {})}
    stated = _stated(name, known)
    if stated is None and (foreign := foreign_unit(name)):
        raise ParameterError(
            f'the unit {foreign!r} of the column {name!r} is not one of {", ".join(known)}: '
            'rename the column'
        )
    return known[stated] if stated else 1.0


def _stated(name: str, known: Mapping[str, float]) -> str | None:
    if match := BRACKETS.match(name):
        word = match[2].strip()
    else:
        _, _, word = name.rpartition('_')
        if word in ONLY_IN_BRACKETS:
            return None
    return word if word in known and word != name else None


def foreign_unit(name: str) -> str:
    """Return the word in brackets after a name, except for an index, '' without one."""
    match = BRACKETS.match(name)
    word = match[2].strip() if match else ''
    return '' if re.fullmatch(r'[\d\s,:.-]*', word) else word


def states_unit(name: str, role: str) -> bool:
    """Return whether a name states a unit, also one that is not known."""
    return unit_of(name, role) is not None or foreign_unit(name) != ''
