"""Compiled functions: their types, their files on disk, and what several processes do to them."""

from __future__ import annotations

import ast
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_dynamics.compiled.cache import kernels
from needle_dynamics.compiled.store import SUFFIX
from needle_insertion.compilation import MODULES
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]

#: Imports of compiled files that do not change machine code without a change of the sources that
#: it is stamped with.
FREE = {'__future__', 'collections', 'math', 'needle_dynamics.arrays', 'numba', 'numpy', 'typing'}

#: Files of the compiled folder that are not compiled.
MACHINERY = ('cache.py', 'held.py', 'signatures.py', 'store.py')

#: Permissions of files then hold for root, too: PR_CAPBSET_DROP of CAP_DAC_OVERRIDE.
WITHOUT_RIGHTS = """
import ctypes, os, sys
ctypes.CDLL(None).prctl(24, 1)
os.execv(sys.executable, [sys.executable, *sys.argv[1:]])
"""

CALLEE = """
from needle_dynamics.compiled.cache import compiled

@compiled
def value(x: float) -> float:
    return x + {added}
"""

CALLER = """
from needle_dynamics.compiled.cache import announce_compilation, kernel, prepare, reports
from needle_dynamics.compiled.callee import value

@kernel
def twice(x: float) -> float:
    return 2.0 * value(x)

if __name__ == '__main__':
    import sys
    from toy.caller import twice
    assert 'numba' not in sys.modules
    import numba
    numba.__version__ = sys.argv[1] if len(sys.argv) > 1 else numba.__version__
    announce_compilation()
    compiled = []
    with reports(lambda name, loaded, _: loaded or compiled.append(name)):
        *_, last = prepare(['toy.caller'])
        assert last == (1, 1, '')
    print(twice(1.0), twice(2.0), len(compiled))
"""


@pytest.fixture
def toy(tmp_path: Path) -> Path:
    """Copy the machinery to a package with a kernel in one folder and a callee in another."""
    folder = tmp_path / 'toys' / 'needle_dynamics' / 'compiled'
    folder.mkdir(parents=True)
    for name in MACHINERY:
        shutil.copy(ROOT / 'needle_dynamics' / 'compiled' / name, folder)
    shutil.copy(ROOT / 'needle_dynamics' / 'arrays.py', folder.parent)
    (tmp_path / 'toys' / 'toy').mkdir()
    for package in (folder, folder.parent, tmp_path / 'toys' / 'toy'):
        (package / '__init__.py').touch()
    (folder / 'callee.py').write_text(CALLEE.format(added='1.0'))
    (tmp_path / 'toys' / 'toy' / 'caller.py').write_text(CALLER)
    return tmp_path / 'toys'


def start(folder: Path, *words: str, **variables: str) -> Any:
    """Start the kernel in a process of its own."""
    environment = {**os.environ, 'PYTHONPATH': str(folder), 'PYTHONDONTWRITEBYTECODE': '1'}
    environment.pop('NUMBA_CACHE_DIR', None)
    environment['XDG_CACHE_HOME'] = str(folder.parent / 'home')
    return subprocess.Popen(
        [sys.executable, '-c', WITHOUT_RIGHTS, '-m', 'toy.caller', *words],
        cwd=folder, env={**environment, **variables}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def result(process: Any) -> tuple[list[float], str]:
    """Return the results, the number of functions that were compiled, and standard error."""
    out, error = process.communicate(timeout=120.0)
    assert process.returncode == 0, error
    return [float(word) for word in out.split()], error


def run(folder: Path, *words: str, **variables: str) -> tuple[list[float], str]:
    """Run the kernel in a process of its own."""
    return result(start(folder, *words, **variables))


def entries(folder: Path) -> list[Path]:
    """Return the entries on disk."""
    return sorted(folder.rglob(f'*{SUFFIX}'))


def test_a_change_of_a_called_function_renews_the_code_of_its_caller(toy: Path) -> None:
    """Code is compiled once, with one line, and again when the file of a callee has changed."""
    found, error = run(toy)
    assert found == [4.0, 6.0, 2.0]
    assert error.count('compiling for this machine (once)') == 1
    # From the disk: nothing is compiled.
    assert run(toy) == ([4.0, 6.0, 0.0], '')
    callee = toy / 'needle_dynamics' / 'compiled' / 'callee.py'
    times, before = callee.stat(), entries(toy)
    callee.write_text(CALLEE.format(added='2.0'))
    # Size and time of the file are the same; its contents count.
    os.utime(callee, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert run(toy)[0] == [6.0, 8.0, 2.0]
    # The entries of the earlier sources are gone.
    assert len(entries(toy)) == len(before)
    assert not {*entries(toy)} & {*before}


def test_a_copy_of_the_folder_is_compiled(toy: Path) -> None:
    """Machine code does not depend on the path of the installation."""
    run(toy)
    shutil.copytree(toy, toy.parent / 'elsewhere')
    assert run(toy.parent / 'elsewhere') == ([4.0, 6.0, 0.0], '')


@pytest.mark.parametrize('damage', ['cut', 'bit', 'empty'])
def test_a_damaged_entry_counts_as_missing(toy: Path, damage: str) -> None:
    """It is compiled again, and is good afterwards."""
    run(toy)
    for path in entries(toy):
        content = bytearray(path.read_bytes())
        middle = len(content) // 2
        content[middle] ^= 1
        size = {'cut': middle, 'bit': len(content), 'empty': 0}[damage]
        path.write_bytes(content[:size])
    assert run(toy)[0] == [4.0, 6.0, 2.0]
    assert run(toy)[0] == [4.0, 6.0, 0.0]


def test_processes_at_once_compile_each_function_once(toy: Path) -> None:
    """The others wait for its file, and load it."""
    found = [result(process)[0] for process in [start(toy) for _ in range(4)]]
    assert [one[:2] for one in found] == 4 * [[4.0, 6.0]]
    assert sum(one[2] for one in found) == 2.0
    assert run(toy)[0] == [4.0, 6.0, 0.0]


def test_a_killed_process_leaves_nothing_wrong(toy: Path) -> None:
    """Its drafts are not read, and its locks have ended with it."""
    for count in range(1, 3):
        process = start(toy)
        # Killed as soon as it has begun to write the next file.
        while process.poll() is None and len([*toy.rglob(f'*{SUFFIX}*')]) < count:
            pass
        process.send_signal(signal.SIGKILL)
        process.communicate(timeout=60.0)
    assert run(toy)[0][:2] == [4.0, 6.0]
    assert run(toy)[0] == [4.0, 6.0, 0.0]


def test_other_processors_and_versions_have_entries_of_their_own(toy: Path) -> None:
    """A folder may be shared by machines that differ, and survives an upgrade of Numba."""
    run(toy)
    assert run(toy, NUMBA_CPU_NAME='x86-64', NUMBA_CPU_FEATURES='')[0] == [4.0, 6.0, 2.0]
    assert run(toy, '0.0.1')[0] == [4.0, 6.0, 2.0]
    assert run(toy, NUMBA_CPU_NAME='x86-64', NUMBA_CPU_FEATURES='')[0] == [4.0, 6.0, 0.0]
    assert run(toy)[0] == [4.0, 6.0, 0.0]


def make_read_only(folder: Path) -> None:
    """Make an installation read-only for its users."""
    for path in [folder, *folder.rglob('*')]:
        path.chmod(0o555 if path.is_dir() else 0o444)


def test_a_read_only_installation_is_used(toy: Path) -> None:
    """Entries that its owner has compiled are loaded by its users."""
    run(toy)
    make_read_only(toy)
    assert run(toy) == ([4.0, 6.0, 0.0], '')


def test_a_user_of_a_read_only_installation_has_a_folder(toy: Path) -> None:
    """Entries that are missing there are compiled once, to the cache folder of the user."""
    make_read_only(toy)
    assert run(toy)[0] == [4.0, 6.0, 2.0]
    assert len(entries(toy.parent / 'home')) == len(entries(toy.parent)) == 2
    assert run(toy) == ([4.0, 6.0, 0.0], '')


def test_without_a_writable_folder_each_start_compiles(toy: Path) -> None:
    """It runs, and one line names the folders and the variable that helps."""
    make_read_only(toy)
    for _ in range(2):
        found, error = run(toy, XDG_CACHE_HOME='/proc/none')
        assert found == [4.0, 6.0, 2.0]
        assert error.count('\n') == 1
        assert 'no writable folder' in error
        assert '/proc/none' in error
        assert 'NUMBA_CACHE_DIR' in error


def test_compiled_files_depend_on_compiled_files_only() -> None:
    """Functions and constants that a compiled function uses are in the sources of its stamp."""
    shared = 'needle_dynamics.compiled'
    for path in sorted(ROOT.glob('needle_*/compiled/*.py')):
        own = '.'.join(path.relative_to(ROOT).parent.parts)
        for node in ast.parse(path.read_text()).body:
            if not isinstance(node, (ast.Import, ast.ImportFrom)) or path.name in MACHINERY:
                continue
            from_one = [str(node.module)] if isinstance(node, ast.ImportFrom) else []
            for module in from_one or [name.name for name in node.names]:
                inside = module.rpartition('.')[0] in (shared, own)
                assert inside or module in FREE or module.split('.')[0] in FREE, (path, module)


def test_every_kernel_is_in_the_list_of_modules() -> None:
    """The command that compiles everything leaves nothing out."""
    for path in sorted(ROOT.glob('needle_*/**/*.py')):
        if '\n@kernel' in path.read_text() and path.name not in MACHINERY:
            module = '.'.join(path.relative_to(ROOT).with_suffix('').parts)
            assert module in MODULES, module


def test_annotations_of_kernels_determine_their_types() -> None:
    """Each kernel can be compiled before its first call."""
    from needle_dynamics.compiled.cache import _KERNELS
    from needle_dynamics.compiled.signatures import argument_types

    for name in kernels(MODULES):
        module, _, own = name.partition(':')
        function = _KERNELS[module][own].py_func
        assert len(argument_types(function)) == function.__code__.co_argcount


SHAPES = st.lists(st.integers(0, 3), min_size=1, max_size=4)


@settings(max_examples=50)
@given(st.sampled_from([np.float64, np.complex128, np.int64, np.bool_]), SHAPES, st.booleans())
def test_the_type_of_an_annotated_array_is_that_of_its_values(
    dtype: Any, shape: list[int], writable: bool
) -> None:
    """An array with the layout of the annotation needs no further compilation."""
    from typing import Annotated

    from needle_dynamics.arrays import FloatArray, Shaped
    from needle_dynamics.compiled.signatures import numba_type
    import numba

    value = np.zeros(shape, dtype=dtype)
    value.flags.writeable = writable
    hint = Annotated[FloatArray, Shaped(dtype, len(shape), writable)]
    assert numba_type(hint) == numba.typeof(value)


def test_an_annotation_without_a_type_is_rejected() -> None:
    """The error names it."""
    from needle_dynamics.arrays import FloatArray
    from needle_dynamics.compiled.signatures import numba_type

    with pytest.raises(TypeError, match='is not a number, an array with dimensions'):
        numba_type(FloatArray)
