# SPDX-License-Identifier: Apache-2.0
"""
Compute a study on any executor; it is resumed after an interruption.

Chunks of samples are written as they arrive, each atomically, in a folder of parts. Existing parts
are not computed again. When all are complete they become one table, in the order of the samples,
whose bytes depend neither on the chunks nor on the number of workers.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import CancelledError, Executor, FIRST_COMPLETED, Future, wait
from contextlib import AbstractContextManager, contextmanager, suppress
import fcntl
from functools import lru_cache
from importlib.metadata import version
from itertools import accumulate, chain
import json
import os
from pathlib import Path
import re
import shutil
from time import monotonic
from typing import Any, Final, NamedTuple
from zlib import crc32

from needle_dynamics import FloatArray
from needle_ros.errors import JobError, ParameterError
from needle_ros.files import write_whole
from needle_study.study import build_study, Study
import numpy as np
import pyarrow as pa
from pyarrow import parquet

#: Samples of the first chunk, and the target duration of the others [s].
_FIRST, _WANTED = 16, 1.0
_LARGEST: Final = 2**13
_GROUP: Final = 2**13  #: rows per group of the table; the bytes of the table depend on it
_BLOCK: Final = 2**20  #: bytes that are read at once

# The other memory pools do not release freed memory.
pa.set_memory_pool(pa.system_memory_pool())

#: Name of a part: first sample, end, and checksum.
_PART: Final = re.compile(r'(\d{10})-(\d{10})-([0-9a-f]{8})\.arrow')

#: Packages whose versions affect the bits of a sample.
_PACKAGES: Final = ('needle_insertion', 'numba', 'numpy', 'scipy')

TABLE: Final = 'samples.parquet'
STUDY: Final = 'study.json'


def order(study: Study) -> str:
    """Return the input of a worker as JSON: the study, and the versions of the packages."""
    return json.dumps(
        {'study': study.document, 'versions': _versions()}, sort_keys=True, default=_plain
    )


def _plain(value: Any) -> Any:
    """Return a number of NumPy as one of Python, and a path as text."""
    return value.item() if isinstance(value, np.generic) else str(value)


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
    return build_study(given['study'])


def chunk(text: str, first: int, count: int) -> tuple[float, dict[str, FloatArray]]:
    """Compute samples from `first` on of the text of `order`; return duration [s] and columns."""
    study = _study(text)
    begin = monotonic()
    columns = study.rows(first, count)
    return monotonic() - begin, columns


def _checksum(first: int, end: int, blocks: Iterable[bytes]) -> str:
    """Return the checksum of a range of samples and of the content of their file."""
    value = crc32(f'{first} {end}'.encode())
    for block in blocks:
        value = crc32(block, value)
    return f'{value:08x}'


def _blocks(path: Path) -> Iterator[bytes]:
    with path.open('rb') as file:
        yield from iter(lambda: file.read(_BLOCK), b'')


class _Part(NamedTuple):
    """File with the samples from `first` to `end` - 1; the checksum is in its name."""

    first: int
    end: int
    checksum: str
    path: Path


class Results:
    """Folder of a study; ParameterError for other content, JobError for a damaged table."""

    def __init__(self, folder: Path, study: Study) -> None:
        self.folder, self.study = folder, study
        self.table = folder / TABLE  #: file of all samples
        self._sum = self.table.with_suffix('.crc32')
        self._parts, self._file = folder / 'parts', folder / STUDY
        if self._file.is_file():
            if self._begun()['study'] != json.loads(order(study))['study']:
                self._begin_again()
        # A process that was killed at the start leaves a draft, or nothing.
        elif folder.exists() and any(path.suffix != '.tmp' for path in folder.iterdir()):
            raise ParameterError(f'{folder} exists and is not a study; name another folder')
        else:
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise ParameterError(f'{folder} cannot be written: {error.strerror}') from error
            write_whole(self._file, order(study).encode())
        if self.table.exists():
            if not self._is_intact():
                raise JobError(f'{self.table} is damaged; remove it to compute it again')
            shutil.rmtree(self._parts, ignore_errors=True)
        else:
            self._parts.mkdir(exist_ok=True)

    def _begin_again(self) -> None:
        """Replace another study without a sample, as after an invalid input."""
        if not self.table.exists():
            self._parts.mkdir(exist_ok=True)
            with suppress(JobError), self._locked():
                if not self._done():
                    write_whole(self._file, order(self.study).encode())
                    return
        raise ParameterError(f'{self.folder} belongs to another study; name another folder')

    def _begun(self) -> dict[str, Any]:
        """Return the study in the folder, and the package versions of its start."""
        try:
            given = json.loads(self._file.read_bytes())
            return {name: given[name] for name in ('study', 'versions')}
        except (ValueError, TypeError, KeyError) as error:
            raise ParameterError(f'{self._file} is not a study; name another folder') from error

    @contextmanager
    def _locked(self) -> Iterator[None]:
        with (self._parts / 'lock').open('w') as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise JobError(f'another process computes {self.folder}') from error
            yield

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Lock the folder and remove damaged parts; JobError if locked or of another version."""
        _check_versions(self._begun()['versions'], f'the study in {self.folder}')
        self._parts.mkdir(exist_ok=True)
        with self._locked():
            if self._begun()['study'] != json.loads(order(self.study))['study']:
                raise JobError(f'{self.folder} belongs to another study now')
            end = 0
            for part in [] if self.table.exists() else self._done():
                intact = _checksum(part.first, part.end, _blocks(part.path)) == part.checksum
                if part.first < end or not intact:
                    part.path.unlink()
                else:
                    end = part.end
            yield

    def missing(self) -> list[tuple[int, int]]:
        """Return the samples to compute, as ranges of first and last + 1."""
        if self.table.exists():
            return []
        parts = self._done()
        begins = accumulate((part.end for part in parts), max, initial=0)
        firsts = [*(part.first for part in parts), self.study.samples]
        return [gap for gap in zip(begins, firsts, strict=True) if gap[0] < gap[1]]

    def _done(self) -> list[_Part]:
        found = ((_PART.fullmatch(path.name), path) for path in self._parts.iterdir())
        return sorted(_Part(int(one[1]), int(one[2]), one[3], path) for one, path in found if one)

    def add(self, first: int, columns: Mapping[str, FloatArray]) -> int:
        """Write a chunk that starts at the sample `first`; return its number of samples."""
        count = len(columns['sample'])
        end, file = first + count, pa.BufferOutputStream()
        units = self.study.units
        fields = [pa.field(name, pa.float64(), metadata={'unit': units[name]}) for name in columns]
        table = pa.table(dict(columns), pa.schema(fields))
        # Not compressed: a part is removed when all are complete.
        with pa.ipc.new_file(file, table.schema) as writer:
            writer.write_table(table)
        content = file.getvalue().to_pybytes()
        name = f'{first:010d}-{end:010d}-{_checksum(first, end, [content])}.arrow'
        try:
            write_whole(self._parts / name, content)
        except ParameterError as error:
            raise JobError(str(error)) from error
        return count

    def complete(self) -> None:
        """Merge all parts into one table, and remove the parts."""
        if not self.table.exists():
            draft = self.table.with_suffix('.part')
            try:
                self._merge(draft)
                checksum = _checksum(0, self.study.samples, _blocks(draft))
                write_whole(self._sum, checksum.encode())
                draft.replace(self.table)
            except OSError as error:
                with suppress(OSError):
                    draft.unlink()
                raise JobError(f'{self.table} cannot be written: {error}') from error
        shutil.rmtree(self._parts, ignore_errors=True)

    def _is_intact(self) -> bool:
        with suppress(OSError, UnicodeDecodeError):
            return self._sum.read_text() == _checksum(0, self.study.samples, _blocks(self.table))
        return False

    def _groups(self) -> Iterator[Any]:
        """Yield all samples in tables of equal size."""
        waiting: list[Any] = []
        for part in self._done():
            with pa.OSFile(str(part.path)) as file:
                waiting.append(pa.ipc.open_file(file).read_all())
            while sum(map(len, waiting)) >= _GROUP:
                whole = pa.concat_tables(waiting)
                yield whole.slice(0, _GROUP)
                waiting = [whole.slice(_GROUP)]
        if sum(map(len, waiting)):
            yield pa.concat_tables(waiting)

    def _merge(self, path: Path) -> None:
        groups = self._groups()
        first = next(groups)
        options = {'compression': 'zstd', 'use_dictionary': False}
        with parquet.ParquetWriter(path, first.schema, **options) as writer:
            for one in chain([first], groups):
                writer.write_table(one.combine_chunks(), row_group_size=_GROUP)
        # The parts are removed afterwards. A lost part is computed again.
        with path.open('rb') as file:
            os.fsync(file.fileno())


def compute(
    results: Results,
    executor: Callable[[], AbstractContextManager[Executor]],
    workers: int,
    progress: Callable[[int], object],
) -> None:
    """Compute the missing samples with a context of an executor; JobError if one fails."""
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
                # Small chunks at the end, so that all workers end at the same time.
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
                # The first chunk compiles the kernels, or loads them.
                size = min(max(1, round(count * _WANTED / max(taken, 1e-6))), 4 * size, _LARGEST)
    finally:
        for future in running:
            future.cancel()


@contextmanager
def dask(client: Any) -> Iterator[Executor]:
    """Yield an executor on a Dask cluster, which remains; raise `JobError` if a chunk is lost."""
    # A sample is a pure function of its number, but the results need not be kept.
    pool = client.get_executor(pure=False)
    try:
        yield pool
    except Exception as error:
        of_dask = type(error).__module__.startswith('distributed')
        if not of_dask and not isinstance(error, (CancelledError, ImportError)):
            raise
        reason = str(error) or 'the scheduler is not available'
        raise JobError(f'the cluster has lost a chunk of the study: {reason}') from error
    finally:
        if client.status == 'running':
            pool.shutdown(wait=False)
