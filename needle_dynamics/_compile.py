"""The one place that knows the compiler: `compiled` is Numba's `njit`, typed and cached."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast, TypeVar

import numba

_Function = TypeVar('_Function', bound=Callable[..., object])


def compiled(function: _Function) -> _Function:
    """Compile a function to machine code at its first call and keep it on disk."""
    # error_model: divide as C does; every divisor below is positive by construction.
    return cast(_Function, numba.njit(cache=True, error_model='numpy')(function))
