# SPDX-License-Identifier: Apache-2.0
"""Compiled functions: types, cache files and concurrent processes."""

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
from needle_dynamics.compiled import store
from needle_dynamics.compiled.cache import kernels
from needle_dynamics.compiled.store import SUFFIX
from needle_insertion.commands.compile import LATER, MODULES
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]

#: Imports of compiled files whose effect on machine code is covered by the stamp of their
#: sources.
FREE = {'__future__', 'collections', 'math', 'needle_dynamics.arrays', 'numba', 'numpy', 'typing'}

#: Modules of the compiled folder without compiled functions.
MACHINERY = ('cache.py', 'boxed.py', 'store.py')

#: Enforce file permissions also for root: PR_CAPBSET_DROP of CAP_DAC_OVERRIDE.
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
    """Copy the cache modules to a package with a kernel in one folder and a callee in another."""
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
    """Start the kernel in a new process."""
    environment = {**os.environ, 'PYTHONPATH': str(folder), 'PYTHONDONTWRITEBYTECODE': '1'}
    environment.pop('NUMBA_CACHE_DIR', None)
    environment['XDG_CACHE_HOME'] = str(folder.parent / 'home')
    return subprocess.Popen(
        [sys.executable, '-c', WITHOUT_RIGHTS, '-m', 'toy.caller', *words],
        cwd=folder, env={**environment, **variables}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def result(process: Any) -> tuple[list[float], str]:
    """Return the results, the number of compiled functions, and standard error."""
    out, error = process.communicate(timeout=120.0)
    assert process.returncode == 0, error
    return [float(word) for word in out.split()], error


def run(folder: Path, *words: str, **variables: str) -> tuple[list[float], str]:
    """Run the kernel in a new process."""
    return result(start(folder, *words, **variables))


def entries(folder: Path) -> list[Path]:
    """Return the cache files."""
    return sorted(folder.rglob(f'*{SUFFIX}'))


def test_change_of_a_callee_recompiles_its_caller(toy: Path) -> None:
    """Code is compiled once, with one log line, and again after a change of a callee."""
    found, error = run(toy)
    assert found == [4.0, 6.0, 2.0]
    assert error.count('compiling for this machine (once)') == 1
    # Loaded from disk without compilation.
    assert run(toy) == ([4.0, 6.0, 0.0], '')
    callee = toy / 'needle_dynamics' / 'compiled' / 'callee.py'
    times, before = callee.stat(), entries(toy)
    callee.write_text(CALLEE.format(added='2.0'))
    # Size and time of the file are equal; the contents differ.
    os.utime(callee, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert run(toy)[0] == [6.0, 8.0, 2.0]
    # The cache files of the earlier sources are removed.
    assert len(entries(toy)) == len(before)
    assert not {*entries(toy)} & {*before}


def test_copied_installation_needs_no_compilation(toy: Path) -> None:
    """Machine code does not depend on the path of the installation."""
    run(toy)
    shutil.copytree(toy, toy.parent / 'elsewhere')
    assert run(toy.parent / 'elsewhere') == ([4.0, 6.0, 0.0], '')


@pytest.mark.parametrize('damage', ['cut', 'bit', 'empty'])
def test_damaged_cache_file_is_compiled_again(toy: Path, damage: str) -> None:
    run(toy)
    for path in entries(toy):
        content = bytearray(path.read_bytes())
        middle = len(content) // 2
        content[middle] ^= 1
        size = {'cut': middle, 'bit': len(content), 'empty': 0}[damage]
        path.write_bytes(content[:size])
    assert run(toy)[0] == [4.0, 6.0, 2.0]
    assert run(toy)[0] == [4.0, 6.0, 0.0]


def test_concurrent_processes_compile_each_function_once(toy: Path) -> None:
    """The other processes wait for the file and load it."""
    found = [result(process)[0] for process in [start(toy) for _ in range(4)]]
    assert [one[:2] for one in found] == 4 * [[4.0, 6.0]]
    assert sum(one[2] for one in found) == 2.0
    assert run(toy)[0] == [4.0, 6.0, 0.0]


def test_killed_process_leaves_a_consistent_cache(toy: Path) -> None:
    """Its partial files are not read, and its locks are released."""
    for count in range(1, 3):
        process = start(toy)
        # Killed when it starts to write the next file.
        while process.poll() is None and len([*toy.rglob(f'*{SUFFIX}*')]) < count:
            pass
        process.send_signal(signal.SIGKILL)
        process.communicate(timeout=60.0)
    assert run(toy)[0][:2] == [4.0, 6.0]
    assert run(toy)[0] == [4.0, 6.0, 0.0]


def test_other_processors_and_versions_have_separate_cache_files(toy: Path) -> None:
    """Different machines can share a folder, also after an upgrade of Numba."""
    run(toy)
    assert run(toy, NUMBA_CPU_NAME='x86-64', NUMBA_CPU_FEATURES='')[0] == [4.0, 6.0, 2.0]
    assert run(toy, '0.0.1')[0] == [4.0, 6.0, 2.0]
    assert run(toy, NUMBA_CPU_NAME='x86-64', NUMBA_CPU_FEATURES='')[0] == [4.0, 6.0, 0.0]
    assert run(toy)[0] == [4.0, 6.0, 0.0]


def test_code_for_the_processor_level_needs_no_compilation(toy: Path) -> None:
    """A wheel contains it. A process that compiles for the level does not use other code."""
    if not store._is_portable():
        pytest.skip('this processor is below x86-64-v3')
    run(toy)
    assert run(toy, **store.PORTABLE)[0] == [4.0, 6.0, 2.0]
    for path in {*entries(toy)} - {*toy.rglob(f'*{store.PORTABLE_SUFFIX}')}:
        path.unlink()
    make_read_only(toy)
    assert run(toy) == ([4.0, 6.0, 0.0], '')


def make_read_only(folder: Path) -> None:
    """Make an installation read-only for its users."""
    for path in [folder, *folder.rglob('*')]:
        path.chmod(0o555 if path.is_dir() else 0o444)


def test_cache_of_a_read_only_installation_is_used(toy: Path) -> None:
    """Users load the files that the owner has compiled."""
    run(toy)
    make_read_only(toy)
    assert run(toy) == ([4.0, 6.0, 0.0], '')


def test_missing_functions_of_a_read_only_installation_use_the_user_cache(toy: Path) -> None:
    """Missing functions are compiled once, to the cache folder of the user."""
    make_read_only(toy)
    assert run(toy)[0] == [4.0, 6.0, 2.0]
    assert len(entries(toy.parent / 'home')) == len(entries(toy.parent)) == 2
    assert run(toy) == ([4.0, 6.0, 0.0], '')


def test_without_a_writable_folder_each_start_compiles(toy: Path) -> None:
    """The program runs, and one log line contains the folders and the environment variable."""
    make_read_only(toy)
    for _ in range(2):
        found, error = run(toy, XDG_CACHE_HOME='/proc/none')
        assert found == [4.0, 6.0, 2.0]
        assert error.count('\n') == 1
        assert 'no writable folder' in error
        assert '/proc/none' in error
        assert 'NUMBA_CACHE_DIR' in error


def test_clear_deletes_machine_code_only(monkeypatch: Any, tmp_path: Path) -> None:
    monkeypatch.setenv(store.FOLDER_VARIABLE, str(tmp_path))
    for name in (f'a.b-1{SUFFIX}', f'a.c-1{SUFFIX}', 'a.b.cpython-311.pyc', 'results.csv'):
        (tmp_path / name).write_text('1')
    assert store.clear() == 2
    assert {path.name for path in tmp_path.iterdir()} == {'a.b.cpython-311.pyc', 'results.csv'}
    assert store.clear() == 0


def test_compiled_files_depend_only_on_compiled_files() -> None:
    """The stamp covers all functions and constants that a compiled function uses."""
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
    """The command that compiles all kernels is complete."""
    for path in sorted(ROOT.glob('needle_*/**/*.py')):
        if '\n@kernel' in path.read_text() and path.name not in MACHINERY:
            module = '.'.join(path.relative_to(ROOT).with_suffix('').parts)
            assert module in (*MODULES, *LATER), module


def test_annotations_of_kernels_determine_their_types() -> None:
    """Each kernel can be compiled before its first call."""
    from needle_dynamics.compiled.boxed import argument_types
    from needle_dynamics.compiled.cache import _KERNELS

    for name in kernels((*MODULES, *LATER)):
        module, _, own = name.partition(':')
        function = _KERNELS[module][own].py_func
        assert len(argument_types(function)) == function.__code__.co_argcount


SHAPES = st.lists(st.integers(0, 3), min_size=1, max_size=4)


@settings(max_examples=50)
@given(st.sampled_from([np.float64, np.complex128, np.int64, np.bool_]), SHAPES, st.booleans())
def test_annotated_array_type_matches_its_values(
    dtype: Any, shape: list[int], writable: bool
) -> None:
    """An array with the annotated layout needs no further compilation."""
    from typing import Annotated

    from needle_dynamics.arrays import FloatArray, Shaped
    from needle_dynamics.compiled.boxed import numba_type
    import numba

    value = np.zeros(shape, dtype=dtype)
    value.flags.writeable = writable
    hint = Annotated[FloatArray, Shaped(dtype, len(shape), writable)]
    assert numba_type(hint) == numba.typeof(value)


def test_an_annotation_without_a_type_is_rejected() -> None:
    """The error message contains it."""
    from needle_dynamics.arrays import FloatArray
    from needle_dynamics.compiled.boxed import numba_type

    with pytest.raises(TypeError, match='is not a number, an array with dimensions'):
        numba_type(FloatArray)


def test_functions_are_called_with_the_types_that_are_compiled() -> None:
    """Nothing is compiled after `needle compile`: identification, both kinds of batches."""
    code = """
from importlib import import_module

import numpy as np
from needle_dynamics import NEEDLES, NeedleModel, NeedleParameters, insert_batch, simulate_batch
from needle_dynamics.compiled.cache import kernels
from needle_dynamics.compiled.boxed import argument_types
from needle_identification.steering.recording import ORDERS, SimulatedCauses
from needle_identification import SteeringRecording

zero = np.zeros((5, 2))
depth = np.linspace(0.0, 0.1, 5)
one = SteeringRecording(depth=depth, guide=zero, roll=zero[:, 0], tip=zero)
for order in ORDERS:
    SimulatedCauses(one, order, (0.0,)).responses(0.04, 0.035, 0.0)
for needle, steering, _ in NEEDLES.values():
    insert_batch(needle, steering, depth[np.newaxis])
phantom = NeedleParameters.preset('phantom')
start = NeedleModel(phantom).state_at(0.05)
for states in (start, [start, start]):
    simulate_batch([phantom, phantom], states, 3.0, duration=0.1, interval=0.05)
for name in kernels(['needle_dynamics.compiled.cut', 'needle_dynamics.compiled.lanes']):
    module, _, own = name.partition(':')
    found = getattr(import_module(module), own)
    assert {*found.dispatcher.signatures} <= {argument_types(found.py_func)}, name
    print(name, len(found.dispatcher.signatures))
"""
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert 'needle_dynamics.compiled.lanes:run 1' in done.stdout
    assert 'needle_dynamics.compiled.cut:insert 1' in done.stdout
