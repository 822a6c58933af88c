"""Settings: frozen dataclasses whose fields have a unit, a meaning and a range."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Mapping
from dataclasses import field, fields
from difflib import get_close_matches
from math import inf, isfinite
from typing import Any, Final, TypeVar

from needle_ros.errors import ParameterError

_Settings = TypeVar('_Settings')

#: What may stand for a tuple.
_LISTS: Final = (list, array, type(None))

#: Larger integers cannot be converted to float.
_LARGEST_INTEGER: Final = 10**300


def constant(
    default: float | tuple[float, ...],
    unit: str,
    description: str,
    *,
    low: float = 0.0,
    high: float = inf,
    open_low: bool = False,
) -> Any:
    """
    Declare a numeric field with its unit, meaning and valid range.

    Parameters
    ----------
    default : float or tuple of float
        Default value [``unit``]; a tuple makes it a field of several numbers, each in the range.
    unit : str
        SI unit as people write it, ``1`` for a pure number.
    description : str
        What the number is; becomes the description of the ROS parameter.
    low, high : float
        Valid range.
    open_low : bool
        True if ``low`` itself is not valid.

    Returns
    -------
    Any
        A dataclass field.

    """
    return field(
        default=default,
        metadata={
            'unit': unit,
            'description': description,
            'low': low,
            'high': high,
            'open_low': open_low,
        },
    )


def check_constants(values: object) -> None:
    """
    Check that every numeric field is finite and in its declared range.

    Parameters
    ----------
    values : object
        A dataclass instance whose numeric fields were made by `constant`.

    Raises
    ------
    ParameterError
        If one is not; the message names the field, the value and the valid range with its unit.

    """
    for item in fields(values):  # type: ignore[arg-type]
        if 'unit' not in item.metadata:
            continue
        value = getattr(values, item.name)
        several = isinstance(item.default, tuple) and isinstance(value, tuple)
        for number in value if several else (value,):
            _check_number(item.name, number, item.metadata)


def _check_number(name: str, value: object, meta: Mapping[str, Any]) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ParameterError(f'{name} must be a number, got {value!r}')
    if isinstance(value, int) and abs(value) > _LARGEST_INTEGER:
        raise ParameterError(f'{name} must be finite, got an integer of too many digits')
    too_low = value <= meta['low'] if meta['open_low'] else value < meta['low']
    if not isfinite(value) or too_low or value > meta['high']:
        sign = '>' if meta['open_low'] else '>='
        upper = f' and <= {meta["high"]:g}' if isfinite(meta['high']) else ''
        raise ParameterError(
            f'{name} must be finite, {sign} {meta["low"]:g}{upper}'
            f'{" " + meta["unit"] if meta["unit"] != "1" else ""}, got {value!r}'
        )


def from_values(
    kind: Callable[..., _Settings], values: Mapping[str, Any], prefix: str = ''
) -> _Settings:
    """
    Make settings from values by name.

    Parameters
    ----------
    kind : type
        The dataclass.
    values : Mapping[str, Any]
        Values by field name; integers are accepted where a float is meant, lists and arrays where
        a tuple is meant. None stands for an empty tuple: so an empty list in a parameter file
        arrives.
    prefix : str
        Namespace of the names in messages, such as ``model.``.

    Returns
    -------
    object
        The dataclass instance.

    Raises
    ------
    ParameterError
        If a name is unknown or a value is not valid; the message names the field.

    """
    known = {item.name: item for item in fields(kind)}  # type: ignore[arg-type]
    given = {}
    for name, value in values.items():
        if name not in known:
            raise ParameterError(
                unknown_name(f'{prefix}{name}', (f'{prefix}{item}' for item in known))
            )
        several = isinstance(known[name].default, tuple)
        taken = tuple(value or ()) if several and isinstance(value, _LISTS) else value
        given[name] = _as_number(taken) if 'unit' in known[name].metadata else taken
    try:
        return kind(**given)
    except ParameterError as error:
        raise ParameterError(f'{prefix}{error}') from error


def _as_number(value: Any) -> Any:
    """Convert integers to float, also within a tuple; other values stay as they are."""
    if isinstance(value, tuple):
        return tuple(_as_number(number) for number in value)
    is_integer = isinstance(value, int) and not isinstance(value, bool)
    return float(value) if is_integer and abs(value) <= _LARGEST_INTEGER else value


def unknown_name(name: str, valid: Iterable[str]) -> str:
    """
    Return the message for an unknown parameter.

    Parameters
    ----------
    name : str
        Its name.
    valid : iterable of str
        Valid names.

    Returns
    -------
    str
        The message, with the nearest valid name, or all of them if none is near.

    """
    names = sorted(valid)
    close = get_close_matches(name, names, n=1)
    hint = f'did you mean {close[0]!r}?' if close else f'valid: {", ".join(names)}'
    return f'unknown parameter {name!r}; {hint}'
