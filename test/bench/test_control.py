# SPDX-License-Identifier: Apache-2.0
"""Benchmark of the control step: equality of the compared laws; times are not tested."""

from itertools import pairwise

from benchmarks import control as bench_control
from benchmarks.control import FloatInverseDynamics, NumpyInverseDynamics, PERIOD
from needle_controller import InverseDynamicsGains, Setpoint
from needle_controller.laws.law import SampledLoop
from needle_dynamics import NeedleParameters
import numpy as np
from numpy.testing import assert_allclose
import pytest
from reproduction.mismatch import sampled_laws

PHANTOM = NeedleParameters.preset('phantom')


@pytest.mark.parametrize('program', ['NumPy', 'floats'])
def test_compared_law_equals_package_law(program: str) -> None:
    kind = NumpyInverseDynamics if program == 'NumPy' else FloatInverseDynamics
    plain = kind(PHANTOM, InverseDynamicsGains())
    law = sampled_laws(PHANTOM, PERIOD)['paper_inverse_dynamics']
    ours = SampledLoop(law, bench_control.DELAY, 15.0)
    for k, (before, depth) in enumerate(pairwise(np.linspace(0.1, 0.101, 101))):
        speed, target = (depth - before) / PERIOD, depth + 1e-5
        expected = ours.command(depth, speed, Setpoint(target, 0.01))
        if isinstance(plain, NumpyInverseDynamics):
            found = plain.command(depth, speed, np.array([target, 0.01, 0.0]))
        else:
            found = plain.command(depth, speed, target, 0.01, 0.0)
        if k == 0:
            # The compared law has no pending command at the start: friction stops no needle.
            plain.last = expected
            continue
        assert_allclose(found, expected, rtol=1e-9)


def test_every_job_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_control, '_CALLS', 1)
    monkeypatch.setattr(bench_control, '_ROUNDS', 1)
    [section], bars = bench_control.compare(lambda _stage: None)
    assert [row[0] for row in section.rows] == list(bench_control.jobs())
    assert [bar.limit for bar in bars] == 3 * [bench_control.BUDGET]
