# SPDX-License-Identifier: Apache-2.0
"""Read segmentations: NRRD, segmentations of 3D Slicer, NIfTI and STL."""

from __future__ import annotations

import bz2
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
import gzip
from itertools import product
from math import prod
from pathlib import Path
import re
from typing import Any, BinaryIO, cast, Final, NamedTuple
import warnings
import zlib

from needle_dynamics import FloatArray
from needle_planning.anatomy import SegmentationError
from needle_planning.surfaces import read_surfaces
from needle_planning.voxels import (
    check_size,
    Layer,
    present,
    read_values,
    to_ras,
    turned,
    value_names,
    Values,
)
from needle_ros.errors import missing_extra
import numpy as np

#: Endings of the names of files that are read.
_NRRD: Final = ('.nrrd', '.nhdr')
ENDINGS: Final = (*_NRRD, '.nii', '.nii.gz', '.stl')

_LONGEST: Final = 2**22  #: Largest header of NRRD [byte].

#: Spaces of NRRD.
_SPACES: Final = {
    'right-anterior-superior': 'RAS', 'ras': 'RAS', 'left-posterior-superior': 'LPS', 'lps': 'LPS',
    'left-anterior-superior': 'LAS', 'las': 'LAS',
}  # fmt: skip

#: Units of length in headers [m]; unknown in NIfTI is mm, as everywhere in practice.
_UNITS: Final = {
    'mm': 1e-3, 'unknown': 1e-3, 'millimeter': 1e-3, 'cm': 1e-2, 'micron': 1e-6, 'um': 1e-6,
    'meter': 1.0, 'm': 1.0,
}  # fmt: skip

_GZIP: Final = b'\x1f\x8b'  #: Begin of a compressed file.
_PADDING: Final = 512  #: Largest number of zeros after the voxels of NIfTI [byte].
_APART: Final = 1e-4  #: Largest distance of a corner between two forms of NIfTI [m].
_PART: Final = 2**20  #: Bytes of text that are read at once.

#: Types of voxels in NRRD, by NumPy type.
_TYPES: Final = {
    name: code
    for code, names in {
        'i1': 'signed char,int8,int8_t',
        'u1': 'uchar,unsigned char,uint8,uint8_t',
        'i2': 'short,short int,signed short,signed short int,int16,int16_t',
        'u2': 'ushort,unsigned short,unsigned short int,uint16,uint16_t',
        'i4': 'int,signed int,int32,int32_t',
        'u4': 'uint,unsigned int,uint32,uint32_t',
        'i8': 'longlong,long long,long long int,signed long long,signed long long int,'
        'int64,int64_t',
        'u8': 'ulonglong,unsigned long long,unsigned long long int,uint64,uint64_t',
        'f4': 'float',
        'f8': 'double',
    }.items()
    for name in names.split(',')
}

#: Readers of encoded voxels in NRRD.
_ENCODINGS: Final[Mapping[str, Any]] = {
    'raw': lambda stream: stream,
    'gzip': lambda stream: gzip.GzipFile(fileobj=stream),
    'gz': lambda stream: gzip.GzipFile(fileobj=stream),
    'bzip2': bz2.BZ2File,
    'bz2': bz2.BZ2File,
    'ascii': lambda stream: stream,
    'text': lambda stream: stream,
    'txt': lambda stream: stream,
}


class _Numbers:
    """Numbers of a text as voxels of type float64, read in parts."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self._words, self._rest = stream, list[bytes](), b''

    def read(self, size: int, /) -> bytes:
        count = -(-size // 8)
        while len(self._words) < count and (text := self._stream.read(_PART)):
            # The last word may continue.
            *words, self._rest = re.split(rb'\s+', self._rest + text)
            self._words += filter(None, words)
        if self._rest and len(self._words) < count:
            self._words, self._rest = [*self._words, self._rest], b''
        part, self._words = self._words[:count], self._words[count:]
        try:
            return np.array(part, dtype=np.float64).tobytes()
        except ValueError as error:
            raise SegmentationError(f'has voxels that are not numbers: {_line(error)}') from error


class _Segment(NamedTuple):
    """A segment in the header of 3D Slicer."""

    name: str
    layer: int
    value: int


def read_layers(path: Path, space: str = '', spacing: float = 1e-3) -> Iterator[Layer]:
    """
    Yield the layers of a segmentation; only one is in memory, with the values of the file.

    Parameters
    ----------
    path : Path
        File, or a folder of STL files, one for each structure.
    space : str
        ``RAS`` or ``LPS``: the space of a file that does not state it.
    spacing : float
        Spacing of the voxels of surfaces [m].

    Yields
    ------
    Layer
        Values of voxels, and their names: of the segment, or of the file without its endings if
        it has one label only, or of both file and value (``file:2``).

    Raises
    ------
    SegmentationError
        If it cannot be read, with the reason in one line.
    ParameterError
        If a library is not installed, with the extra.
    """
    try:
        yield from _layers(path, space, spacing)
    except SegmentationError as error:
        raise SegmentationError(f'{path}: {error}') from error
    except (OSError, EOFError, zlib.error) as error:
        # A damaged file of gzip or bzip2 has no error number.
        reason = getattr(error, 'strerror', None) or f'is truncated or damaged: {error}'
        raise SegmentationError(f'{path}: {reason}') from error
    except MemoryError as error:
        raise SegmentationError(f'{path}: exceeds the memory') from error


def source_files(path: Path) -> list[Path]:
    """Return all files of a segmentation: of a folder each, of NRRD also the data file."""
    if path.is_dir():
        return sorted(one for one in path.iterdir() if one.is_file())
    if not (path.is_file() and path.name.lower().endswith(_NRRD)):
        return [path]
    try:
        with path.open('rb') as stream:
            beside = _data_file(path, _nrrd_header(path, stream))
    except SegmentationError as error:
        raise SegmentationError(f'{path}: {error}') from error
    return [path, beside] if beside else [path]


def _layers(path: Path, space: str, spacing: float) -> Iterator[Layer]:
    name = path.name.lower()
    if path.is_dir():
        surfaces = sorted(one for one in path.iterdir() if one.name.lower().endswith('.stl'))
        if not surfaces:
            raise SegmentationError('is a folder without STL files')
        yield from read_surfaces(surfaces, space, spacing)
        return
    if (path.exists() and not path.is_file()) or not name.endswith(ENDINGS):
        raise SegmentationError(
            f'is not a folder of STL files or a file {", ".join(ENDINGS)}: save an image as NRRD '
            'or NIfTI'
        )
    if name.endswith('.stl'):
        yield from read_surfaces([path], space, spacing)
        return
    with ExitStack() as stack:
        read = _nrrd if name.endswith(_NRRD) else _nifti
        values, matrix, segments = read(path, stack, space)
    stem = path.name[: -len(next(end for end in reversed(ENDINGS) if name.endswith(end)))]
    stem = stem.removesuffix('.seg')
    found = [present(layer) for layer in values]
    if not any(found):
        raise SegmentationError('has no labeled voxel')
    single = sum(map(len, found)) == 1
    for number, (layer, labels) in enumerate(zip(values, found, strict=True)):
        names = value_names(stem, labels, alone=single)
        names |= {
            one.value: one.name for one in segments if one.layer == number and one.value in names
        }
        yield Layer(*turned(layer, matrix), names)


def _nrrd(path: Path, stack: ExitStack, space: str) -> tuple[Values, FloatArray, list[_Segment]]:
    """Return values of shape (layer, i, j, k), the matrix to RAS [m], and segments."""
    stream = stack.enter_context(path.open('rb'))
    header = _nrrd_header(path, stream)
    _leave_out_single_list(header)
    shape = tuple(map(int, header['sizes']))
    check_size(shape)
    kind = np.dtype(_valid(header, 'type', _TYPES))
    is_text = str(header['encoding']).lower() in ('ascii', 'text', 'txt')
    if kind.itemsize > 1 and not is_text:
        kind = kind.newbyteorder(_valid(header, 'endian', {'little': '<', 'big': '>'}))
    if header.get('line skip', header.get('lineskip', 0)):
        raise SegmentationError('has a line skip, which is not read')
    skip = header.get('byte skip', header.get('byteskip', 0))
    if beside := _data_file(path, header):
        stream = stack.enter_context(beside.open('rb'))
    if skip == -1 and header['encoding'] == 'raw':
        stream.seek(max(stream.seek(0, 2) - prod(shape) * kind.itemsize, 0))
    elif skip < 0:
        raise SegmentationError(f'has a byte skip of {skip}')
    data = stack.enter_context(_valid(header, 'encoding', _ENCODINGS)(stream))
    data.seek(max(skip, 0), 1)
    matrix, is_list = _nrrd_matrix(header, len(shape), space)
    segments = _segments(header, shape[0] if is_list else 1)
    if len(shape) == 4 and shape[0] > 1 and not segments:
        raise SegmentationError(
            f'has 4 axes ({" x ".join(map(str, shape))}): a segmentation of 3D Slicer has the '
            'fields of segments, any other has 3 axes'
        )
    if is_text:
        data, kind = _Numbers(data), np.dtype(np.float64)
    values = read_values(data, shape, kind, 1.0, 0.0)
    return values if is_list else values[None], matrix, segments


def _leave_out_single_list(header: dict[str, Any]) -> None:
    """Leave out a last axis of lists of one value, such as of one component."""
    directions, sizes = np.asarray(header.get('space directions')), header['sizes']
    if directions.shape != (4, 3) or len(sizes) != 4 or sizes[3] != 1:
        return
    if np.isnan(directions[3].astype(np.float64)).all():
        header |= {'sizes': sizes[:3], 'space directions': directions[:3]}


def _data_file(path: Path, header: Mapping[str, Any]) -> Path | None:
    """Return the file of the voxels if it is not the file of the header."""
    file = header.get('data file', header.get('datafile'))
    if not file:
        return None
    beside = (path.parent / str(file)).resolve()
    if not (beside.is_relative_to(path.parent.resolve()) and beside.is_file()):
        raise SegmentationError(f'has the data file {file}, which is not a file beside it')
    return beside


def _nrrd_header(path: Path, stream: BinaryIO) -> dict[str, Any]:
    """Read the header in bounded memory, up to and including its empty line."""
    try:
        import nrrd
    except ModuleNotFoundError as error:
        raise missing_extra(error, f'reading {path.name}', 'plan') from error
    content = stream.read(_LONGEST)
    end = re.search(rb'\r?\n\r?\n', content)
    if not content.startswith(b'NRRD') or (not end and len(content) == _LONGEST):
        raise SegmentationError(f'is not an NRRD file: it begins with {content[:8]!r}')
    text = content[: end.end() if end else None].decode('utf-8', errors='replace')
    stream.seek(end.end() if end else len(content))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            header = dict(nrrd.read_header(text.split('\n')))
        missing = {'type', 'dimension', 'sizes', 'encoding'} - header.keys()
        if missing or header['dimension'] != len(header['sizes']):
            raise ValueError(f'{", ".join(sorted(missing)) or "sizes"} missing')
    # Any, for random bytes.
    except Exception as error:
        raise SegmentationError(f'has an invalid header of NRRD: {_line(error)}') from error
    return header


def _valid(header: Mapping[str, Any], field: str, known: Mapping[str, Any]) -> Any:
    given = str(header.get(field)).lower()
    if given not in known:
        raise SegmentationError(
            f'has the {field} {header.get(field)!r}, valid: {", ".join(known)}'
        )
    return known[given]


def _nrrd_matrix(header: Mapping[str, Any], axes: int, space: str) -> tuple[FloatArray, bool]:
    """Return the matrix from voxels to RAS [m], and whether the first axis is one of layers."""
    if 'space' in header:
        of_file = _valid(header, 'space', _SPACES)
    elif space:
        of_file = space
    else:
        raise SegmentationError(
            'does not state its space: add space: LPS or space: RAS to the labels'
        )
    units = {str(unit).strip() or 'unknown' for unit in header.get('space units', ['mm'])}
    if len(units) != 1:
        raise SegmentationError(f'has the space units {", ".join(sorted(units))}')
    unit = _valid({'unit': units.pop()}, 'unit', _UNITS)
    try:
        directions = np.array(header['space directions'], dtype=np.float64)
        origin = np.array(header['space origin'], dtype=np.float64)
    except (KeyError, ValueError, TypeError) as error:
        raise SegmentationError(
            f'has no valid orientation (space directions, space origin): {_line(error)}'
        ) from error
    is_list = axes == 4 and directions.shape == (4, 3) and bool(np.isnan(directions[0]).all())
    if (axes != 3 and not is_list) or directions.shape != (axes, 3) or origin.shape != (3,):
        raise SegmentationError(
            f'has {axes} axes with {directions.shape[0]} space directions: 3 axes are needed, '
            'or before them one of layers, with the direction none'
        )
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = directions[-3:].T, origin
    return to_ras(matrix, of_file, unit), is_list


def _segments(header: Mapping[str, Any], layers: int) -> list[_Segment]:
    """Return the segments of 3D Slicer; before its version 4.11 each is a layer of its own."""
    found = []
    for key in header:
        if not (match := re.fullmatch(r'(Segment(\d{1,6})_)Name', key)):
            continue
        defaults = {'Layer': min(int(match[2]), layers - 1), 'LabelValue': 1}
        layer, value = (
            _whole(f'{match[1]}{field}', header.get(f'{match[1]}{field}', default))
            for field, default in defaults.items()
        )
        found.append(_Segment(header[key], layer, value))
    return found


def _whole(field: str, given: object) -> int:
    if not re.fullmatch(r'\d{1,6}', str(given), re.ASCII):
        raise SegmentationError(f'has the {field} {given!r}, valid: whole numbers from 0')
    return int(str(given))


def _nifti(path: Path, stack: ExitStack, _space: str) -> tuple[Values, FloatArray, list[_Segment]]:
    """Return values of shape (1, i, j, k), and the matrix to RAS [m]; there are no segments."""
    try:
        from nibabel import Nifti1Header, Nifti2Header
    except ModuleNotFoundError as error:
        raise missing_extra(error, f'reading {path.name}', 'plan') from error
    with path.open('rb') as stored:
        opened = gzip.open if stored.read(2) == _GZIP else open
    stream = cast('BinaryIO', stack.enter_context(opened(path, 'rb')))
    block = stream.read(Nifti2Header.sizeof_hdr)
    kind = Nifti2Header if Nifti2Header.may_contain_header(block) else Nifti1Header
    if not kind.may_contain_header(block):
        raise SegmentationError(f'is not a NIfTI file: it begins with {block[:8]!r}')
    try:
        with warnings.catch_warnings(), np.errstate(all='ignore'):
            warnings.simplefilter('ignore')
            header = kind(block[: kind.sizeof_hdr], check=False)
            magic = bytes(header['magic'])
            shape = tuple(map(int, header.get_data_shape()))
            dtype, offset = header.get_data_dtype(), int(header.get_data_offset())
            slope, intercept = header.get_slope_inter()
            unit = header.get_xyzt_units()[0]
            matrices = [header.get_sform(coded=True)[0], header.get_qform(coded=True)[0]]
    # Any, for random bytes.
    except Exception as error:
        raise SegmentationError(f'has an invalid header of NIfTI: {_line(error)}') from error
    if not magic.startswith(b'n+'):
        raise SegmentationError(f'is not a NIfTI file in one part, but {magic!r}')
    check_size(shape)
    if len(shape) < 3 or any(size > 1 for size in shape[3:]):
        raise SegmentationError(
            f'has {len(shape)} axes ({" x ".join(map(str, shape))}), a segmentation has 3'
        )
    matrix = next((one for one in matrices if one is not None), None)
    if matrix is None:
        raise SegmentationError(
            'has neither sform nor qform: its left and right are unknown; save it again with its '
            'orientation'
        )
    length = _valid({'unit': unit}, 'unit', _UNITS)
    _check_forms(matrices, shape, length)
    if offset < kind.sizeof_hdr:
        raise SegmentationError(f'has its voxels at byte {offset}, within the header')
    stream.seek(offset)
    scale = (1.0 if slope is None else float(slope), float(intercept or 0.0))
    values = read_values(stream, shape[:3], dtype, *scale, padding=_PADDING)
    return values[None], to_ras(matrix, 'RAS', length), []


@np.errstate(all='ignore')
def _check_forms(matrices: list[FloatArray | None], shape: tuple[int, ...], unit: float) -> None:
    """Raise `SegmentationError` if sform and qform place a corner at different positions."""
    sform, qform = matrices
    if sform is None or qform is None:
        return
    corners = np.array(list(product(*((0, size - 1) for size in shape[:3]))))
    apart = np.linalg.norm(corners @ (sform - qform)[:3, :3].T + (sform - qform)[:3, 3], axis=1)
    if not unit * apart.max() <= _APART:
        raise SegmentationError(
            f'has an sform and a qform whose corners are up to {1e3 * unit * apart.max():.4g} mm '
            'apart: save it with one of them, and the code of the other set to 0'
        )


def _line(error: Exception) -> str:
    """Return the begin of the message of another library in one line."""
    return ' '.join(f'{type(error).__name__}: {error}'.split())[:200]
