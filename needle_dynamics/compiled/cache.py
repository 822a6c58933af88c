# SPDX-License-Identifier: Apache-2.0
"""
Decorators of compiled functions, and their preparation before the first call.

A `kernel` is called from Python and compiled for the types of its annotations; `compiled` is for
functions that only compiled functions call, and `inlined` for parts of a hot loop. `prepare`
loads or compiles kernels in advance.

A compiled function must call, and take constants from, files of its own folder and of this folder
only: the machine code on disk is valid for their sources (`store`).

Numba is imported when the first function is prepared or called, not before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cached_property, update_wrapper
from importlib import import_module
import sys
from typing import Any, cast, Final, TypeVar

from needle_dynamics.compiled.store import (
    FOLDER_VARIABLE,
    folders,
    is_preparing,
    LISTENERS,
    preparing,
    Store,
    writable_folder,
)

_Function = TypeVar('_Function', bound=Callable[..., object])

#: Kernels by the module that defines them, and by name.
_KERNELS: Final[dict[str, dict[str, _Compiled]]] = {}


class _Compiled:
    """A function compiled by Numba at its first call and callable from compiled functions."""

    def __init__(self, function: Callable[..., object], **options: bool) -> None:
        #: The Python source, as Numba's own dispatchers call it.
        self.py_func = function
        update_wrapper(self, function)
        # error_model: divide as C does; every divisor is positive by construction.
        # nogil: batches run in threads. no_cfunc_wrapper: C never calls them.
        self._options = {
            'error_model': 'numpy',
            'nogil': True,
            'no_cfunc_wrapper': True,
            **options,
        }

    def __call__(self, *arguments: object) -> object:
        return self._called(*arguments)

    @cached_property
    def _called(self) -> Any:
        """The function that Python calls; without a Python wrapper, a compiled caller of it."""
        import numba

        if 'no_cpython_wrapper' not in self._options:
            return self.dispatcher
        callee = self.dispatcher

        def call(*arguments: Any) -> Any:
            return callee(*arguments)

        return numba.njit(call)

    @cached_property
    def dispatcher(self) -> Any:
        import numba

        made = numba.njit(**self._options)(self.py_func)
        made._cache = Store(self.py_func, self._options)
        return made

    @property
    def _numba_type_(self) -> Any:
        """Numba's type of this function as a callee of compiled functions."""
        from numba import types

        return types.Dispatcher(self.dispatcher)

    @property
    def is_kept(self) -> bool:
        """Whether the machine code for the annotated types is on disk."""
        from needle_dynamics.compiled.boxed import argument_types
        from numba.core.registry import cpu_target

        target = cpu_target.target_context
        return bool(self.dispatcher._cache.has(argument_types(self.py_func), target))

    def prepare(self) -> None:
        """Load or compile the function for the annotated types."""
        from needle_dynamics.compiled.boxed import argument_types, prepare_box

        found = argument_types(self.py_func)
        for one in found:
            prepare_box(one)
        self.dispatcher.compile(found)


def kernel(function: _Function) -> _Function:
    """
    Compile a function that is called from Python; ``py_func`` is its source.

    It may call functions of its folder and of `needle_dynamics.compiled`. `prepare` compiles it
    for the types of its annotations.
    """
    return _kernel(function)


def inlined_kernel(function: _Function) -> _Function:
    """Compile a `kernel` that is also part of a hot loop, as `inlined`."""
    return _kernel(function, forceinline=True)


def _kernel(function: _Function, **options: bool) -> _Function:
    made = _Compiled(function, **options)
    _KERNELS.setdefault(function.__module__, {})[function.__name__] = made
    return cast(_Function, made)


def compiled(function: _Function) -> _Function:
    """Compile a function that only compiled functions call, for any argument types."""
    return cast(_Function, _Compiled(function, no_cpython_wrapper=True))


def conversion(function: _Function) -> _Function:
    """Compile a function that Python calls for any argument types; the caller prepares them."""
    return cast(_Function, _Compiled(function))


def inlined(function: _Function) -> _Function:
    """Compile a part of a hot loop into its callers: a call would pass each number of an array."""
    return cast(_Function, _Compiled(function, forceinline=True, no_cpython_wrapper=True))


# Preparation.


def kernels(names: Iterable[str]) -> list[str]:
    """List the kernels, as ``module:kernel``, of modules (which are imported) or given by name."""
    found = []
    for name in names:
        module, _, own = name.partition(':')
        import_module(module)
        found += [f'{module}:{own}'] if own else [f'{module}:{one}' for one in _KERNELS[module]]
    return list(dict.fromkeys(found))


def is_kept(name: str) -> bool:
    """Return whether the machine code of a kernel (``module:kernel``) is on disk."""
    module, _, own = name.partition(':')
    return _KERNELS[module][own].is_kept


def prepare(names: Iterable[str]) -> Iterator[tuple[int, int, str]]:
    """Load or compile kernels, one a step; yield numbers ready and in total, and the next name."""
    found = kernels(names)
    for done, name in enumerate(found):
        module, _, own = name.partition(':')
        yield done, len(found), own
        with preparing():
            _KERNELS[module][own].prepare()
    yield len(found), len(found), ''


def where_kept() -> str:
    """Return the folder of machine code as text, or a message with the unwritable folders."""
    folder = writable_folder()
    if folder is not None:
        return str(folder)
    tried = ', '.join(map(str, folders()))
    return (
        f'no writable folder for machine code (tried {tried}): it is compiled at each start; set '
        f'{FOLDER_VARIABLE}'
    )


# Compilation reports.


@contextmanager
def reports(listener: Callable[[str, bool, bool], None]) -> Iterator[None]:
    """
    Call the listener with each function of this process, before compilation or after loading.

    It takes name, whether loaded from disk, and whether by `prepare`, in the compiling thread.
    """
    LISTENERS.append(listener)
    try:
        yield
    finally:
        LISTENERS.remove(listener)


def other_compilations(
    listener: Callable[[str, bool, bool], None],
) -> AbstractContextManager[object]:
    """Call the listener, as `reports` does, before Numba compiles a function that is no kernel."""
    from numba.core.event import Event, install_listener, Listener

    class Compilations(Listener):  # type: ignore[misc]
        def on_start(self, event: Event) -> None:
            dispatcher = event.data['dispatcher']
            if not isinstance(dispatcher._cache, Store):
                listener(dispatcher.py_func.__qualname__, False, is_preparing())

        def on_end(self, event: Event) -> None:
            pass

    listening: AbstractContextManager[object] = install_listener('numba:compile', Compilations())
    return listening


def announce_compilation() -> None:
    """Write one line to standard error when this process, not a worker, first compiles."""
    from multiprocessing import parent_process

    if parent_process() is not None:
        return

    def report(_name: str, loaded: bool, _prepared: bool) -> None:
        if not loaded:
            LISTENERS.remove(report)
            often = 'once' if writable_folder() else where_kept()
            sys.stderr.write(f'compiling for this machine ({often}) ...\n')

    LISTENERS.append(report)
