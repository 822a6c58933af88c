# SPDX-License-Identifier: Apache-2.0
"""Open-loop run of four needles: our orders and the solvers of one call, at equal errors."""

from __future__ import annotations

from functools import partial
from math import inf
from typing import Final

from benchmarks.measure import Bar, least_times, number
from benchmarks.page import Answer, PageSection, Tick
from benchmarks.solvers import ACCURACY, ONE_CALL, OpenLoopCase
from needle_dynamics.simulated.trajectory import ORDERS

#: The paper's needle, and a needle that bends in stiffer tissue.
_NEEDLES: Final = ('paper_si', 'paper_mm', 'phantom', 'bending_35mm')

#: Errors, over the peak of the tip deflection.
_ACCURACIES: Final = (1e-2, ACCURACY, 1e-4, 1e-5, 1e-6, 1e-8)

#: Required ratio of the times of the best other solver and of ours, at an error.
_RATIOS: Final = {ACCURACY: 2.0, 1e-6: 1.0}

_SECOND: Final = 1e-7  #: error below which a method of second order is not measured
_GRID: Final = 1e-4  #: sampling interval of our error [s]


def compare(tick: Tick) -> Answer:
    """Compare the times at several errors with the solvers that run in one call."""
    rows = []
    least = dict.fromkeys(_RATIOS, inf)
    for preset in _NEEDLES:
        case = OpenLoopCase(preset)
        for accuracy in _ACCURACIES:
            tick(f'{preset}, error {accuracy:g}')
            orders = ORDERS if accuracy > _SECOND else ORDERS[1:]
            own = [
                case.ours(graded=True, accuracy=accuracy, order=order, spacing=_GRID)
                for order in orders
            ]
            others = [case.other(method, accuracy) for method in ONE_CALL]
            times = least_times(
                {one.name: partial(one.run, case.right_hand_side) for one in (*own, *others)}, 9
            )
            ratio = min(times[one.name] for one in others) / min(times[one.name] for one in own)
            figures = [number(spent * 1e3) for spent in times.values()]
            missing = ['-'] * (len(ORDERS) - len(orders))
            rows.append((preset, f'{accuracy:g}', *missing, *figures, f'{number(ratio)} x'))
            if accuracy in least:
                least[accuracy] = min(least[accuracy], ratio)
    section = PageSection(
        'Work and precision',
        (
            'needle',
            'error / peak',
            *(f'ours, order {order}' for order in ORDERS),
            *ONE_CALL,
            'best of them / best of ours',
        ),
        rows,
        'Wall times [ms] of the same run, with graded steps, the compiled right-hand side, and '
        'each solver at the loosest setting that meets the error.',
    )
    return [section], [
        Bar(
            f'open loop, best of the others at an error of {accuracy:g}',
            ratio,
            _RATIOS[accuracy],
            'x ours',
            at_least=True,
        )
        for accuracy, ratio in least.items()
    ]
