"""
The decorator of every compiled function, and its cache on disk.

Numba renews the machine code that it keeps on disk when the file of a function changes, but not
when the file of a function that it calls does. Here the cache of a function is stamped with all
sources that it may depend on: those of this folder and those of its own folder. A compiled
function must therefore call, and take constants from, files of these two folders only.

Numba is imported at the first call of a compiled function, not before.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, cached_property, update_wrapper
from hashlib import sha256
from pathlib import Path
import sys
from typing import Any, cast, TypeVar

_Function = TypeVar('_Function', bound=Callable[..., object])

_FOLDER = Path(__file__).parent


class _Compiled:
    """A function that Numba compiles at its first call; other compiled functions may call it."""

    def __init__(self, function: Callable[..., object]) -> None:
        #: The Python source, as Numba's own dispatchers call it.
        self.py_func = function
        update_wrapper(self, function)

    def __call__(self, *arguments: object) -> object:
        return self.dispatcher(*arguments)

    @cached_property
    def dispatcher(self) -> Any:
        """Numba's dispatcher of the function."""
        import numba

        # error_model: divide as C does; every divisor is positive by construction.
        # nogil: batches run in threads.
        options = {'error_model': 'numpy', 'nogil': True}
        stamp = _stamp(Path(self.py_func.__code__.co_filename).parent)
        _listen()
        try:
            kept = numba.njit(cache=True, **options)(self.py_func)
            cache_file = kept._cache._cache_file
            if not isinstance(cache_file._source_stamp, (bytes, str, tuple)):
                raise AttributeError('_source_stamp')
        except (AttributeError, RuntimeError):
            # This Numba cannot be given a stamp, or no folder is writable: compile each time
            # rather than run old code.
            return numba.njit(**options)(self.py_func)
        cache_file._source_stamp = stamp
        return kept

    @property
    def _numba_type_(self) -> Any:
        """The type that Numba sees when another compiled function calls this one."""
        from numba import types

        return types.Dispatcher(self.dispatcher)


def compiled(function: _Function) -> _Function:
    """
    Compile a function to machine code at its first call and keep it on disk.

    Parameters
    ----------
    function : callable
        Function in the subset of Python that Numba compiles. It may call compiled functions of
        its own folder and of `needle_dynamics.compiled`.

    Returns
    -------
    callable
        The compiled function; its Python source is the attribute ``py_func``.

    """
    return cast(_Function, _Compiled(function))


@cache
def _stamp(folder: Path) -> str:
    """Return a digest of all sources of this folder and of another one."""
    digest = sha256()
    for place in sorted({_FOLDER, folder}):
        for path in sorted(place.glob('*.py')):
            digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


class _Notice:
    """Tells once, on the terminal, that functions are being compiled."""

    wanted = False
    given = False

    @classmethod
    def give(cls) -> None:
        if cls.wanted and not cls.given:
            cls.given = True
            sys.stderr.write('compiling for this machine (once, about a minute) ...\n')


def announce_compilation() -> None:
    """
    Write one line to standard error when this process first has to compile a function.

    Code that is loaded from disk is not announced. Commands and nodes call this at their start;
    libraries and tests stay silent.
    """
    _Notice.wanted = True


@cache
def _listen() -> None:
    """Have Numba tell about each function that it compiles."""
    from numba.core import event

    class Listener(event.Listener):  # type: ignore[misc]
        def on_start(self, _event: object) -> None:
            _Notice.give()

        def on_end(self, _event: object) -> None:
            pass

    event.register('numba:compile', Listener())
