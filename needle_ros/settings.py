# SPDX-License-Identifier: Apache-2.0
"""Settings: frozen dataclasses whose fields have a unit, a description and a range."""

from array import array
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import Field, field, fields
from difflib import get_close_matches
from importlib import import_module
from math import inf, isfinite
from numbers import Integral, Real
from pathlib import Path
import sys
from typing import Any, Final, TypeGuard, TypeVar

from needle_ros.errors import ParameterError
from needle_ros.quantities import accepted_units, quantity

_Settings = TypeVar('_Settings')

#: Types of numbers, also of NumPy; the usual ones are found first.
_NUMBERS: Final = (int, float, Real)

_LISTS: Final = (list, array, type(None))  #: Types accepted for a tuple.

LARGEST_SEED: Final = 2**62  #: Integer parameters have 64 bits.

#: Names of the types of fields and parameters.
_NAMES: Final = {
    bool: 'true or false', str: 'text', list: 'a list of text', tuple: 'a list of numbers',
    int: 'a number', float: 'a number',
}  # fmt: skip


def constant(
    default: float | tuple[float, ...],
    unit: str,
    description: str,
    *,
    low: float = 0.0,
    high: float = inf,
    open_low: bool = False,
    unlimited: bool = False,
    whole: bool = False,
) -> Any:
    """
    Declare a numeric dataclass field with unit, description and valid range.

    The unit is an SI unit, ``1`` for a pure number. A tuple as default declares an array field,
    whose elements have the range. `open_low` excludes ``low`` itself. With `unlimited` infinity is
    valid, with `whole` only whole numbers are.
    """
    meta = {'low': low, 'high': high, 'open_low': open_low, 'unlimited': unlimited, 'whole': whole}
    return field(default=default, metadata={'unit': unit, 'description': description, **meta})


def positive(default: float, unit: str, description: str, *, high: float = inf) -> Any:
    """Declare a numeric dataclass field that must be above zero; see `constant`."""
    return constant(default, unit, description, high=high, open_low=True)


def choice(default: str, valid: Iterable[str], meaning: str = '') -> Any:
    """Declare a dataclass field with one of the `valid` words, which its description lists."""
    # A mapping by word may get more words later.
    words = valid if isinstance(valid, Mapping) else tuple(valid)
    description = f'one of {", ".join(words)}' + (meaning and f': {meaning}')
    return field(default=default, metadata={'valid': words, 'description': description})


def flag(default: bool, description: str) -> Any:
    """Declare a dataclass field that is true or false."""
    return field(default=default, metadata={'type': bool, 'description': description})


def text(default: str, description: str) -> Any:
    """Declare a dataclass field with any text."""
    return field(default=default, metadata={'type': str, 'description': description})


def same_field(settings: type, name: str) -> Any:
    """Declare a field with the default and the range of a field of other settings."""
    of_other = settings.__dataclass_fields__[name]  # type: ignore[attr-defined]
    return field(default=of_other.default, metadata=of_other.metadata)


def check_constants(values: object) -> None:
    """Check every field of a dataclass that is declared here; numbers of an array are a tuple."""
    for item in fields(values):  # type: ignore[arg-type]
        value, meta = getattr(values, item.name), item.metadata
        if 'unit' in meta:
            several = isinstance(item.default, tuple)
            if not several or (_may_be_single(item) and isinstance(value, _NUMBERS)):
                _check_number(item.name, value, meta)
                if not isinstance(value, (int, float)):
                    plain = int(value) if isinstance(value, Integral) else float(value)
                    object.__setattr__(values, item.name, plain)
                continue
            listed = _listed(item.name, value)
            for number in listed:
                _check_number(item.name, number, meta)
            object.__setattr__(values, item.name, tuple(map(float, listed)))
        elif 'valid' in meta:
            check_choice(item.name, value, meta['valid'])
        elif 'type' in meta and not isinstance(value, meta['type']):
            raise ParameterError(f'{item.name} must be {_NAMES[meta["type"]]}, got {value!r}')


def number_fields(settings: Any) -> dict[str, Field[Any]]:
    """Return the fields of a dataclass that are one number, by name."""
    return {
        item.name: item
        for item in fields(settings)
        if 'unit' in item.metadata and not isinstance(item.default, tuple)
    }


def _may_be_single(item: Field[Any]) -> bool:
    return 'float |' in str(item.type)


def _listed(name: str, value: Any) -> Sequence[Any]:
    # Also of an array.
    found = value.tolist() if hasattr(value, 'tolist') else value
    if not isinstance(found, (tuple, list)):
        raise ParameterError(f'{name} must be a list of numbers, got {value!r}')
    return found


class CheckedSettings:
    """Base of dataclasses whose fields are checked by `check_constants`."""

    __slots__ = ()

    def __post_init__(self) -> None:
        check_constants(self)


def find_class(what: str, name: Any, known: Mapping[str, str]) -> Any:
    """
    Return a class from its address ``module:Class``, or from a name of `known` with its address.

    The module may be a file of the current folder.

    Raises `ParameterError` for an unknown name and for a failed import; ``what`` is its subject.
    """
    valid = f'{what} must be one of {", ".join(known)}, or module:Class'
    address = known.get(name, name) if isinstance(name, str) else ''
    module, _, of_class = address.partition(':')
    if not module or not of_class:
        raise ParameterError(f'{valid}, got {name!r}')
    try:
        if name not in known and (folder := str(Path.cwd())) not in sys.path:
            # Last: a file of the user hides no installed module.
            sys.path.append(folder)
        return getattr(import_module(module), of_class)
    # The module is any code of the user.
    except (Exception, SystemExit) as error:
        raise ParameterError(f'{valid}; {name!r} cannot be imported: {error}') from error


def check_choice(name: str, value: object, valid: Collection[str]) -> None:
    """Raise `ParameterError` if a value is not one of the valid words."""
    if not isinstance(value, str) or value not in valid:
        raise ParameterError(f'{name} must be one of {", ".join(valid)}, got {value!r}')


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a value is a finite real number, also of NumPy; a Boolean is not one."""
    if isinstance(value, bool) or not isinstance(value, _NUMBERS):
        return False
    try:
        return isfinite(value)
    # An integer of too many digits.
    except OverflowError:
        return False


def is_whole(value: object) -> TypeGuard[int]:
    """Return whether a value is an integer, also of NumPy; a Boolean is not one."""
    return isinstance(value, (int, Integral)) and not isinstance(value, bool)


def check_whole(name: str, value: object, low: int, high: int) -> None:
    """Raise `ParameterError` if a value is not an integer in a range."""
    if not (is_whole(value) and low <= value <= high):
        raise ParameterError(f'{name} must be an integer from {low} to {high}, got {value!r}')


def checked(
    name: str,
    value: object,
    unit: str = '1',
    *,
    low: float = -inf,
    high: float = inf,
    open_low: bool = False,
    unlimited: bool = False,
) -> float:
    """Return a number as a float; raise `ParameterError` outside its range, as of `constant`."""
    if isinstance(value, bool) or not isinstance(value, _NUMBERS):
        raise ParameterError(f'{name} must be a number, got {value!r}')
    if isinstance(value, int) and not is_number(value):
        raise ParameterError(f'{name} must be finite, got an integer of too many digits')
    value = value if isinstance(value, (int, float)) else float(value)
    infinite = not isfinite(value) and not (unlimited and value == inf)
    if infinite or (value <= low if open_low else value < low) or value > high:
        lower = f'{">" if open_low else ">="} {low:g}' if isfinite(low) else ''
        upper = f'<= {high:g}' if isfinite(high) else ''
        limits = ' and '.join(filter(None, (lower, upper)))
        rule = ', '.join(filter(None, ('' if unlimited else 'finite', limits)))
        of = '' if unit == '1' or not limits else f' {unit}'
        raise ParameterError(f'{name} must be {rule}{of}, got {value!r}')
    return float(value)


def _check_number(name: str, value: object, meta: Mapping[str, Any]) -> None:
    limits = {key: meta[key] for key in ('low', 'high', 'open_low', 'unlimited')}
    number = checked(name, value, meta['unit'], **limits)
    if meta['whole'] and number != int(number):
        of = '' if meta['unit'] == '1' else f' of {meta["unit"]}'
        raise ParameterError(f'{name} must be a whole number{of}, got {value!r}')


def constraints(meta: Mapping[str, Any], default: object) -> str:
    """Describe the valid values of a parameter beyond its range, from metadata and default."""
    if 'valid' in meta:
        return f'one of {", ".join(meta["valid"])}'
    if 'low' not in meta:
        return _NAMES[type(default)]
    whole = 'a whole number' if meta['whole'] else ''
    limit = f'greater than {meta["low"]:g}' if meta['open_low'] else ''
    return ', '.join(filter(None, (whole, limit, '.inf for no limit' * meta['unlimited'])))


def from_values(
    kind: Callable[..., _Settings], values: Mapping[str, Any], prefix: str = ''
) -> _Settings:
    """
    Construct settings from values by field name; errors name the field with ``prefix``.

    Integers and text with a unit are accepted for floats, lists, arrays and single numbers for
    tuples. None means an empty tuple: rcl returns an empty list of a parameter file as None.
    """
    known = {item.name: item for item in fields(kind)}  # type: ignore[arg-type]
    given = {}
    for name, value in values.items():
        if name not in known:
            names = (f'{prefix}{item}' for item in known)
            raise ParameterError(unknown_name(f'{prefix}{name}', names))
        item = known[name]
        several = isinstance(item.default, tuple)
        taken = tuple(value or ()) if several and isinstance(value, _LISTS) else value
        if 'unit' in item.metadata:
            taken = _as_number(f'{prefix}{name}', taken, item.metadata['unit'])
            only_tuple = several and not _may_be_single(item)
            taken = (taken,) if only_tuple and isinstance(taken, float) else taken
        given[name] = taken
    try:
        return kind(**given)
    except ParameterError as error:
        # A message about several fields does not begin with one.
        of_one = not prefix or str(error).partition(' ')[0] in known
        begin = prefix if of_one else f'{prefix.removesuffix(".")}: '
        raise ParameterError(f'{begin}{error}') from error


def _as_number(name: str, value: Any, unit: str) -> Any:
    """Convert integers and text with a unit to float, also in a tuple; keep other values."""
    if isinstance(value, tuple):
        return tuple(_as_number(name, number, unit) for number in value)
    # Also 1e-3, which PyYAML reads as text.
    if isinstance(value, str) and any(map(str.isalpha, value)):
        try:
            return quantity(value, unit)
        except ParameterError as error:
            units = f', or text with a unit of {accepted_units(unit)}' if unit != '1' else ''
            raise ParameterError(f'{name} must be a number{units}, got {value!r}') from error
    return float(value) if is_number(value) else value


def unknown_name(name: str, valid: Iterable[str]) -> str:
    """Return the error message for an unknown parameter, with the nearest valid name."""
    names = sorted(valid)
    close = get_close_matches(name, names, n=1)
    hint = f'did you mean {close[0]!r}?' if close else f'valid: {", ".join(names) or "none"}'
    return f'unknown parameter {name!r}; {hint}'
