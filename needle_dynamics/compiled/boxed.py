# SPDX-License-Identifier: Apache-2.0
"""
Arguments in the representation of machine code.

At each call Numba converts every number and array of a named tuple: 6 us for fifty. A boxed value
is converted once. This file imports Numba: import it where it is first needed.
"""

from __future__ import annotations

from typing import Any, Generic, TypeVar

from needle_dynamics.compiled.cache import conversion
from numba.core import types
from numba.experimental import structref

_Value = TypeVar('_Value')


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
