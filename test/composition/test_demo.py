# SPDX-License-Identifier: Apache-2.0
"""Checks of the demo, each of which can fail."""

from dataclasses import replace
from math import inf, nan
from pathlib import Path
from typing import Any

from needle_identification import (
    identify_friction,
    identify_stiffness,
    ParameterEstimate,
    read_friction_recording,
    read_indentation_recording,
)
import numpy as np
import pytest
from reproduction import demo
from reproduction.demo import DemoError, run
from reproduction.insertions.insertion import (
    COUNTED,
    insertion_checks,
    RecordedInsertion,
    TARGET_DEPTH,
)
from reproduction.plan import plan_checks
from reproduction.protocol import SHIPPED_BAGS
from reproduction.truth import compare_friction, compare_stiffness, TruthComparison
from support.plans import bowed_plan


def insertion(
    end: float = TARGET_DEPTH, peak: float = TARGET_DEPTH, lag: float = 0.0, complete: float = 1.0
) -> RecordedInsertion:
    """Return a synthetic insertion."""
    time = np.linspace(0.0, 10.0, 1001)
    reference = np.linspace(0.02, TARGET_DEPTH, 1001)
    depth = reference - lag
    depth[-2:] = peak, end
    return RecordedInsertion(
        law='pid',
        depth=np.array([time, depth]),
        reference=np.array([time, reference]),
        tip=np.array([time, time]),
        force=np.array([time, time]),
        completeness=dict.fromkeys(COUNTED, 1.0) | {'base_wrench': complete},
    )


@pytest.mark.parametrize(
    ('changes', 'verdicts'),
    [
        ({}, [True, True, True, True]),
        ({'end': 0.1194}, [False, True, True, True]),
        ({'peak': 0.1212}, [True, False, False, True]),
        ({'lag': 2e-3}, [True, True, False, True]),
        ({'complete': 0.99}, [True, True, True, False]),
        ({'complete': 1.01}, [True, True, True, False]),
    ],
)
def test_insertion_checks_depth_overshoot_tracking_and_messages(
    changes: dict[str, float], verdicts: list[bool]
) -> None:
    """Each check fails for its specific fault only."""
    assert [check.passed for check in insertion_checks(insertion(**changes))] == verdicts


def comparison(value: float, symbol: str = 'k_zz', **changes: Any) -> TruthComparison:
    """Return a synthetic estimate: ground truth 100, half width of the interval 10."""
    estimate: dict[str, Any] = {
        'name': symbol, 'symbol': symbol, 'unit': 'N/m', 'value': value, 'error': 4.0,
        'interval': (value - 10.0, value + 10.0), 'determined': True,
    }  # fmt: skip
    return TruthComparison(estimate=ParameterEstimate(**{**estimate, **changes}), truth=100.0)


@pytest.mark.parametrize(('missed', 'passed'), [(0, True), (4, True), (5, False), (20, False)])
def test_shipped_bags_are_checked_by_interval_coverage(missed: int, passed: bool) -> None:
    """At least 16 of 20 intervals contain the ground truth, for each parameter separately."""
    bags = [
        [comparison(111.0 if k < missed else 109.0), comparison(100.0, symbol='k_xx')]
        for k in range(20)
    ]
    stiff, other = demo._shipped_checks('bags', bags)
    assert stiff.passed == passed
    assert stiff.found == f'in {20 - missed} of 20'
    assert other.passed


@pytest.mark.parametrize(('value', 'passed'), [(119.0, True), (81.0, True), (121.0, False)])
def test_new_recording_is_checked_at_the_worst_force(value: float, passed: bool) -> None:
    """The limit is twice the interval; an undetermined parameter fails."""
    (check,) = demo._fresh_checks([comparison(100.0), comparison(value), comparison(101.0)])
    assert check.passed == passed
    assert check.found.startswith(f'{value:.5g} ')
    (check,) = demo._fresh_checks([comparison(nan, interval=(-inf, inf), determined=False)])
    assert not check.passed


def test_estimates_are_compared_with_the_ground_truth_of_the_same_bag() -> None:
    """All parameters at all levels of the first shipped bags are within a few intervals."""
    friction = read_friction_recording(SHIPPED_BAGS / 'friction_01')
    found = compare_friction(friction, identify_friction(friction))
    assert [one.truth for one in found] == [
        friction.truth['model.coulomb_friction'],
        friction.truth['model.viscous_friction'],
    ]
    press = read_indentation_recording(SHIPPED_BAGS / 'stiffness_01')
    estimate = identify_stiffness(press)
    found += compare_stiffness(press, estimate)
    assert len(found) == 2 + 4 * 5
    for one in found:
        low, high = one.estimate.interval
        assert abs(one.estimate.value - one.truth) < 2.0 * (high - low)


def test_recording_without_ground_truth_is_rejected() -> None:
    """A bag without the configuration of its plant is rejected."""
    recording = read_friction_recording(SHIPPED_BAGS / 'friction_01')
    estimate = identify_friction(recording)
    compared = compare_friction(replace(recording, configuration=''), estimate)
    with pytest.raises(DemoError, match='friction_01 does not hold the configuration'):
        demo._known(SHIPPED_BAGS / 'friction_01', compared)


def test_demo_removes_only_its_own_files(tmp_path: Path) -> None:
    """Folders of other origin are not modified."""
    bags, output = tmp_path / 'bags', tmp_path / 'thesis'
    (bags / 'friction_1').mkdir(parents=True)
    (bags / 'stiffness_1').mkdir()
    output.mkdir()
    (output / 'chapter').touch()
    with pytest.raises(DemoError, match='is not from a demo'):
        run(output, bags)
    assert (output / 'chapter').exists()
    with pytest.raises(DemoError, match='holds no friction recordings'):
        run(output, output)
    (bags / 'stiffness_1').rmdir()
    with pytest.raises(DemoError, match='holds no stiffness recordings'):
        run(tmp_path / 'new', bags)
    assert not (tmp_path / 'new').exists()


@pytest.mark.parametrize(
    ('change', 'verdicts'),
    [
        ({}, [True, True, True]),
        ({'straight_bound': 4e-3}, [False, True, True]),
        ({'straight_bound': 1e-4}, [False, True, True]),
        ({'least': 1.4e-3}, [True, False, True]),
        ({'miss': 2e-4}, [True, True, False]),
    ],
)
def test_plan_is_compared_with_its_bound_and_its_insertion(
    change: dict[str, float], verdicts: list[bool]
) -> None:
    """The plan has a clearance of 1.5 mm and a resolution of 0.5 mm."""
    values = {'straight_bound': 1.8e-3, 'least': 1.5e-3, 'miss': 0.0} | change
    plan = replace(bowed_plan(), straight_bound=values['straight_bound'])
    checks = plan_checks(plan, values['least'], values['miss'])
    assert [check.passed for check in checks] == verdicts
