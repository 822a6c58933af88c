# SPDX-License-Identifier: Apache-2.0
"""Call of a friction law that a user has compiled, by its address."""

from collections.abc import Callable
from typing import Any, cast, Final


class _Call:
    """Call of a C function, for compiled functions; Numba is imported at the first compilation."""

    _type: Any = None

    @property
    def _numba_type_(self) -> Any:
        self._type = self._type or _call_type()
        return self._type


def _call_type() -> Any:
    from numba import types
    from numba.core.cgutils import ir
    from numba.core.registry import cpu_target
    from numba.extending import intrinsic

    def call(_context: Any, _address: Any, _coulomb: Any, _speed: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            number = ir.DoubleType()
            law = ir.FunctionType(number, [number, number]).as_pointer()
            return builder.call(builder.inttoptr(arguments[0], law), arguments[1:])

        return types.float64(types.int64, types.float64, types.float64), generate

    made = intrinsic(call)
    cpu_target.typing_context.refresh()
    return cpu_target.typing_context.resolve_value_type(made)


#: Dry friction [N] of the law at an address, from Coulomb friction [N] and speed [m/s].
own_level: Final = cast(Callable[[int, float, float], float], _Call())
