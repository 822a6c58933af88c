# SPDX-License-Identifier: Apache-2.0
"""
Machine code on disk: one file for each function and signature.

The name of a file contains a digest of all inputs of its machine code: sources, signature,
processor, and versions of Python and Numba. An entry is therefore never outdated, and several
processes, users and machines can share a folder. A file is written under a temporary name and
renamed; a damaged file is ignored. A processor with the instructions of `PORTABLE` also uses
entries for that level, which a wheel contains.

Entries are read from the folder of this package, which may be read-only, and from the cache folder
of the user. New entries are written to the first writable folder of the two.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import errno
import fcntl
from functools import cache
from hashlib import sha256
import os
from pathlib import Path
import pickle
import sys
import tempfile
from threading import local
from time import monotonic, sleep
from typing import Any, Final
import warnings

_FOLDER: Final = Path(__file__).parent

#: Environment variable of Numba with a folder that replaces both.
FOLDER_VARIABLE: Final = 'NUMBA_CACHE_DIR'

#: Suffix of an entry, and of an entry for the processor level `PORTABLE`.
SUFFIX: Final = '.nbc'
PORTABLE_SUFFIX: Final = '.v3.nbc'

#: File whose bytes are locks.
_LOCK: Final = 'needle.lock'

#: Environment of a process that compiles for a processor level, and the features of this level.
PORTABLE: Final = {'NUMBA_CPU_NAME': 'x86-64-v3', 'NUMBA_CPU_FEATURES': '+avx2,+bmi2,+fma'}
_FEATURES: Final = {
    '+avx', '+avx2', '+bmi', '+bmi2', '+cx16', '+f16c', '+fma', '+lzcnt', '+movbe', '+popcnt',
    '+sahf', '+sse4.2', '+xsave',
}  # fmt: skip

#: Longest wait for another process that compiles the same function, and polling period [s].
_LONGEST, _CHECK = 120.0, 0.05

_DIGEST: Final = 32

#: Called with the name of each loaded or compiled function, whether it is loaded, and whether
#: it is inside `preparing`.
LISTENERS: Final[list[Callable[[str, bool, bool], None]]] = []

_PREPARED: Final = local()


def folders() -> tuple[Path, ...]:
    """Return the folders of machine code, in reading order."""
    given = os.environ.get(FOLDER_VARIABLE)
    if given:
        return (Path(given),)
    found = [_FOLDER / '__pycache__']
    try:
        home = os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache'
        found.append(Path(home) / 'needle_insertion')
    except RuntimeError:
        # This user has no home directory.
        pass
    return tuple(found)


@cache
def writable_folder() -> Path | None:
    """Return the first writable folder of `folders`, or None."""
    for folder in folders():
        try:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError:
            continue
        return folder
    return None


def clear() -> int:
    """Delete the machine code in all `folders`; return the number of functions."""
    found = [file for folder in folders() for file in folder.glob(f'*{SUFFIX}')]
    for file in found:
        file.unlink(missing_ok=True)
    for folder in folders():
        (folder / _LOCK).unlink(missing_ok=True)
    return len(found)


@cache
def _stamp(folder: Path) -> str:
    """Return a digest of all sources in this folder and in the given folder."""
    digest = sha256()
    for place in sorted({_FOLDER, folder}):
        for path in sorted(place.glob('*.py')):
            digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


@cache
def _is_portable() -> bool:
    from numba.core.codegen import get_host_cpu_features

    return {*get_host_cpu_features().split(',')} >= _FEATURES


@contextmanager
def preparing() -> Iterator[None]:
    """Mark functions that this thread loads or compiles as prepared."""
    _PREPARED.now = True
    try:
        yield
    finally:
        _PREPARED.now = False


def is_preparing() -> bool:
    """Return whether this thread is inside `preparing`."""
    return getattr(_PREPARED, 'now', False)


class Store:
    """Machine code of one function, with the interface of Numba's caches."""

    def __init__(self, function: Callable[..., object], options: dict[str, Any]) -> None:
        code = function.__code__
        source = Path(code.co_filename)
        self._name = f'{source.stem}.{function.__qualname__}'
        self._stamp = _stamp(source.parent)
        self._fixed = [function.__module__, self._name, self._stamp, sorted(options.items())]

    @property
    def cache_path(self) -> str:
        """Folder of new entries, for Numba's statistics."""
        return str(writable_folder())

    def enable(self) -> None:
        """Do nothing: always enabled, and entries do not become invalid."""

    disable = flush = enable

    def has(self, signature: Any, target_context: Any) -> bool:
        """Return whether a folder contains an entry for a signature on a target."""
        names = self._file_names(signature, target_context.codegen())
        return any((folder / name).is_file() for folder in folders() for name in names)

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Load the machine code for a signature; None if Numba must compile the function."""
        target_context.refresh()
        names = self._file_names(signature, target_context.codegen())
        name = names[0]
        found, folder = self._read(names, signature, target_context), writable_folder()
        if found is None and folder is not None:
            # Another process may be compiling it: wait for the result.
            deadline = monotonic() + _LONGEST
            while not _lock(folder, name) and monotonic() < deadline:
                sleep(_CHECK)
            found = self._read(names, signature, target_context)
            if found is not None:
                _unlock(folder, name)
        for listener in tuple(LISTENERS):
            listener(self._name, found is not None, is_preparing())
        return found

    def save_overload(self, signature: Any, result: Any) -> None:
        """Write machine code for a signature; called by Numba after compilation."""
        folder = writable_folder()
        if folder is None:
            return
        name = self._file_names(signature, result.codegen)[0]
        try:
            if not any(one.can_cache for one in result.lifted) and (
                not result.library.has_dynamic_globals
            ):
                from numba.core.serialize import dumps

                self._write(folder, name, dumps(result._reduce()))
        finally:
            _unlock(folder, name)

    def _file_names(self, signature: Any, codegen: Any) -> list[str]:
        """Return the file names of entries for a signature; the first one is written."""
        from numba import __version__
        from numba.core.sigutils import normalize_signature

        arguments, _ = normalize_signature(signature)
        triple, *target = codegen.magic_tuple()
        portable = [*PORTABLE.values()]
        names = []
        for one in (target, portable) if target != portable and _is_portable() else (target,):
            parts = [*self._fixed, str(arguments), triple, one, __version__, sys.version_info[:2]]
            digest = sha256(repr(parts).encode()).hexdigest()
            suffix = PORTABLE_SUFFIX if one == portable else SUFFIX
            names.append(f'{self._name}-{self._stamp[:8]}-{digest[:24]}{suffix}')
        return names

    @staticmethod
    def _read(names: list[str], signature: Any, target_context: Any) -> Any:
        from numba.core.compiler import CompileResult
        from numba.core.sigutils import normalize_signature

        for path in (folder / name for folder in folders() for name in names):
            try:
                content = path.read_bytes()
            except OSError:
                continue
            data = content[_DIGEST:]
            if sha256(data).digest() != content[:_DIGEST]:
                continue
            result = CompileResult._rebuild(target_context, *pickle.loads(data))  # noqa: S301
            if result.signature.args == normalize_signature(signature)[0]:
                return result
        return None

    def _write(self, folder: Path, name: str, data: bytes) -> None:
        """Write an entry; remove entries of earlier sources from the folder of the package."""
        try:
            handle, draft = tempfile.mkstemp(dir=folder, prefix=name, suffix='.tmp')
            try:
                with os.fdopen(handle, 'wb') as file:
                    file.write(sha256(data).digest() + data)
                # mkstemp creates private files; an installation by root is for every user.
                Path(draft).chmod(0o644)
                Path(draft).replace(folder / name)
            except BaseException:
                Path(draft).unlink(missing_ok=True)
                raise
            if folder == _FOLDER / '__pycache__':
                for old in folder.glob(f'{self._name}-*{SUFFIX}'):
                    if self._stamp[:8] not in old.name:
                        old.unlink(missing_ok=True)
        except OSError as error:
            warnings.warn(f'compiled code cannot be kept in {folder}: {error}', stacklevel=2)


@cache
def _lock_file(folder: Path) -> int:
    """Open the file whose bytes are locks, until the end of the process."""
    return os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)


def _lock(folder: Path, name: str) -> bool:
    """Lock an entry; return False if another process holds the lock."""
    try:
        fcntl.lockf(_lock_file(folder), fcntl.LOCK_EX | fcntl.LOCK_NB, 1, _byte(name))
    except OSError as error:
        # A file system without locks: both processes compile.
        return error.errno not in (errno.EACCES, errno.EAGAIN)
    return True


def _unlock(folder: Path, name: str) -> None:
    try:
        fcntl.lockf(_lock_file(folder), fcntl.LOCK_UN, 1, _byte(name))
    except OSError:
        # The lock ends with the process.
        return


def _byte(name: str) -> int:
    return int.from_bytes(sha256(name.encode()).digest()[:7], 'big')
