"""
A study, computed on any executor: nothing twice, and nothing lost when it is broken off.

Chunks of samples are written as they come, each whole or not at all, in a folder of parts. What is
there is not computed again. When all are there they become one table, in the order of the samples,
whose bytes depend neither on the chunks nor on the number of workers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import CancelledError, Executor, FIRST_COMPLETED, Future, wait
from contextlib import AbstractContextManager, contextmanager, ExitStack, suppress
import fcntl
from functools import lru_cache
from importlib.metadata import version
import json
import os
from pathlib import Path
import re
import shutil
from time import monotonic
from typing import Any, Final

from needle_dynamics import FloatArray
from needle_insertion.study.study import made, Study
from needle_ros.errors import JobError, ParameterError
from needle_ros.files import write_whole
import pyarrow as pa
from pyarrow import parquet

#: Samples of the first chunk, by whose time the others are sized, and that time [s].
_FIRST, _WANTED = 16, 1.0
_LARGEST: Final = 2**13

#: Rows of the table that are written at once: its bytes depend on it.
_GROUP: Final = 2**13

# The other pools keep what they are given back.
pa.set_memory_pool(pa.system_memory_pool())

_PART: Final = re.compile(r'(\d{10})-(\d{10})\.parquet')

#: Packages on whose versions the bits of a sample depend.
_PACKAGES: Final = ('needle_insertion', 'numba', 'numpy', 'scipy')

TABLE: Final = 'samples.parquet'
STUDY: Final = 'study.json'


def order(study: Study) -> str:
    """
    Return what a worker must know.

    Parameters
    ----------
    study : Study
        The study.

    Returns
    -------
    str
        The study, and the versions by which it is computed.

    """
    return json.dumps(
        {'study': study.document, 'versions': _versions()}, sort_keys=True, default=str
    )


def _versions() -> dict[str, str]:
    return {name: version(name) for name in _PACKAGES}


def _check_versions(wanted: Mapping[str, str], what: str) -> None:
    here = _versions()
    if here != wanted:
        words = ' and '.join(
            ', '.join(f'{name} {given[name]}' for name in _PACKAGES if here[name] != wanted[name])
            for given in (here, wanted)
        )
        raise JobError(f'{what} has another version: {words}; the bits of a sample depend on it')


@lru_cache(maxsize=1)
def _study(text: str) -> Study:
    given = json.loads(text)
    _check_versions(given['versions'], 'a worker')
    return made(given['study'])


def chunk(text: str, first: int, count: int) -> tuple[float, dict[str, FloatArray]]:
    """
    Compute a chunk, in whatever process.

    Parameters
    ----------
    text : str
        Of `order`.
    first, count : int
        As in `Study.rows`.

    Returns
    -------
    taken : float
        Time that it took [s].
    columns : dict of str to ndarray
        The columns.

    Raises
    ------
    JobError
        If this process has other versions than the one that gives the order.

    """
    study = _study(text)
    begin = monotonic()
    columns = study.rows(first, count)
    return monotonic() - begin, columns


class Results:
    """
    The folder of a study.

    Parameters
    ----------
    folder : Path
        May exist with the same study, which then goes on.
    study : Study
        The study.

    Raises
    ------
    ParameterError
        If there is another study in it, or anything else.
    JobError
        If its table is damaged.

    """

    def __init__(self, folder: Path, study: Study) -> None:
        self.folder, self.study = folder, study
        self._parts = folder / 'parts'
        self._file = folder / STUDY
        if self._file.is_file():
            if self._begun()['study'] != json.loads(order(study))['study']:
                raise ParameterError(f'{folder} is of another study; name another folder')
        # One that was killed at the begin leaves a draft, or nothing.
        elif folder.exists() and any(path.suffix != '.tmp' for path in folder.iterdir()):
            raise ParameterError(f'{folder} exists and is not of a study; name another folder')
        else:
            folder.mkdir(parents=True, exist_ok=True)
            write_whole(self._file, order(study).encode())
        if self.table.exists():
            if _rows(self.table) != study.samples:
                raise JobError(f'{self.table} is damaged; remove it, and it is computed again')
            self._clear()
        else:
            self._parts.mkdir(exist_ok=True)

    def _begun(self) -> dict[str, Any]:
        """Return the study that was begun, and by which versions."""
        try:
            given = json.loads(self._file.read_bytes())
            return {name: given[name] for name in ('study', 'versions')}
        except (ValueError, TypeError, KeyError) as error:
            raise ParameterError(f'{self._file} is not of a study; name another folder') from error

    @contextmanager
    def alone(self) -> Iterator[None]:
        """
        Keep other processes from computing here, and remove parts that are damaged.

        Raises
        ------
        JobError
            If another one does, or the study was begun by other versions.

        """
        _check_versions(self._begun()['versions'], f'the study in {self.folder}')
        self._parts.mkdir(exist_ok=True)
        with (self._parts / 'lock').open('w') as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise JobError(f'another process computes {self.folder}') from error
            end = 0
            for first, after in [] if self.table.exists() else self._done():
                if first < end or _rows(self._part(first, after)) != after - first:
                    self._part(first, after).unlink()
                else:
                    end = after
            yield

    @property
    def table(self) -> Path:
        """The table of all samples."""
        return self.folder / TABLE

    def missing(self) -> list[tuple[int, int]]:
        """Return the samples that are still to be computed, as ranges of first and last + 1."""
        begin, gaps = 0, list[tuple[int, int]]()
        if self.table.exists():
            return gaps
        for first, end in self._done():
            if first > begin:
                gaps.append((begin, first))
            begin = max(begin, end)
        if begin < self.study.samples:
            gaps.append((begin, self.study.samples))
        return gaps

    def _done(self) -> list[tuple[int, int]]:
        found = (_PART.fullmatch(path.name) for path in self._parts.iterdir())
        return sorted((int(one[1]), int(one[2])) for one in found if one)

    def add(self, first: int, columns: Mapping[str, FloatArray]) -> int:
        """
        Write a chunk.

        Parameters
        ----------
        first : int
            Number of its first sample.
        columns : dict of str to ndarray
            The columns.

        Returns
        -------
        int
            Number of its samples.

        """
        count = len(columns['sample'])
        self._write(self._part(first, first + count), [pa.table(dict(columns))])
        return count

    def complete(self) -> None:
        """Make one table of all parts, and remove them."""
        if not self.table.exists():
            self._write(self.table, self._groups())
        self._clear()

    def _clear(self) -> None:
        """Remove the parts: all of it is in the table."""
        shutil.rmtree(self._parts, ignore_errors=True)
        self.table.with_suffix('.tmp').unlink(missing_ok=True)

    def _groups(self) -> Iterator[Any]:
        """Yield all samples in tables of the same number of rows."""
        waiting: list[Any] = []
        for first, end in self._done():
            waiting.append(parquet.read_table(self._part(first, end), use_threads=False))
            while sum(map(len, waiting)) >= _GROUP:
                whole = pa.concat_tables(waiting)
                yield whole.slice(0, _GROUP)
                waiting = [whole.slice(_GROUP)]
        if sum(map(len, waiting)):
            yield pa.concat_tables(waiting)

    def _part(self, first: int, end: int) -> Path:
        return self._parts / f'{first:010d}-{end:010d}.parquet'

    @staticmethod
    def _write(path: Path, tables: Iterable[Any]) -> None:
        """Write a file that is there whole or not at all."""
        draft = path.with_suffix('.tmp')
        try:
            with ExitStack() as stack:
                writer = None
                for one in tables:
                    if writer is None:
                        writer = stack.enter_context(
                            parquet.ParquetWriter(
                                draft, one.schema, compression='zstd', use_dictionary=False
                            )
                        )
                    writer.write_table(one.combine_chunks(), row_group_size=_GROUP)
            if path.name == TABLE:
                # The parts are removed then. A part that is lost is computed again.
                with draft.open('rb') as file:
                    os.fsync(file.fileno())
            draft.replace(path)
        except OSError as error:
            with suppress(OSError):
                draft.unlink()
            raise JobError(f'{path} cannot be written: {error.strerror or error}') from error


def compute(
    results: Results,
    executor: Callable[[], AbstractContextManager[Executor]],
    workers: int,
    progress: Callable[[int], object],
) -> None:
    """
    Compute the missing samples.

    Parameters
    ----------
    results : Results
        Folder of the study.
    executor : callable
        Returns a context with the executor of the chunks. The executor replaces lost workers.
    workers : int
        Number of workers.
    progress : callable
        Called with the number of samples of each chunk that is written.

    Raises
    ------
    JobError
        If a sample cannot be computed or written.

    """
    with results.alone():
        if todo := results.missing():
            with executor() as running:
                _compute(results, running, workers, todo, progress)
        results.complete()


def _compute(
    results: Results,
    executor: Executor,
    workers: int,
    todo: list[tuple[int, int]],
    written: Callable[[int], object],
) -> None:
    text, size = order(results.study), _FIRST
    running: dict[Future[tuple[float, dict[str, FloatArray]]], int] = {}
    try:
        while todo or running:
            while todo and len(running) < 2 * workers:
                # Small ones at the end: no worker shall wait for another one's last.
                left = sum(end - first for first, end in todo)
                first, end = todo.pop(0)
                count = min(size, end - first, max(_FIRST, left // (2 * workers)))
                running[executor.submit(chunk, text, first, count)] = first
                if first + count < end:
                    todo.insert(0, (first + count, end))
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                first = running.pop(future)
                taken, columns = future.result()
                count = results.add(first, columns)
                written(count)
                # The first one compiles, or loads what was compiled.
                size = min(max(1, round(count * _WANTED / max(taken, 1e-6))), 4 * size, _LARGEST)
    finally:
        for future in running:
            future.cancel()


@contextmanager
def dask(client: Any) -> Iterator[Executor]:
    """
    Make an executor of a Dask cluster.

    Parameters
    ----------
    client : distributed.Client
        Its client.

    Yields
    ------
    Executor
        The cluster remains when the context ends.

    Raises
    ------
    JobError
        If the cluster loses a chunk for good.

    """
    # A sample is a pure function of its number, but the same chunk is not wanted twice.
    pool = client.get_executor(pure=False)
    try:
        yield pool
    except (CancelledError, ImportError) as error:
        reason = str(error) or 'the scheduler is gone'
        raise JobError(f'the cluster has lost a part of the study: {reason}') from error
    except Exception as error:
        if not type(error).__module__.startswith('distributed'):
            raise
        raise JobError(f'the cluster has lost a part of the study: {error}') from error
    finally:
        if client.status == 'running':
            pool.shutdown(wait=False)


def _rows(path: Path) -> int:
    """Return the number of rows of a table; -1 if it is damaged."""
    try:
        return int(parquet.read_metadata(path).num_rows)
    except (OSError, pa.ArrowException):
        return -1
