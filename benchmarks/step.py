# SPDX-License-Identifier: Apache-2.0
"""
Cost of an integration step, and a lower bound from its arithmetic.

The source of the compiled kernel is run on numbers that count their operations. Each kind of
operation is then timed in a separate loop, with the dependencies of the step: the series of the
modes in parallel, other sums and products in eight independent chains, and slow operations
(division, root, sine and cosine, exponentials) in two chains, one per mode.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
import math
from types import FunctionType, SimpleNamespace
from typing import Any, cast, Final, TypeVar
from unittest import mock

from benchmarks.measure import Bar, least_times
from benchmarks.page import Answer, PageSection, Tick
from needle_dynamics import FloatArray, Integrator, NeedleModel, NeedleParameters
from needle_dynamics.compiled.step import advance, Interval
import numba
import numpy as np

#: Depth [m], deflection [m], force [N] and step [s] of the measured steps: nearly the complete
#: open-loop run, since the number of terms of the modes increases with depth.
_DEPTH, _DEFLECTION, _FORCE, _STEP = 0.02, 5e-4, 3.0, 1e-5
_STEPS: Final = 2800

#: Kernel function whose sums and products are parallel series.
SERIES: Final = 'two_modes'

_FUNCTIONS: Final = {
    'sqrt': 'square root',
    'sin': 'sine',
    'cos': 'cosine',
    'exp': 'exp',
    'expm1': 'expm1',
    'log1p': 'log1p',
}

_Function = TypeVar('_Function', bound=Callable[..., object])


def _compiled(function: _Function) -> _Function:
    return cast(_Function, numba.njit(error_model='numpy', nogil=True)(function))


class _Tally:
    """Counts of operations, separately within one function."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._place = ''

    def add(self, operation: str) -> None:
        self.counts[self._place + operation] += 1

    @contextmanager
    def within(self, place: str) -> Iterator[None]:
        """Count under a different name."""
        before, self._place = self._place, place
        yield
        self._place = before


class _Counted(float):
    """Number that counts its operations."""

    tally: _Tally

    def _is(self, operation: str, value: float) -> _Counted:
        self.tally.add(operation)
        return self.__class__(value)

    def __add__(self, other: float) -> _Counted:
        return self._is('add', float(self) + float(other))

    def __sub__(self, other: float) -> _Counted:
        return self._is('add', float(self) - float(other))

    def __rsub__(self, other: float) -> _Counted:
        return self._is('add', float(other) - float(self))

    def __mul__(self, other: float) -> _Counted:
        if isinstance(other, np.ndarray):
            # NumPy then multiplies each element.
            return NotImplemented
        return self._is('multiply', float(self) * float(other))

    def __truediv__(self, other: float) -> _Counted:
        return self._is('divide', float(self) / float(other))

    def __rtruediv__(self, other: float) -> _Counted:
        return self._is('divide', float(other) / float(self))

    def __neg__(self) -> _Counted:
        return self.__class__(-float(self))

    def __abs__(self) -> _Counted:
        return self.__class__(abs(float(self)))

    __radd__ = __add__
    __rmul__ = __mul__


def count_operations(function: Callable[..., object], arguments: tuple[Any, ...]) -> Counter[str]:
    """
    Count the floating-point operations of a call of a compiled function, by kind.

    Calls of compiled functions are followed. Operations in a function of `SERIES` have names with
    the prefix 'series '.
    """
    tally = _Tally()
    number = type('Number', (_Counted,), {'tally': tally})

    def counting(name: str, value: float) -> _Counted:
        tally.add(_FUNCTIONS[name])
        result: _Counted = number(getattr(math, name)(value))
        return result

    # Scratch arrays also contain counted numbers.
    scratch = SimpleNamespace(
        empty=partial(np.empty, dtype=object), zeros=partial(np.zeros, dtype=object)
    )

    made: dict[Any, Callable[..., object]] = {}

    def plain(function: Any) -> Callable[..., object]:
        """Return the Python source of a compiled function with counted operations."""
        if function in made:
            return made[function]
        source = function.py_func
        names = {**source.__globals__, 'np': scratch}
        run = FunctionType(source.__code__, names, None, source.__defaults__)

        def apart(*values: Any) -> object:
            with tally.within('series '):
                return run(*values)

        made[function] = apart if source.__name__ == SERIES else run
        for name, value in source.__globals__.items():
            if hasattr(value, 'py_func'):
                names[name] = plain(value)
            elif name in _FUNCTIONS and value is getattr(math, name):
                names[name] = partial(counting, name)
        return made[function]

    def counted(value: Any) -> Any:
        if isinstance(value, np.ndarray) and value.dtype == np.float64:
            copy = np.empty(value.shape, dtype=object)
            for index, item in np.ndenumerate(value):
                copy[index] = number(item)
            return copy
        if isinstance(value, tuple):
            items = [counted(item) for item in value]
            return value._make(items) if hasattr(value, '_make') else tuple(items)
        return number(value) if isinstance(value, float) else value

    plain(function)(*[counted(value) for value in arguments])
    return tally.counts


def _start() -> tuple[NeedleParameters, FloatArray]:
    parameters = NeedleParameters.preset('paper_si')
    return parameters, NeedleModel(parameters).state_at(_DEPTH, _DEFLECTION)


def operations_of_a_step(steps: int = _STEPS) -> dict[str, float]:
    """Return the mean operations per `Integrator` step (sliding needle, two modes) by kind."""
    counts: list[Counter[str]] = []

    def count(boxed: Any, *arguments: Any) -> tuple[float, Interval]:
        counts.append(count_operations(advance, (boxed.value, *arguments)))
        return 0.0, Interval(*[0.0] * len(Interval._fields))

    with mock.patch('needle_dynamics.simulated.integrator.advance_boxed', count):
        for taken in (1, steps + 1):
            Integrator(*_start(), _STEP).advance(taken * _STEP, _FORCE)
    # The difference cancels operations per call, and the step from rest.
    first, all_of_them = counts
    all_of_them.subtract(first)
    return {name: number / steps for name, number in all_of_them.items() if number}


def _columns_loop(columns: int) -> Callable[[FloatArray, FloatArray, float, int], None]:
    """Return the loop of the series, with the number of columns known to the compiler."""

    @_compiled
    def loop(work: FloatArray, series: FloatArray, z: float, repeats: int) -> None:
        for _ in range(repeats):
            for m in range(series.shape[0]):
                for j in range(columns):
                    work[j] = work[j] * z + series[m, j]

    return loop


@_compiled
def chains(a: float, b: float, repeats: int) -> float:
    """Run eight independent chains of multiply-add; return the sum of the chains."""
    x0, x1, x2, x3, x4, x5, x6, x7 = a, 2.0 * a, 3.0 * a, 4.0 * a, 5.0 * a, 6.0 * a, 7.0 * a, b
    for _ in range(repeats):
        x0 = x0 * a + b
        x1 = x1 * a + b
        x2 = x2 * a + b
        x3 = x3 * a + b
        x4 = x4 * a + b
        x5 = x5 * a + b
        x6 = x6 * a + b
        x7 = x7 * a + b
    return x0 + x1 + x2 + x3 + x4 + x5 + x6 + x7


@_compiled
def _divisions(a: float, b: float, repeats: int) -> float:
    x, y = a, b
    for _ in range(repeats):
        x = b / x
        y = a / y
    return x + y


@_compiled
def _roots(a: float, b: float, repeats: int) -> float:
    x, y = a, b
    for _ in range(repeats):
        x = math.sqrt(x) + a
        y = math.sqrt(y) + b
    return x + y


@_compiled
def _pairs(a: float, b: float, repeats: int) -> float:
    x, y = a, b
    for _ in range(repeats):
        x = math.sin(x) + math.cos(x)
        y = math.sin(y) + math.cos(y)
    return x + y


@_compiled
def _exponentials(a: float, b: float, repeats: int) -> float:
    x, y = a, b
    for _ in range(repeats):
        x = math.exp(-x)
        y = math.exp(-y)
    return x + y


@_compiled
def _exponentials_minus_one(a: float, b: float, repeats: int) -> float:
    x, y = a, b
    for _ in range(repeats):
        x = a - math.expm1(-0.003 * x)
        y = b - math.expm1(-0.003 * y)
    return x + y


@_compiled
def _logarithms(a: float, b: float, repeats: int) -> float:
    x, y = a, b
    for _ in range(repeats):
        x = math.log1p(x) + a
        y = math.log1p(y) + b
    return x + y


#: Loop of each kind, and its operations of this kind per round.
_LOOPS: Final[dict[str, tuple[Callable[[float, float, int], float], int]]] = {
    'multiply-add': (chains, 8),
    'division': (_divisions, 2),
    'square root': (_roots, 2),
    'sine and cosine': (_pairs, 2),
    'exp': (_exponentials, 2),
    'expm1': (_exponentials_minus_one, 2),
    'log1p': (_logarithms, 2),
}


def grouped(counts: Mapping[str, float]) -> dict[str, float]:
    """Group operations by timed kind: products with sums, and sines with cosines."""

    def number(*names: str) -> float:
        return max(counts.get(name, 0.0) for name in names)

    groups = {
        'multiply-add, series': number('series multiply', 'series add'),
        'multiply-add': number('multiply', 'add'),
        'division': number('divide') + number('series divide'),
        'square root': number('square root'),
        'sine and cosine': number('sine', 'cosine'),
        'exp': number('exp'),
        'expm1': number('expm1'),
        'log1p': number('log1p'),
    }
    return {name: count for name, count in groups.items() if count}


def compare(tick: Tick) -> Answer:
    """Measure a step of `Integrator` and the bound from its operations."""
    tick('operations of a step')
    counts = operations_of_a_step()
    groups = grouped(counts)
    parameters, start = _start()
    series = NeedleModel(parameters).modes.tables.series
    work, columns_loop = np.zeros(series.shape[1]), _columns_loop(series.shape[1])
    rounds = 20000

    def run(steps: int) -> None:
        Integrator(parameters, start, _STEP).advance(steps * _STEP, _FORCE)

    jobs: dict[str, Callable[[], object]] = {
        'none': partial(run, 1),
        'steps': partial(run, _STEPS + 1),
        'multiply-add, series': partial(columns_loop, work, series, 0.3, rounds // 100),
        **{
            name: partial(loop, 0.7, 0.6, rounds)
            for name, (loop, _) in _LOOPS.items()
            if name in groups
        },
    }
    tick('cost of a step')
    times = least_times(jobs, 30)
    step = (times['steps'] - times['none']) / _STEPS
    each = {
        name: times[name] / (_LOOPS[name][1] * rounds) if name in _LOOPS else 0.0
        for name in groups
    }
    each['multiply-add, series'] = times['multiply-add, series'] / (rounds // 100 * series.size)
    bound = sum(groups[name] * each[name] for name in groups)
    rows = [
        (name, f'{number:.4g}', f'{each[name] * 1e9:.3g}', f'{number * each[name] * 1e9:.3g}')
        for name, number in groups.items()
    ]
    rows.append(('bound', '', '', f'{bound * 1e9:.3g}'))
    rows.append(('measured', '', '', f'{step * 1e9:.3g}'))
    section = PageSection(
        'Cost of a step',
        ('operation', 'in a step', 'ns each', 'ns in a step'),
        rows,
        f'Two modes, one core, sliding: mean of {_STEPS} steps of {_STEP * 1e6:g} us from '
        f'{_DEPTH * 100:g} cm. A step has {sum(counts.values()):.0f} operations. In the table a '
        f'product and a sum count as one, and so do a sine and a cosine. The bound is the sum of '
        f'the costs, as if no operation overlapped with one of another kind.',
    )
    bars = [
        Bar('cost of a step, two modes', step * 1e9, 600.0, 'ns'),
        Bar('cost of a step over its bound', step / bound, 4.0),
    ]
    return [section], bars
