# SPDX-License-Identifier: Apache-2.0
"""
Arguments of compiled functions: their types from annotations, and boxed values.

At each call Numba converts every number and array of a named tuple: 6 us for fifty. A boxed value
is converted once. This file imports Numba: import it where it is first needed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Final, Generic, get_args, get_origin, get_type_hints, TypeVar

from needle_dynamics.arrays import Shaped
from needle_dynamics.compiled.cache import conversion
import numba
from numba.core import types
from numba.experimental import structref

_Value = TypeVar('_Value')

_SCALARS: Final = {
    bool: types.boolean,
    int: types.int64,
    float: types.float64,
    complex: types.complex128,
}


_tuple_type: Any = types.BaseTuple.from_types  # type: ignore[attr-defined]


@structref.register
class _BoxedType(types.StructRef):  # type: ignore[misc, name-defined]
    def preprocess_fields(self, fields: Any) -> Any:
        """Return the fields with non-literal types."""
        return tuple((name, types.unliteral(kind)) for name, kind in fields)  # type: ignore[attr-defined]


class Boxed(structref.StructRefProxy, Generic[_Value]):  # type: ignore[misc]
    """A value that compiled functions take without conversion; its arrays are not copied."""

    value: _Value  #: named tuple of numbers, arrays and named tuples

    def __new__(cls, value: _Value) -> Boxed[_Value]:
        boxed = _box(value)
        boxed.value = value
        return boxed

    def __reduce__(self) -> tuple[type[Boxed[_Value]], tuple[_Value]]:
        """Pickle the value, which is converted again in the copy."""
        return Boxed, (self.value,)


structref.define_proxy(Boxed, _BoxedType, ['value'])


def boxed_type(value: Any) -> Any:
    """Return Numba's type of `Boxed` for Numba's type of the value."""
    return _BoxedType([('value', value)])


def prepare_box(kind: Any) -> None:
    """Load or compile the conversion to a `Boxed` type; other types need no conversion."""
    if isinstance(kind, _BoxedType):
        _box.dispatcher.compile((kind.field_dict['value'],))  # type: ignore[attr-defined]


@conversion
def _box(value: _Value) -> Boxed[_Value]:
    return Boxed(value)


def argument_types(function: Callable[..., object]) -> tuple[Any, ...]:
    """Return Numba's types of the annotated arguments of a function; TypeError without a type."""
    hints = get_type_hints(function, localns={'Boxed': Boxed}, include_extras=True)
    names = function.__code__.co_varnames[: function.__code__.co_argcount]
    try:
        return tuple(numba_type(hints[name]) for name in names)
    except (KeyError, TypeError) as error:
        raise TypeError(f'{function.__module__}.{function.__qualname__}: {error}') from error


def numba_type(hint: Any) -> Any:
    """Return Numba's type of an annotation; TypeError if it does not determine a type."""
    if hint in _SCALARS:
        return _SCALARS[hint]
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        shaped = hint.__metadata__[0]
        if isinstance(shaped, int):
            return _tuple_type([numba_type(get_args(arguments[0])[0])] * shaped)
        if isinstance(shaped, Shaped):
            kind = numba.from_dtype(shaped.dtype)
            return types.Array(kind, shaped.dimensions, 'C', readonly=not shaped.writable)
    if origin is Boxed:
        return boxed_type(numba_type(arguments[0]))
    if origin is tuple and Ellipsis not in arguments:
        return _tuple_type([numba_type(one) for one in arguments])
    if isinstance(hint, type) and issubclass(hint, tuple) and hasattr(hint, '_fields'):
        fields = get_type_hints(hint, include_extras=True)
        inner = [numba_type(fields[name]) for name in hint._fields]
        return _tuple_type(inner, hint)
    raise TypeError(f'{hint} is not a number, an array with dimensions, or a tuple of these')
