# SPDX-License-Identifier: Apache-2.0
"""
Read tables with named columns: text (CSV and similar) and MATLAB files.

A column is given by its name in the file or by its number, and has a role: ``time=t[ms]``,
``force=-Fz``, ``depth=q[mm]``, ``force=current*35.15[N]``. The unit of the numbers is in brackets;
by default it is taken from the name (``q_mm``, ``Force (N)``), else it is the SI unit. A stamp in
two columns, seconds and nanoseconds, is ``time=sec:nanosec``.
"""

from array import array
from codecs import BOM_UTF16_BE, BOM_UTF16_LE, getincrementaldecoder
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
import csv
from datetime import datetime
from itertools import islice
import os
from pathlib import Path
import re
import struct
from typing import Any, Final, NamedTuple
import zlib

from needle_dynamics.arrays import BoolArray, FloatArray, IntArray
from needle_identification.bags.bag import MATLAB, TABLES
from needle_identification.bags.compression import BLOCK, Budget, DAMAGED
from needle_identification.errors import RecordingError
from needle_identification.recordings.samples import restart_of, RUN, Series
from needle_ros.column_units import (
    BRACKETS,
    foreign_unit,
    ONLY_IN_BRACKETS,
    states_unit,
    unit_of,
    UNITS,
)
from needle_ros.errors import shown
from needle_ros.quantities import signed
import numpy as np

ROLES: Final = ('time', 'depth', 'speed', 'force')  #: for friction; depth or speed is sufficient
#: Usual names of a column of time.
TIME_NAMES: Final = ('time', 't', 'timestamp', 'stamp', 'elapsed', 'seconds', 'sec')

#: Usual column names by role, in order of preference; compared without case and signs.
_USUAL: Final = {
    'time': TIME_NAMES,
    'depth': ('depth', 'insertion', 'position', 'pos', 'q', 'qm', 'x', 'displacement', 'joint'),
    'speed': ('speed', 'velocity', 'vel', 'v', 'qd', 'dq', 'qdot'),
    'force': ('force', 'fy', 'fz', 'fx', 'f', 'effort', 'load', 'axialforce', 'faxial'),
}

#: Exceptions of SciPy for damaged bytes.
_DAMAGED: Final = (*DAMAGED, zlib.error, EOFError, IndexError, AttributeError)

_MATLAB_HEAD: Final = 128  # length of the header of a MATLAB file [bytes]
_COMPRESSED: Final = 15  # type code of its compressed variables
_HEAD: Final = 200  # number of lines searched for the first line of numbers
_LATEST: Final = 9e9  # largest time whose nanoseconds are 64-bit integers [s]
_LONGEST_LINE: Final = 2**16  # longest plausible line of a sample [characters]
#: Probable unit, and the range, or for time the median step, above which it is rarely in SI units.
_SUSPICIOUS: Final = {
    'time': (('ms', 0.99), ('us', 990.0), ('ns', 9.9e5)),
    'depth': (('mm', 2.0),),
    'speed': (('mm/s', 2.0),),
    'force': (('mN', 500.0),),
    **dict.fromkeys(('guide_x', 'guide_z'), (('mm', 0.1),)),
}
_SECONDS: Final = ('sec', 'seconds')  #: Names of times that are in s.
_BLANKS: Final = re.compile(r'(?i)(([-+]?\d+(,\d+)?(e[-+]?\d+)?|nan)( +|$)){2,}')  # decimal commas
_COMMAS: Final = re.compile(r'\s*[-+]?\d+,\d+(\s*,\s*[-+]?\d+,\d+)+\s*')  # between columns, too
_WORD: Final = re.compile(r'[^0-9a-zµ]+')
SPEC: Final = re.compile(r'^\s*(.+?)\s*(?:\*\s*([^\[\]*]+?))?\s*(?:\[([^\]]*)\])?$')


class Table(NamedTuple):
    """Content of a table file, by name."""

    path: Path
    columns: dict[str, FloatArray]  # (n,) each; nan if not a number
    scalars: dict[str, float]  # for factors
    losses: list[str]  # parts that are not readable


def column_roles(text: str, roles: Sequence[str] = ROLES) -> dict[str, str]:
    """Parse ``role=column,...`` of a command line; raise a RecordingError if invalid."""
    found: dict[str, str] = {}
    for word in text.split(','):
        role, sign, spec = (part.strip() for part in word.partition('='))
        if not (sign and role in roles and spec):
            raise RecordingError(
                f'--columns takes ROLE=[-]NAME[*FACTOR][UNIT],... with the roles '
                f'{", ".join(roles)}, got {word!r}'
            )
        if role in found:
            raise RecordingError(f'--columns names {role} twice: {found[role]} and {spec}')
        found[role] = spec
    return found


def is_table(path: Path | str) -> bool:
    return Path(path).suffix.lower() in TABLES


def read_table(path: Path) -> Table:
    """Read a text file with one sample per line, or a MATLAB file."""
    try:
        table = _matlab(path) if path.suffix.lower() == MATLAB else _text(path)
    except OSError as error:
        raise RecordingError(f'{path} cannot be read: {error.strerror or error}') from error
    if not table.columns:
        raise RecordingError(f'{path} holds no columns of numbers')
    return table


def guessed(
    names: Iterable[str], usual_names: Mapping[str, Sequence[str]] = _USUAL
) -> dict[str, str]:
    """Find names by role from usual names, in order of preference, lower case without signs."""
    # Time, and the roles of friction, are also found by unit: the only column with a unit of it.
    plain = {name: plain_name(name) for name in names}
    found: dict[str, str] = {}
    for role, usual in usual_names.items():
        for word in usual:
            alike = [name for name, short in plain.items() if short == word]
            alike += [name for name in plain if name.lower().endswith('.' + word)]
            if alike:
                found[role] = alike[0]
                break
    for role in ROLES if usual_names is _USUAL else {'time'} & {*usual_names}:
        by_unit = [name for name in plain if unit_of(name, role)]
        if len(by_unit) == 1 and by_unit[0] not in found.values():
            found.setdefault(role, by_unit[0])
    pairs = [
        (sec, nanosec)
        for sec in plain
        for nanosec in plain
        if re.search(r'(?i)n(ano)?sec', nanosec)
        and re.sub(r'(?i)n(ano)?secs?', 'sec', nanosec) == re.sub(r'(?i)secs?', 'sec', sec)
        and sec != nanosec
    ]
    if pairs:
        found['time'] = ':'.join(pairs[0])
    return found


def plain_name(name: str) -> str:
    """Return a name without its unit, case and signs."""
    if match := BRACKETS.match(name):
        name = match[1]
    front, _, last = name.rpartition('_')
    if front and last not in ONLY_IN_BRACKETS and any(last in one for one in UNITS.values()):
        name = front
    return _WORD.sub('', name.lower())


def measured_values(column: FloatArray) -> FloatArray:
    """Return the values of a column without those that are missing, at least one."""
    found = column[np.isfinite(column)]
    return found if len(found) else np.zeros(1)


def column_of(table: Table, spec: str) -> str:
    """Return the name of a column without sign, factor, unit and shift."""
    if spec in table.columns:
        return spec
    return re.split(r'\s*[*\[@]', spec.lstrip('-'), maxsplit=1)[0].strip()


def with_unit(role: str, name: str, values: FloatArray) -> str:
    """Return a column with the probable unit if its name states none and its values are large."""
    finite = values[np.isfinite(values)]
    if states_unit(name, role) or len(finite) < 2 or plain_name(name) in _SECONDS:
        return name
    size = np.median(np.diff(finite)) if role == 'time' else np.ptp(finite)
    probable = [f'{name}[{unit}]' for unit, least in _SUSPICIOUS.get(role, ()) if size > least]
    return probable[-1] if probable else name


def column_values(
    table: Table, role: str, spec: str, losses: list[str], option: str = '--columns'
) -> FloatArray:
    """
    Return the values (n,) of a column in SI units, by its name with sign, factor and unit.

    `option` is the option that can state a unit, '' without one.
    """
    if role == 'time' and ':' in spec and spec not in table.columns:
        seconds, _, nanoseconds = spec.partition(':')
        both = [_column(table, role, name)[1] for name in (seconds, nanoseconds)]
        # Relative to the start: the sum may exceed the precision of a float.
        return np.asarray((both[0] - both[0][np.isfinite(both[0])][:1].sum()) + 1e-9 * both[1])
    sign, rest = (1.0, spec) if spec in table.columns else signed(spec)
    if rest in table.columns:
        # The name itself contains brackets.
        name, factor, unit = rest, None, None
    else:
        match = SPEC.match(rest)
        if match is None:
            raise RecordingError(f'--columns {role}={spec} is not [-]NAME[*FACTOR][UNIT]')
        name, factor, unit = match.groups()
    name, column = _column(table, role, name)
    unit = unit or unit_of(name, role)
    if unit is None and (foreign := foreign_unit(name)):
        remedy = f"use {option} '{role}={name}[UNIT]'" if option else 'rename the column'
        raise RecordingError(
            f'{table.path}: the unit {foreign!r} of the column {name!r} is not one of '
            f'{", ".join(UNITS[role])} for {role}: {remedy}'
        )
    if unit is not None and unit not in UNITS[role]:
        raise RecordingError(
            f'--columns {role}={spec}: the unit must be one of {", ".join(UNITS[role])}, '
            f'got {unit!r}'
        )
    scale = sign * (UNITS[role][unit] if unit else 1.0)
    if factor is not None:
        scale *= _factor(table, role, spec, factor)
    found = scale * column
    if unit is None and (other := with_unit(role, name, found)) != name:
        losses.append(f'{name} has no unit, taken in SI units: perhaps {role}={other}')
    return np.asarray(found)


def _column(table: Table, role: str, name: str) -> tuple[str, FloatArray]:
    """Return the full name and the values of a column, given by name (unit optional) or number."""
    names = list(table.columns)
    same = [other for other in names if BRACKETS.sub(r'\1', other) == name]
    if name not in names and len(same) == 1:
        name = same[0]
    elif name not in names and name.isdecimal() and 0 < int(name) <= len(names):
        name = names[int(name) - 1]
    if name not in names:
        raise RecordingError(
            f'{table.path} has no column {name!r} for {role}; it has {", ".join(names)}'
        )
    return name, table.columns[name]


def _factor(table: Table, role: str, spec: str, factor: str) -> float:
    try:
        value = table.scalars[factor] if factor in table.scalars else float(factor)
    except ValueError:
        has = ', '.join(table.scalars) or 'no single numbers'
        raise RecordingError(
            f'--columns {role}={spec}: the factor must be a number or the name of one, got '
            f'{factor!r}; {table.path} has {has}'
        ) from None
    if not value or not np.isfinite(value):
        raise RecordingError(
            f'--columns {role}={spec}: the factor must be finite and not zero, got {value:g}'
        )
    return value


def sorted_rows(
    path: Path, time: FloatArray, rows: FloatArray, losses: list[str]
) -> tuple[float, IntArray, FloatArray]:
    """Return the start [s], stamps since then [ns], and usable rows (n, k), in order of time."""
    usable = np.isfinite(rows).all(axis=1) & np.isfinite(time)
    if lost := int(np.count_nonzero(~usable)):
        losses.append(f'{lost} rows with a value that is not a number, left out')
    if np.count_nonzero(usable) < 2:
        count = np.count_nonzero(usable)
        raise RecordingError('; '.join([f'{path} has {count} usable rows', *losses]))
    check_restart(path, time, usable)
    time, rows = time[usable], rows[usable]
    start = float(time.min())
    if not abs(start) < _LATEST:
        raise RecordingError(
            f'{path}: time starts at {start:.3g} s: is its unit right? {"; ".join(losses)}'.strip()
        )
    since = time - start
    if not since.max() < 1e9:
        raise RecordingError(f'{path}: time spans {since.max():.3g} s: is its unit right?')
    series = Series(rows.shape[1])
    series.add(np.rint(1e9 * since).astype(np.int64), rows)
    series.compact()
    if len(series.stamps) < 2:
        raise RecordingError(f'{path}: all rows have the same time')
    losses += series.losses('the rows')
    return start, series.stamps, series.values


def check_restart(path: Path, time: FloatArray, usable: BoolArray, least: int = RUN) -> None:
    """Raise a RecordingError if the time begins again, in runs of at least some mean rows."""
    if row := restart_of(time[usable], least):
        row = int(np.flatnonzero(usable)[row]) + 1
        raise RecordingError(
            f'{path}: time restarts at row {row} of {len(usable)}: split the file'
        )


# Text.


def _text(path: Path) -> Table:
    head = [line.rstrip('\r\n') for line in islice(_lines(path), _HEAD)]
    first = _first_row(head)
    if not head:
        raise RecordingError(f'{path} is empty; valid: a table with named columns')
    if first is None:
        raise RecordingError(f'{path} has no line of numbers among its first {len(head)}')
    separator = _separator(head[first])
    count = len(_split(head[first], separator))
    if _COMMAS.fullmatch(head[first]) and any(
        2 * len(_split(line, separator)) == count for line in head[:first]
    ):
        raise RecordingError(
            f'{path}: rows have {count} values and the header {count // 2} names: with decimal '
            'commas, columns need another separator'
        )
    names = _names(head[:first], separator, count)
    try:
        table = np.loadtxt(
            _lines(path), delimiter=separator, skiprows=first, ndmin=2, comments=('#', '%')
        )
        lost = 0
    except ValueError:
        # Text, gaps, quotes, or decimal commas.
        table, lost = _rows(path, first, separator, count)
    losses = [f'{lost} lines not readable, left out'] if lost else []
    with path.open('rb') as stream:
        stream.seek(-min(2, path.stat().st_size), os.SEEK_END)
        if stream.read().rstrip(b'\0')[-1:] not in b'\r\n':
            losses.append('the last line has no end: the file may be cut off')
    known = np.atleast_1d(np.isfinite(table).any(axis=0))
    columns = {name: table[:, k] for k, name in enumerate(names) if known[k]}
    return Table(path, columns, {}, losses)


def _first_row(head: Sequence[str]) -> int | None:
    """Return the first row of numbers in the form of most below it, not a line of metadata."""
    lines = [k for k, line in enumerate(head) if _numbers(line)]
    for at, first in enumerate(lines):
        separator = _separator(head[first])
        rows = [_split(head[k], separator) for k in lines[at:]]
        count = len(rows[0])
        known = np.isfinite([[_number(word) for word in row] for row in rows if len(row) == count])
        # Text above numbers is no value, but values of the rows directly above may be missing.
        text_above = ~known[0] & (2 * known.sum(axis=0) > len(known))
        if 2 * len(known) > len(rows) and not text_above.any():
            begin = first
            while begin - 1 in lines and len(_split(head[begin - 1], separator)) == count:
                begin -= 1
            return begin
    return lines[0] if lines else None


def _rows(path: Path, first: int, separator: str | None, count: int) -> tuple[FloatArray, int]:
    found, lost = array('d'), 0
    for line in islice(_lines(path), first, None):
        words = _split(line, separator)
        if len(words) == count:
            found.extend(_number(word) for word in words)
        elif line.strip() and line.lstrip()[0] not in '#%':
            lost += 1
    return np.array(found).reshape(-1, count), lost


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of a file; reject a line longer than a plausible sample."""
    with path.open(encoding=_encoding(path), errors='replace') as stream:
        while line := stream.readline(_LONGEST_LINE):
            if len(line) == _LONGEST_LINE:
                raise RecordingError(
                    f'{path} has a line of {_LONGEST_LINE} characters or more: it is not a table'
                )
            yield line


def _encoding(path: Path) -> str:
    with path.open('rb') as stream:
        head = stream.read(_LONGEST_LINE)
    if head.startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
        return 'utf-16'
    try:
        # The last character of this part can be incomplete.
        getincrementaldecoder('utf-8')().decode(head)
    except UnicodeDecodeError:
        return 'cp1252'
    return 'utf-8-sig'


def _separator(line: str) -> str | None:
    unquoted = re.sub('"[^"]*"', '', line)
    if _BLANKS.fullmatch(unquoted.strip()):
        return None
    return next((mark for mark in (';', '\t', ',') if mark in unquoted), None)


def _split(line: str, separator: str | None) -> list[str]:
    line = line.strip()
    words = line.split(separator)
    if separator and '"' in line:
        words = next(csv.reader([line], delimiter=separator))
    return [word.strip().strip('"') for word in words]


def _numbers(line: str) -> bool:
    """Return whether at least half of the words of a line are numbers."""
    words = _split(line, _separator(line))
    found = [word for word in words if _number(word) == _number(word)]
    return len(found) > 0 and 2 * len(found) >= len(words) and line.lstrip()[:1] not in '#%'


def _number(word: str) -> float:
    with suppress(ValueError):
        return float(word)
    with suppress(ValueError):
        return float(word.replace(',', '.'))
    with suppress(ValueError, OverflowError):
        return datetime.fromisoformat(word).timestamp()
    return float('nan')


def _names(head: Sequence[str], separator: str | None, count: int) -> list[str]:
    """Return the column names from the lines before the numbers, else column numbers."""
    for k, line in reversed(list(enumerate(head))):
        words = _split(line.lstrip('#% '), separator)
        if len(words) != count or not any(words):
            continue
        above = _split(head[k - 1].lstrip('#% '), separator) if k else []
        known = {unit for units in UNITS.values() for unit in units} | {'', '-', '1', 'Nm'}
        if len(above) == count and {word.strip('[]()') for word in words} <= known:
            # A line of units below the line of names.
            units = [word.strip('[]()') for word in words]
            words = [f'{a} [{u}]' if u else a for a, u in zip(above, units, strict=True)]
        return list(_distinct(shown(word) for word in words))
    return [str(k + 1) for k in range(count)]


def _distinct(names: Iterator[str]) -> Iterator[str]:
    used: set[str] = set()
    for k, name in enumerate(names):
        unique = name if name and name not in used else f'{name}{k + 1}'
        used.add(unique)
        yield unique


# MATLAB.


def _spend(path: Path, budget: Budget) -> None:
    with path.open('rb') as stream:
        head = stream.read(_MATLAB_HEAD)
        order = '>' if head[-2:] == b'MI' else '<'
        while len(tag := stream.read(8)) == 8:
            kind, size = struct.unpack(f'{order}II', tag)
            if kind != _COMPRESSED:
                # Not compressed.
                stream.seek(size, os.SEEK_CUR)
                continue
            inflater, part = zlib.decompressobj(), stream.read(size)
            while part and not inflater.eof:
                unfolded = inflater.decompress(part, BLOCK)
                budget.spend(len(unfolded))
                part = inflater.unconsumed_tail


def _matlab(path: Path) -> Table:
    # Lazy import: large, and needed for MATLAB files only.
    from scipy.io import loadmat, whosmat
    from scipy.io.matlab import MatReadError

    budget = Budget(path)
    try:
        _spend(path, budget)
        wanted = [
            (name, shape)
            for name, shape, kind in whosmat(path)
            if kind in ('double', 'single', 'logical') or kind.lstrip('u').startswith('int')
        ]
        content: Mapping[str, Any] = loadmat(path, variable_names=[name for name, _ in wanted])
    except NotImplementedError:
        raise RecordingError(
            f'{path} is a MATLAB 7.3 file: save it again with save(..., "-v7")'
        ) from None
    except (*_DAMAGED, MatReadError) as error:
        raise RecordingError(f'{path} is damaged: {shown(str(error))}') from error
    arrays = {
        name: np.squeeze(np.asarray(content[name], dtype=np.float64))
        for name, _ in wanted
        if name in content and not np.iscomplexobj(content[name])
    }
    # A matrix may have a row for each coordinate.
    sizes = [max(a.shape) for a in arrays.values() if a.ndim in (1, 2)]
    longest = max(set(sizes), key=sizes.count, default=0)
    used = {n for n, a in arrays.items() if a.ndim in (1, 2) and max(a.shape) == longest}
    columns: dict[str, FloatArray] = {}
    for name, values in arrays.items():
        if name in used and values.ndim == 1:
            columns[shown(name)] = values
        elif name in used:
            by_column = values.T if values.shape[0] == longest else values
            columns |= {shown(f'{name}{k + 1}'): column for k, column in enumerate(by_column)}
    scalars = {shown(name): float(values) for name, values in arrays.items() if values.ndim == 0}
    left = sorted(set(arrays) - set(scalars) - used)
    losses = [f'{", ".join(map(shown, left))} of another length, left out'] if left else []
    return Table(path, columns, scalars, losses)
