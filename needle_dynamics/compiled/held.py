"""
Arguments that are kept as machine code has them.

At each call Numba converts every number and array of a named tuple: 6 us for fifty. What is held
is converted once. This file imports Numba: import it where it is first needed.
"""

from __future__ import annotations

from typing import Any, Generic, TypeVar

from needle_dynamics.compiled.cache import compiled
from numba.core import types
from numba.experimental import structref

_Value = TypeVar('_Value')


@structref.register
class _HeldType(types.StructRef):  # type: ignore[misc, name-defined]
    """Numba's type of `Held`."""

    def preprocess_fields(self, fields: Any) -> Any:
        """Take the general type of each field."""
        return tuple((name, types.unliteral(kind)) for name, kind in fields)  # type: ignore[attr-defined]


class Held(structref.StructRefProxy, Generic[_Value]):  # type: ignore[misc]
    """
    A value that compiled functions take without converting it.

    Its arrays are those of the value, not copies.

    Parameters
    ----------
    value : tuple
        Named tuple of numbers, arrays and named tuples.

    Attributes
    ----------
    value : tuple
        The value; for compiled functions only.

    """

    value: _Value
    _kept: _Value

    def __new__(cls, value: _Value) -> Held[_Value]:
        """Convert the value."""
        held = _hold(value)
        held._kept = value
        return held

    def __reduce__(self) -> tuple[type[Held[_Value]], tuple[_Value]]:
        """Let a copy, or one from a pickle, hold a copy of the value."""
        return Held, (self._kept,)


structref.define_proxy(Held, _HeldType, ['value'])


def held_type(value: Any) -> Any:
    """
    Return Numba's type of a `Held` value.

    Parameters
    ----------
    value : object
        Numba's type of the value.

    Returns
    -------
    object
        The type.

    """
    return _HeldType([('value', value)])


def prepare_hold(kind: Any) -> None:
    """
    Load or compile the conversion of a value to `Held`.

    Parameters
    ----------
    kind : object
        Numba's type; one that is not of a `Held` value needs no conversion.

    """
    if isinstance(kind, _HeldType):
        _hold.dispatcher.compile((kind.field_dict['value'],))  # type: ignore[attr-defined]


@compiled
def _hold(value: _Value) -> Held[_Value]:
    return Held(value)
