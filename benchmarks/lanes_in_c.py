# SPDX-License-Identifier: Apache-2.0
"""The step of needles that are simulated together, in C (`lanes.c`), compiled when it is used."""

from __future__ import annotations

from collections.abc import Callable
import ctypes
from pathlib import Path
import shutil
import subprocess
from tempfile import TemporaryDirectory
from typing import Final, TypeAlias

from needle_dynamics import FloatArray

#: Options for vector instructions with the arithmetic of our code, without fused operations.
OPTIONS: Final = (
    '-O3', '-march=native', '-mprefer-vector-width=512', '-fno-math-errno', '-fno-trapping-math',
    '-ffp-contract=off',
)  # fmt: skip

#: Advances states, shape (runs, 8), by constants, table, force [N], duration and first step [s].
Run: TypeAlias = Callable[[FloatArray, FloatArray, float, float, float, FloatArray], None]


def build() -> Run | None:
    """Compile and load the function; None without a C compiler."""
    compiler = shutil.which('cc')
    if compiler is None:
        return None
    source = Path(__file__).with_name('lanes.c')
    with TemporaryDirectory() as folder:
        library = Path(folder) / 'lanes.so'
        words = [compiler, *OPTIONS, '-shared', '-fPIC', '-o', str(library), str(source), '-lm']
        subprocess.run(words, check=True)
        function = ctypes.CDLL(str(library)).run
    pointer, number = ctypes.POINTER(ctypes.c_double), ctypes.c_double
    function.argtypes = [
        pointer, pointer, ctypes.c_int, ctypes.c_int, number, number, number, pointer
    ]  # fmt: skip
    function.restype = None

    def run(
        needles: FloatArray,
        table: FloatArray,
        force: float,
        duration: float,
        longest: float,
        states: FloatArray,
    ) -> None:
        arrays = [one.ctypes.data_as(pointer) for one in (needles, table, states)]
        sizes = len(table), len(states)
        function(arrays[0], arrays[1], *sizes, force, duration, longest, arrays[2])

    return run
