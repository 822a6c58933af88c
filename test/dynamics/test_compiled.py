"""Compiled functions: their cache on disk, and the word on the terminal."""

from __future__ import annotations

import ast
import os
from pathlib import Path
import shutil
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parents[2]

#: What a compiled function may use besides compiled functions: nothing that changes its code
#: without a change of the sources that its cache is stamped with.
FREE = {'__future__', 'collections', 'math', 'needle_dynamics.arrays', 'numba', 'numpy', 'typing'}

CALLEE = """
from needle_dynamics.compiled.cache import compiled

@compiled
def value(x: float) -> float:
    return x + {added}
"""

CALLER = """
from needle_dynamics.compiled.cache import announce_compilation, compiled
from needle_dynamics.compiled.callee import value

@compiled
def twice(x: float) -> float:
    return 2.0 * value(x)

if __name__ == '__main__':
    import sys
    from toy.caller import twice
    assert 'numba' not in sys.modules
    announce_compilation()
    print(twice(1.0), twice(2.0), sum(twice.dispatcher.stats.cache_hits.values()))
"""


@pytest.fixture
def toy(tmp_path: Path) -> Path:
    """Copy the decorator to a package with a caller in one folder and a callee in another."""
    folder = tmp_path / 'needle_dynamics' / 'compiled'
    folder.mkdir(parents=True)
    shutil.copy(ROOT / 'needle_dynamics' / 'compiled' / 'cache.py', folder)
    (tmp_path / 'toy').mkdir()
    for package in (folder, folder.parent, tmp_path / 'toy'):
        (package / '__init__.py').touch()
    (folder / 'callee.py').write_text(CALLEE.format(added='1.0'))
    (tmp_path / 'toy' / 'caller.py').write_text(CALLER)
    return tmp_path


def run(folder: Path) -> tuple[list[float], str]:
    """Run the caller in a process of its own; return what it prints, and standard error."""
    environment = {**os.environ, 'PYTHONPATH': str(folder)}
    environment.pop('NUMBA_CACHE_DIR', None)
    done = subprocess.run(
        [sys.executable, '-m', 'toy.caller'],
        cwd=folder, env=environment, capture_output=True, text=True, check=True, timeout=120.0,
    )  # fmt: skip
    return [float(word) for word in done.stdout.split()], done.stderr


def test_a_change_of_a_called_function_renews_the_code_of_its_caller(toy: Path) -> None:
    """Code is compiled once, with a word, and again when the file of a callee has changed."""
    found, said = run(toy)
    assert found == [4.0, 6.0, 0.0]
    assert said.count('compiling for this machine') == 1
    # From the disk: one function loaded for one signature, and silent.
    assert run(toy) == ([4.0, 6.0, 1.0], '')
    callee = toy / 'needle_dynamics' / 'compiled' / 'callee.py'
    times = callee.stat()
    callee.write_text(CALLEE.format(added='2.0'))
    # Neither the size nor the time of the file tells: its contents do.
    os.utime(callee, ns=(times.st_atime_ns, times.st_mtime_ns))
    found, said = run(toy)
    assert found == [6.0, 8.0, 0.0]
    assert said.count('compiling for this machine') == 1


def test_no_cache_is_better_than_old_code(toy: Path) -> None:
    """Without the attribute of Numba that takes the stamp, code is compiled anew each time."""
    cache = toy / 'needle_dynamics' / 'compiled' / 'cache.py'
    cache.write_text(cache.read_text().replace('_source_stamp', '_other_name'))
    assert run(toy)[0] == [4.0, 6.0, 0.0]
    assert run(toy)[0] == [4.0, 6.0, 0.0]


def test_compiled_files_depend_on_compiled_files_only() -> None:
    """What a compiled function calls, and its constants, are in the sources of its stamp."""
    shared = 'needle_dynamics.compiled'
    for path in sorted(ROOT.glob('needle_*/compiled/*.py')):
        own = '.'.join(path.relative_to(ROOT).parent.parts)
        for node in ast.parse(path.read_text()).body:
            if not isinstance(node, (ast.Import, ast.ImportFrom)) or path.name == 'cache.py':
                continue
            from_one = [str(node.module)] if isinstance(node, ast.ImportFrom) else []
            for module in from_one or [name.name for name in node.names]:
                inside = module.rpartition('.')[0] in (shared, own)
                assert inside or module in FREE or module.split('.')[0] in FREE, (path, module)
