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
from pickle import UnpicklingError
import sys
from typing import Any, cast, TypeVar

_Function = TypeVar('_Function', bound=Callable[..., object])

_FOLDER = Path(__file__).parent


class _Compiled:
    """A function that Numba compiles at its first call; other compiled functions may call it."""

    def __init__(self, function: Callable[..., object], **options: bool) -> None:
        #: The Python source, as Numba's own dispatchers call it.
        self.py_func = function
        update_wrapper(self, function)
        # error_model: divide as C does; every divisor is positive by construction.
        # nogil: batches run in threads.
        self._options = {'error_model': 'numpy', 'nogil': True, **options}

    def __call__(self, *arguments: object) -> object:
        return self.dispatcher(*arguments)

    @cached_property
    def dispatcher(self) -> Any:
        """Numba's dispatcher of the function."""
        import numba

        _listen()
        try:
            kept = numba.njit(cache=True, **self._options)(self.py_func)
            _set_stamp(kept, _stamp(Path(self.py_func.__code__.co_filename).parent))
        except (AttributeError, ImportError, RuntimeError, TypeError):
            # This Numba takes no stamp, or no folder is writable: compile each time rather than
            # run old code.
            return numba.njit(**self._options)(self.py_func)
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


def inlined(function: _Function) -> _Function:
    """
    Do what `compiled` does for a part of a hot loop: its code becomes part of its callers'.

    A call that is not inlined passes every number of its arguments, an array being seven.

    Parameters
    ----------
    function : callable
        As for `compiled`.

    Returns
    -------
    callable
        The compiled function.

    """
    return cast(_Function, _Compiled(function, forceinline=True))


def _set_stamp(dispatcher: Any, stamp: str) -> None:
    """Have the cache of a dispatcher hold for sources with this digest only."""
    from numba.core.caching import IndexDataCacheFile

    class Index(IndexDataCacheFile):  # type: ignore[misc]
        def _load_index(self) -> object:
            try:
                return super()._load_index()
            except (AttributeError, EOFError, ImportError, TypeError, ValueError, UnpicklingError):
                # It names a class that is there no more, or is damaged: all of it is old.
                return {}

    known = dispatcher._cache
    if (
        not isinstance(known._cache_file, IndexDataCacheFile)
        or not known._cache_file._source_stamp
    ):
        raise AttributeError('Numba keeps its cache in another way')
    known._cache_file = Index(known._cache_path, known._impl.filename_base, stamp)


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
