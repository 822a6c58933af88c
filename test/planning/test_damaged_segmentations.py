# SPDX-License-Identifier: Apache-2.0
"""Segmentations that are damaged, too large, or of another format: one line, bounded memory."""

from __future__ import annotations

from collections.abc import Callable
import gzip
from pathlib import Path
import subprocess
import sys
from tempfile import TemporaryDirectory
from typing import Any

from hypothesis import example, given, settings
from hypothesis import strategies as st
from needle_planning import read_anatomy, SegmentationError
from needle_ros.errors import NeedleError, ParameterError
import nibabel
import numpy as np
import pytest
from support.segmentations import ROLES, write_labels, write_nifti, write_nrrd
import trimesh

ROOT = Path(__file__).parents[2]
VALUES = np.zeros((5, 4, 3), np.uint8)
VALUES[1:3, 1:3, 1] = 1
VALUES[3:, 1:3, 1] = 2
AFFINE = np.diag([2.0, 2.0, 2.0, 1.0])
#: Largest memory of a process that reads a segmentation [kB].
MEMORY = 2_000_000


def nifti(path: Path, values: Any = VALUES, affine: Any = AFFINE, **codes: int) -> Path:
    return write_nifti(path.with_suffix('.nii'), values, affine, **codes)


def nrrd(path: Path, values: Any = VALUES, affine: Any = AFFINE, **fields: Any) -> Path:
    return write_nrrd(path.with_suffix('.nrrd'), values, affine, **fields)


def edited(path: Path, change: Callable[[bytes], bytes], name: str = '') -> Path:
    """Change the content of a file, and its name."""
    path.write_bytes(change(path.read_bytes()))
    return path.rename(path.with_name(name or path.name))


def put(start: int, content: bytes) -> Callable[[bytes], bytes]:
    return lambda old: old[:start] + content + old[start + len(content) :]


def segments(path: Path) -> Path:
    """Write a segmentation of 3D Slicer with two layers."""
    fields = {'Segment0_Name': 'a', 'Segment0_Layer': '0', 'Segment0_LabelValue': '1'}
    fields |= {'Segment1_Name': 'b', 'Segment1_Layer': '1', 'Segment1_LabelValue': '2'}
    return nrrd(path, np.stack([VALUES, VALUES[::-1]]), **fields)


def folder(path: Path) -> Path:
    path.mkdir()
    return path


#: Files and the reason of their rejection.
REJECTED: dict[str, tuple[Callable[[Path], Path], str]] = {
    'missing file': (lambda p: p.with_suffix('.nii'), 'No such file'),
    'empty folder': (folder, 'is a folder without STL files'),
    'other type': (lambda p: edited(nifti(p), bytes, 'a.dcm'), 'a file .nrrd, .nhdr, .nii'),
    'device': (lambda _: Path('/dev/zero'), 'is not a folder of STL files or a file'),
    'empty file': (lambda p: edited(nifti(p), lambda _: b''), 'is not a NIfTI file'),
    'empty nrrd': (lambda p: edited(nrrd(p), lambda _: b''), 'is not an NRRD file'),
    'zeros': (lambda p: edited(nrrd(p), lambda _: bytes(5 * 2**20)), 'is not an NRRD file'),
    'nrrd as nifti': (lambda p: edited(nrrd(p), bytes, 'a.nii'), 'is not a NIfTI file'),
    'nifti as nrrd': (lambda p: edited(nifti(p), bytes, 'a.nrrd'), 'is not an NRRD file'),
    'MetaImage': (lambda p: edited(nifti(p), bytes, 'a.mha'), 'save an image as NRRD or N'),
    'empty mask': (lambda p: nifti(p, 0 * VALUES), 'has no labeled voxel'),
    'empty mask of nrrd': (lambda p: nrrd(p, 0 * VALUES), 'has no labeled voxel'),
    'intensities': (lambda p: nifti(p, VALUES - np.int16(1)), 'has the value -1: a segm'),
    'fractions': (lambda p: nifti(p, VALUES / np.float32(4)), r'has the value 0\.25: a segm'),
    'almost whole': (lambda p: nifti(p, VALUES * (1.0 + 1e-6)), r'has the value 1\.000001: a s'),
    'not a number': (lambda p: nifti(p, VALUES * np.nan), 'has the value nan: a segmentation'),
    'large value': (lambda p: nrrd(p, 70000 * np.int32(VALUES)), 'has the value 70000: a segm'),
    'complex': (lambda p: nifti(p, VALUES * np.complex64(1)), 'has voxels of type complex64'),
    'NaN affine': (lambda p: edited(nifti(p), put(280, b'\0\0\xc0\x7f')), '4 x 4 finite numbers'),
    'NaN origin': (lambda p: edited(nrrd(p), lambda c: c.replace(b'(0,0,0)', b'(nan,0,0)')),
                   '4 x 4 finite numbers'),
    'singular affine': (lambda p: edited(nifti(p), put(280, bytes(16))), 'is singular'),
    'parallel axes': (lambda p: nrrd(p, affine=np.array(
        [[1, 1, 0, 0], [0, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])), 'have a cosine of 1 to'),
    'sheared axes': (lambda p: nrrd(p, affine=np.array(
        [[1, 0, 0.1, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])), 'perpendicular axes'),
    'no orientation': (lambda p: nrrd(p, **{'space directions': None}), 'no valid orientation'),
    'meters as mm': (lambda p: nrrd(p, affine=np.diag([2e3, 2e3, 2e3, 1])), 'not of a patient'),
    'other space': (lambda p: nrrd(p, space='left-posterior-inferior'),
                    "has the space 'left-posterior-inferior', valid: right-anterior-superior, "),
    'scanner space': (lambda p: nrrd(p, space='scanner-xyz'), 'valid: right-anterior-superior'),
    'other unit': (lambda p: nrrd(p, **{'space units': ['inch'] * 3}), "unit 'inch', valid: mm"),
    'mixed units': (lambda p: nrrd(p, **{'space units': ['mm', 'mm', 's']}), 'units mm, s'),
    'other encoding': (lambda p: edited(nrrd(p), lambda c: c.replace(b'gzip', b'hex')),
                       "'hex', valid: raw, gzip"),
    'truncated text': (lambda p: edited(nrrd(p, encoding='ascii'), lambda c: c[:-3]),
                       r'it has \d+ of 480 bytes'),
    'words': (lambda p: edited(nrrd(p, encoding='ascii'), lambda c: c[:-2] + b'x'),
              'has voxels that are not numbers'),
    'more text': (lambda p: edited(nrrd(p, encoding='ascii'), lambda c: c + b' 1'),
                  'has more than the 480 bytes'),
    'more than padding': (lambda p: edited(nifti(p), lambda c: c + bytes(513)), 'has more than'),
    'no padding': (lambda p: edited(nifti(p), lambda c: c + b'\0\1'), 'has more than the 60'),
    'two forms': (lambda p: edited(nifti(p, qform=1), put(268, np.float32(3).tobytes())),
                  'an sform and a qform whose corners are up to 3 mm apart: save it with one of'),
    'value of a segment': (lambda p: nrrd(p, Segment0_Name='a', Segment0_LabelValue='x'),
                           "the Segment0_LabelValue 'x', valid: whole numbers"),
    'other voxels': (lambda p: edited(nrrd(p), lambda c: c.replace(b'uint8', b'block')),
                     "has the type 'block', valid: signed char"),
    'two sizes': (lambda p: edited(nrrd(p), lambda c: c.replace(b': 5 4 3', b': 5 12')),
                  'invalid header of NRRD'),
    'no voxels': (lambda p: edited(nrrd(p), lambda c: c.replace(b': 5 4 3', b': 5 0 3')),
                  'has 5 x 0 x 3 voxels'),
    'more data': (lambda p: edited(nrrd(p), lambda c: c.replace(b': 5 4 3', b': 5 4 2')),
                  'has more than the 40 bytes'),
    'line skip': (lambda p: edited(nrrd(p), lambda c: c.replace(b'type', b'line skip: 1\ntype')),
                  'has a line skip'),
    'other folder': (lambda p: edited(nrrd(p), lambda c: c.replace(
        b'type', b'data file: ../a.raw\ntype')), 'not a file beside it'),
    'four axes': (lambda p: nifti(p, np.stack([VALUES] * 2, -1)), r'4 axes \(5 x 4 x 3 x 2\)'),
    'four axes of nrrd': (lambda p: nrrd(p, np.stack([VALUES] * 2)), r'4 axes \(2 x 5 x 4 x 3\)'),
    'truncated': (lambda p: edited(nifti(p), lambda c: c[:-3]), 'it has 57 of 60 bytes'),
    'truncated raw': (lambda p: edited(nrrd(p, encoding='raw'), lambda c: c[:-3]),
                      'it has 57 of 60 bytes'),
    'truncated gzip': (lambda p: edited(nrrd(p), lambda c: c[:-12]), 'is truncated or damaged'),
    'truncated bzip2': (lambda p: edited(nrrd(p, encoding='bzip2'), lambda c: c[:-12]),
                        'is truncated'),
    'wrong checksum': (lambda p: edited(nrrd(p), lambda c: c[:-8] + b'1234' + c[-4:]),
                       'CRC check failed'),
    'truncated nii.gz': (lambda p: edited(nifti(p), lambda c: gzip.compress(c)[:-20], 'a.nii.gz'),
                         'is truncated or damaged'),
    'pair of files': (lambda p: edited(nifti(p), put(344, b'ni1\0')), 'NIfTI file in one part'),
    'no dimensions': (lambda p: edited(nifti(p), put(40, bytes(2))), 'has no voxels|invalid'),
    'negative size': (lambda p: edited(nifti(p), put(42, b'\xff\xff')), 'has -1 x 4 x 3 voxels'),
    'unknown type': (lambda p: edited(nifti(p), put(70, b'\x63\0')), 'invalid header of NIfTI'),
    'data in header': (lambda p: edited(nifti(p), put(108, bytes(4))), 'byte 0, within the head'),
}  # fmt: skip


@pytest.mark.parametrize('name', REJECTED)
def test_invalid_file_is_rejected_in_one_line(name: str, tmp_path: Path) -> None:
    """The line has the file, the value found and the valid values."""
    make, reason = REJECTED[name]
    path = make(tmp_path / 'a')
    labels = write_labels(tmp_path / 'labels.yaml', ROLES)
    with pytest.raises(SegmentationError, match=reason) as error:
        read_anatomy(path, labels)
    assert str(error.value).startswith(f'{path}: ')
    assert len(str(error.value)) < 500 + len(str(path))


@pytest.mark.parametrize(
    ('module', 'name'), [('nibabel', 'a.nii'), ('nrrd', 'a.nrrd'), ('trimesh', 'a.stl')]
)
def test_missing_library_is_named_with_its_extra(
    module: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    labels = write_labels(tmp_path / 'labels.yaml', ROLES)
    (tmp_path / name).write_bytes(b'')
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ParameterError, match=rf"needs {module}: pip install '.*\[plan\]'"):
        read_anatomy(tmp_path / name, labels)


def test_libraries_are_imported_when_a_file_is_read() -> None:
    script = 'import sys, needle_planning.labels\nprint({*sys.argv[1:]} & {*sys.modules})'
    words = [sys.executable, '-c', script, 'nibabel', 'nrrd', 'trimesh']
    assert subprocess.check_output(words, text=True, cwd=ROOT).strip() == 'set()'


def contents() -> dict[str, bytes]:
    """Return valid files by their endings."""
    with TemporaryDirectory() as place:
        path = Path(place, 'a')
        found = {'.nii': nifti(path).read_bytes(), '.nrrd': nrrd(path).read_bytes()}
        found |= {
            '.seg.nrrd': segments(path).read_bytes(),
            '.nii.gz': gzip.compress(found['.nii']),
        }
        found['.raw.nrrd'] = nrrd(path, encoding='raw').read_bytes()
    found['.stl'] = trimesh.creation.box(extents=[9.0] * 3).export(file_type='stl')
    return found


CONTENTS = contents()


def answered(ending: str, content: bytes) -> None:
    """Read a file; a rejection has one line."""
    with TemporaryDirectory() as place:
        path = Path(place, f'a{ending}')
        path.write_bytes(content)
        labels = write_labels(
            Path(place, 'labels.yaml'), {'a': ROLES[1]}, others={'role': 'tissue'}, space='RAS'
        )
        try:
            (anatomy,) = read_anatomy(path, labels)
        except NeedleError as error:
            line = str(error)
        else:
            assert np.all(np.isfinite(anatomy.to_patient))
            line = ', '.join(one.name for one in anatomy.structures.values())
        assert line
        assert line.isprintable()


@settings(max_examples=200)
@given(st.sampled_from(sorted(CONTENTS)), st.binary(max_size=600), st.booleans())
def test_random_bytes_are_read_or_rejected(ending: str, content: bytes, magic: bool) -> None:
    """Also after the begin of a valid file."""
    answered(ending, CONTENTS[ending][:60] + content if magic else content)


@settings(max_examples=600)
@given(
    ending=st.sampled_from(sorted(CONTENTS)),
    changes=st.lists(
        st.tuples(st.integers(0, 700), st.binary(min_size=1, max_size=4), st.integers(0, 4)),
        min_size=1,
        max_size=4,
    ),
)
@example('.nii', [(40, b'\x04\x00', 2)])
@example('.nrrd', [(0, b'NRRD0009', 8)])
def test_mutations_are_read_or_rejected(
    ending: str, changes: list[tuple[int, bytes, int]]
) -> None:
    """Bytes of a valid file are replaced, inserted and removed, also in its header."""
    content = CONTENTS[ending]
    for start, new, removed in changes:
        at = start % len(content)
        content = content[:at] + new + content[at + removed :]
    answered(ending, content)


@settings(max_examples=200)
@given(
    number=st.integers(0, 7),
    value=st.text(st.sampled_from('0123456789.-+eE() ,nainfomsLPSRA"\'\\%'), max_size=20),
)
def test_fields_of_nrrd_are_read_or_rejected(number: int, value: str) -> None:
    """Each field of the header, with any value."""
    head, _, data = CONTENTS['.seg.nrrd'].partition(b'\n\n')
    lines = head.split(b'\n')
    fields = [k for k, line in enumerate(lines) if b': ' in line and line[:1] != b'#']
    at = fields[number % len(fields)]
    lines[at] = lines[at].partition(b':')[0] + b': ' + value.encode()
    answered('.seg.nrrd', b'\n'.join(lines) + b'\n\n' + data)


def header_only(path: Path, shape: tuple[int, ...], kind: str, encoding: str = 'raw') -> Path:
    """Write a header of NRRD for many voxels; they follow as zeros that take no disk space."""
    sizes = ' '.join(map(str, shape))
    path.write_text(
        f'NRRD0005\ntype: {kind}\ndimension: 3\nspace: RAS\nsizes: {sizes}\nendian: little\n'
        'space directions: (1,0,0) (0,1,0) (0,0,1)\nspace origin: (0,0,0)\n'
        f'encoding: {encoding}\n\n'
    )
    return path


def sparse(path: Path, size: int, last: int = 0) -> Path:
    """Append zeros, which take no space on disk, and a byte."""
    with path.open('ab') as stream:
        stream.truncate(stream.tell() + size - 1)
    with path.open('ab') as stream:
        stream.write(bytes([last]))
    return path


def bomb(path: Path) -> Path:
    """Write a small file of gzip that unfolds to 2 GB."""
    header = header_only(path, (64, 64, 64), 'uint8', 'gzip').read_bytes()
    path.write_bytes(header + 32 * gzip.compress(bytes(2**26)))
    return path


def nifti_header(path: Path) -> Path:
    header = nibabel.Nifti1Header()
    header.set_data_shape((2000, 2000, 2000))
    header.set_data_dtype(np.uint8)
    path.write_bytes(header.binaryblock + bytes(4))
    return path


def magic_only(path: Path) -> Path:
    path.write_bytes(b'NRRD0005')
    return sparse(path, 2**31)


#: Large files, and the reason of their rejection, or the shape of the image.
LARGE: dict[str, tuple[Callable[[Path], Path], str]] = {
    'largest': (lambda p: sparse(header_only(p / 'a.nrrd', (512, 512, 1024), 'uint8'), 2**28, 1),
                '(512, 512, 1024)'),
    '2 GB of voxels': (lambda p: sparse(
        header_only(p / 'a.nrrd', (512, 512, 8192), 'uint8'), 2**31),
                       'has 512 x 512 x 8192 voxels, at most 268435456 are read'),
    '2 GB without line end': (lambda p: magic_only(p / 'a.nrrd'), 'is not an NRRD file'),
    'header of 8 GB': (lambda p: nifti_header(p / 'a.nii'), '2000 voxels, at most 268435456 are'),
    'bomb': (lambda p: bomb(p / 'a.nrrd'), 'has more than the 262144 bytes'),
    'large surface': (lambda p: sparse(p / 'a.stl', 2**31), 'at most 67108864 are read'),
}  # fmt: skip


@pytest.mark.parametrize('name', LARGE)
def test_large_file_is_rejected_in_bounded_memory(name: str, tmp_path: Path) -> None:
    """Limits are checked before the voxels are read."""
    make, reason = LARGE[name]
    labels = write_labels(tmp_path / 'labels.yaml', {'a': ROLES[1]}, space='RAS')
    line, memory = measured(make(tmp_path), labels)
    assert reason in line
    assert memory < MEMORY


def measured(path: Path, labels: Path) -> tuple[str, int]:
    """Return the error of a process that reads a file, and its peak memory [kB]."""
    script = (
        'import resource, sys\n'
        'from needle_planning import read_anatomy\n'
        'try:\n    print(read_anatomy(*sys.argv[1:])[0].labels.shape)\n'
        'except ValueError as error:\n    print(error)\n'
        'print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)\n'
    )
    # From a small process, since a child starts with the peak of its parent.
    start = 'import subprocess, sys\nsys.exit(subprocess.call(sys.argv[1:]))'
    words = [sys.executable, '-c', start, sys.executable, '-c', script, str(path), str(labels)]
    said = subprocess.check_output(words, text=True, cwd=ROOT, timeout=300.0).splitlines()
    (line, memory) = said
    return line, int(memory)
