"""What the benchmark of the control step compares is the same law; never its times."""

from itertools import pairwise

from benchmarks import control as bench_control
from benchmarks.control import NumpyInverseDynamics, PERIOD
from needle_controller import (
    InverseDynamicsGains,
    SampledLoop,
    Setpoint,
)
from needle_dynamics import NeedleParameters
from needle_insertion.cli import main
from needle_insertion.paper.mismatch import sampled_laws
import numpy as np
from numpy.testing import assert_allclose
import pytest

PHANTOM = NeedleParameters.preset('phantom')


def test_the_plain_law_is_ours() -> None:
    plain = NumpyInverseDynamics(PHANTOM, InverseDynamicsGains())
    law = sampled_laws(PHANTOM, PERIOD)['inverse_dynamics']
    ours = SampledLoop(law, bench_control.DELAY, 15.0)
    for k, (before, depth) in enumerate(pairwise(np.linspace(0.1, 0.101, 101))):
        speed, target = (depth - before) / PERIOD, depth + 1e-5
        expected = ours.command(depth, speed, Setpoint(target, 0.01))
        found = plain.command(depth, speed, np.array([target, 0.01, 0.0]))
        if k == 0:
            # The plain one does not know that nothing was on its way: friction stops no needle.
            plain.last = expected
            continue
        assert_allclose(found, expected, rtol=1e-9)


def test_every_job_runs_and_has_a_verdict(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench_control, '_CALLS', 1)
    monkeypatch.setattr(bench_control, '_ROUNDS', 1)
    assert main(['bench', 'control']) == 0
    text = capsys.readouterr().out
    for name in bench_control.jobs():
        assert name in text
    assert text.count('<= 20') == 2
