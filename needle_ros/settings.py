"""Settings: fields of frozen dataclasses with unit, meaning and range, checked when made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, fields
from difflib import get_close_matches
from math import inf, isfinite
from typing import Any, Final

from needle_ros.errors import ParameterError

#: Integers beyond it are no floats.
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
    Refuse a numeric field that is not finite or is outside its declared range.

    Parameters
    ----------
    values : object
        A dataclass instance whose numeric fields were made by `constant`.

    Raises
    ------
    ParameterError
        Naming the field, the value found, and the valid range with its unit.

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


def as_number(value: Any) -> Any:
    """Take an integer where a float is meant, in a tuple too; leave all else as it is."""
    if isinstance(value, tuple):
        return tuple(as_number(number) for number in value)
    is_integer = isinstance(value, int) and not isinstance(value, bool)
    return float(value) if is_integer and abs(value) <= _LARGEST_INTEGER else value


def unknown_name(name: str, valid: list[str]) -> str:
    """Say that a name is unknown, with the nearest valid one or all of them."""
    close = get_close_matches(name, valid, n=1)
    hint = f'did you mean {close[0]!r}?' if close else f'valid: {", ".join(sorted(valid))}'
    return f'unknown parameter {name!r}; {hint}'
