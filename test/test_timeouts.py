# SPDX-License-Identifier: Apache-2.0
"""Termination of hanging tests, with the stacks of all processes."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import sys

ROOT = Path(__file__).parents[1]

#: Tests that hang in a child process, in the teardown of a failing test, and with the GIL held.
TESTS = '''
import ctypes, subprocess, sys, threading
import pytest

CHILD = """
def hangs_in_a_child():
    print(flush=True)
    input()
hangs_in_a_child()
"""

def test_child():
    child = subprocess.Popen(
        [sys.executable, '-c', CHILD], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    child.stdout.readline()
    child.wait()

@pytest.fixture
def stuck():
    yield
    hangs_in_teardown()

def hangs_in_teardown():
    threading.Event().wait()

def test_teardown(stuck):
    assert False

def test_lock():
    mutex = ctypes.create_string_buffer(64)
    for _ in range(2):
        ctypes.PyDLL(None).pthread_mutex_lock(mutex)

@pytest.mark.parametrize('number', range(5))
def test_good(number):
    pass
'''


def test_hanging_tests_end_with_stacks_and_others_run(tmp_path: Path) -> None:
    (tmp_path / 'test_hangs.py').write_text(TESTS)
    # Half of the limit remains for the report, which takes 0.3 s on an idle machine.
    words = ['-p', 'conftest', '--timeout', '6', '-n', '1', '-v']
    done = subprocess.run(
        [sys.executable, '-m', 'pytest', str(tmp_path), *words],
        env={**os.environ, 'PYTHONPATH': os.pathsep.join([str(ROOT), str(ROOT / 'test')])},
        capture_output=True,
        text=True,
        timeout=600.0,
        check=False,
    )
    # The failing test also hangs in its teardown.
    assert '4 failed, 5 passed' in done.stdout, done
    # pytest captures the output of the child; the ending process writes to standard error.
    assert 'hangs_in_a_child' in done.stdout
    assert 'in hangs_in_teardown' in done.stderr
    assert 'in test_lock' in done.stderr
