# SPDX-License-Identifier: Apache-2.0
"""Quantities: text with units, such as ``4mm`` and ``20 s``, targets, axes, and intervals."""

from collections.abc import Mapping
from math import isfinite, pi
import re
from typing import Final

from needle_ros.errors import ParameterError

_LENGTHS: Final = {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3, 'um': 1e-6}

#: Name and example of a quantity, and its accepted units with their factors, by SI unit.
_KINDS: Final[Mapping[str, tuple[str, str, Mapping[str, float]]]] = {
    '1': ('number', '0.001', {'1': 1.0}),
    'm': ('length', '0.05 or 50mm', _LENGTHS),
    's': ('time', '20 or 20s', {'s': 1.0, 'ms': 1e-3, 'us': 1e-6, 'min': 60.0}),
    'N': ('force', '3 or 3N', {'N': 1.0, 'mN': 1e-3}),
    'm/s': ('velocity', '0.005 or 5mm/s', {f'{name}/s': _LENGTHS[name] for name in _LENGTHS}),
    'rad': ('angle', '0.1 or 5deg', {'rad': 1.0, 'deg': pi / 180.0}),
    'm^2': ('area', '1e-6 or 1mm^2', {'m^2': 1.0, 'mm^2': 1e-6}),
    'm^4': ('area moment', '1e-13 or 0.1mm^4', {'m^4': 1.0, 'mm^4': 1e-12}),
    'kg': ('mass', '0.1 or 100g', {'kg': 1.0, 'g': 1e-3}),
    'kg/m^3': ('density', '8000 or 8g/cm^3', {'kg/m^3': 1.0, 'g/cm^3': 1e3}),
    'Pa': ('pressure', '2e11 or 200GPa', {'Pa': 1.0, 'kPa': 1e3, 'MPa': 1e6, 'GPa': 1e9}),
    'N/m^2': ('stiffness', '3e4 or 30kPa', {'N/m^2': 1.0, 'Pa': 1.0, 'kPa': 1e3, 'MPa': 1e6}),
}

#: Example of a quantity by SI unit, as the word for its value in a help text.
EXAMPLES: Final = {unit: example.split()[-1] for unit, (_, example, _) in _KINDS.items()}

#: Help text of a target.
TARGET_HELP: Final = 'x,y,z, where y is the depth, such as 4mm,100mm,-2mm; m without a unit'

AXES: Final = ('x', 'y', 'z')  #: Axes of a frame, in the order of message fields.
#: Orders and signs of two axes, the right one first. In complex numbers, x + i z, they are turns
#: by a multiple of a quarter: alone, then after a reflection.
SIGNED_PAIRS: Final = (
    ('x', 'z'), ('-z', 'x'), ('-x', '-z'), ('z', '-x'),
    ('x', '-z'), ('z', 'x'), ('-x', 'z'), ('-z', '-x'),
)  # fmt: skip

NORMAL: Final = 1.96  #: Half width of a 95 % interval of a normal quantity [standard deviations].

#: Standard deviation of a normal quantity over the median of its absolute deviations.
DEVIATION_OVER_MEDIAN: Final = 1.4826


def factors(unit: str) -> Mapping[str, float]:
    """Return the accepted units of a quantity with their factors to its SI unit."""
    return _KINDS[unit][2] if unit in _KINDS else {unit: 1.0}


def accepted_units(unit: str) -> str:
    """Return the units of text for a quantity in an SI unit, separated by commas."""
    return ', '.join(factors(unit))


def quantity(text: str, unit: str) -> float:
    """Return a number in an SI unit from text with or without a unit, or nan and infinity."""
    kind, example, known = _KINDS.get(unit, ('quantity', f'1.5 or 1.5{unit}', {unit: 1.0}))
    units = '|'.join(re.escape(name) for name in known if name != '1')
    found = re.fullmatch(f'(.*?) *({units})?', text.strip())
    try:
        if found:
            return float(found[1]) * known[found[2] or unit]
    except ValueError:
        pass
    article = 'an' if kind[0] in 'aeiou' else 'a'
    raise ParameterError(f'{text.strip()!r} is not {article} {kind}, such as {example}')


def quantities(text: str, unit: str) -> list[float]:
    """Return the numbers of a list, separated by commas or blanks, as `quantity`."""
    return [quantity(word, unit) for word in re.split(r' *, *| +(?=[-+.\d])', text.strip())]


def point(text: str, requirement: str) -> list[float]:
    """Return three lengths [m] from text; ``requirement`` begins the error of other text."""
    try:
        found = quantities(text, 'm')
    except ParameterError:
        found = []
    if len(found) != len(AXES) or not all(map(isfinite, found)):
        raise ParameterError(f'{requirement}, got {text!r}')
    return found


def target(text: str) -> tuple[float, float, float]:
    """Return x, y, z of a target of the tip [m], from three lengths or from the depth y alone."""
    found = quantities(text, 'm')
    if len(found) == 1:
        found = [0.0, found[0], 0.0]
    if len(found) != 3 or not all(map(isfinite, found)):
        raise ParameterError(f'{text!r} is not a target: {TARGET_HELP}')
    x, y, z = found
    return x, y, z


def signed(text: str) -> tuple[float, str]:
    """Split a name into its sign (1 or -1, from a leading ``-``) and the rest."""
    return (-1.0, text[1:]) if text.startswith('-') else (1.0, text)


def signed_axis(text: str, what: str) -> tuple[float, str]:
    """Split an axis, such as ``-x``, into sign and name; reject names other than x, y, z."""
    sign, axis = signed(text)
    if axis not in AXES:
        raise ParameterError(f'{what} must be x, y, z, -x, -y or -z, got {text!r}')
    return sign, axis
