# SPDX-License-Identifier: Apache-2.0
"""Verdicts on claims about controllability and observability, sections 3.2.3 to 3.2.6."""

from functools import cache

from needle_dynamics.analysis import Analysis
from needle_insertion.report.controllability import analyze_points
from reproduction.claims.claim import Finding, finding
from reproduction.controllability import DEFLECTIONS, DEPTHS, SPEED
from reproduction.runs import CASES, needle


@cache
def _analyses(deflection: float) -> tuple[Analysis, ...]:
    """Analyze the moving needle at three depths, for both readings and formulations."""
    return tuple(
        point.result
        for case in CASES
        for point in analyze_points(needle(*case), DEPTHS, (deflection,), (SPEED,))
    )


def _controllability() -> Finding:
    """Test state controllability by the ranks."""
    straight, bent = map(_analyses, DEFLECTIONS)
    least, most = ({one.state.rank for one in bent}, {one.state.rank for one in straight})
    return finding(
        {
            'bent': min(least),
            'straight': min(most),
            'distance': min(one.state.distance for one in bent),
        },
        always=least == most == {8},
        sometimes=least == {8},
    )


def _inadequate() -> Finding:
    """Test the inputs by the lateral tip motion per base motion."""
    gains = [one.output_gain for one in _analyses(DEFLECTIONS[-1])]
    return finding({'least': min(gains), 'most': max(gains)}, always=max(gains) < 0.1)


def _modes_observable() -> Finding:
    """Test whether q1, q2 and their rates are observable from the tip."""
    straight, bent = map(_analyses, DEFLECTIONS)
    found = [one.observed for one in (*straight, *bent)]
    hidden = {name for one in found for name in (*one.lost, *one.combined)}
    return finding(
        {'margin': min(one.observed.margin for one in straight)},
        always=not any(name.startswith(('q', 'bending')) for name in hidden),
    )
