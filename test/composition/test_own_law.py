# SPDX-License-Identifier: Apache-2.0
"""A steering law in a file outside the package: in the executive, `needle steer` and a study."""

from __future__ import annotations

import json
from pathlib import Path
import sys
from typing import Any

from needle_controller import build_law, GuideLaw, GuideSetpoint, SteeringLimits, SteeringModel
from needle_controller.steering.law import LawError
from needle_insertion.cli import main
from needle_ros.errors import ParameterError
from needle_study.study import build_study
import numpy as np
import pytest
from support.steered_robot import CONTINUOUS, NEEDLE, Robot, SETTINGS, STEERING

EXAMPLES = Path(__file__).parents[2] / 'examples'
OWN = 'steering_law:NominalLaw'


@pytest.fixture(autouse=True)
def _examples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)


class FaultyLaw:
    """A law whose plan is an error or outside the limits, at a step."""

    warning = ''
    plans: Any = None

    def __init__(self, _model: SteeringModel, target: Any, *_limits: Any) -> None:
        self.step, self.target = 0, np.array(target)

    def aim(self, target: Any) -> None:
        self.target = np.array(target)

    def update(self, tip: Any, at: int, noise: float = 0.0) -> None:
        pass

    def plan(self) -> GuideSetpoint:
        self.step += 1
        return FaultyLaw.plans(self.step)

    def expected(self) -> None:
        return None

    def status(self) -> dict[str, float]:
        return {}


@pytest.mark.parametrize('own', [SETTINGS, CONTINUOUS], ids=['stepped', 'continuous'])
def test_own_law_steers_the_needle_of_a_robot(own: Any) -> None:
    """Within 0.5 mm, a sixth of the drift without steering."""
    miss = {}
    for law in (OWN, 'open_loop'):
        robot = Robot(own, law=law)
        robot.steer()
        assert robot.loop.fault == ''
        miss[law] = robot.miss
        assert robot.loop.diagnose(robot.now)[1].startswith('done: the tip is at x = ')
    assert miss[OWN] < 5e-4 < 3e-3 < miss['open_loop']


def test_own_law_steers_in_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['steer', '--json', '--law', OWN]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found['miss [m]'] < 5e-4 < 5e-3 < found['miss open loop [m]']
    assert found['expected tip [m]'] is None


def test_law_of_the_current_folder_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'law_of_this_folder.py').write_text(
        'from needle_controller import GuideLaw\n\n\n'
        'class Gain(GuideLaw):\n'
        '    def choose(self, tip, at):\n'
        '        return 0.5 * (tip - self.target)\n'
    )
    monkeypatch.setattr('sys.path', [*sys.path])
    monkeypatch.chdir(tmp_path)
    assert main(['steer', '--json', '--law', 'law_of_this_folder:Gain']) == 0
    assert json.loads(capsys.readouterr().out)['miss [m]'] > 0.0


def test_own_law_steers_in_a_study() -> None:
    """Bit-identical to the same needles inserted alone."""
    study = build_study({
        'scenario': 'steering', 'samples': 8, 'seed': 3, 'settings': {'law': OWN},
        'population': {'target_x': {'uniform': [-0.002, 0.002]}, 'tilt_z': {'normal': [0, 0.01]}},
    })  # fmt: skip
    found = study.rows(0, 8)
    assert found['miss'].max() < 1e-3
    assert found['refused'].sum() == found['stopped'].sum() == 0.0
    assert study.rows(5, 1)['miss'] == found['miss'][5]


@pytest.mark.parametrize(
    ('name', 'complaint'),
    [
        ('mine', r"law must be one of multi_hypothesis, springs, .* module:Class, got 'mine'$"),
        ('steering_law:Other', "'steering_law:Other' cannot be imported: .* 'Other'$"),
        ('no_such_module:Law', "'no_such_module:Law' cannot be imported: No module named"),
        (
            'needle_controller:SteeringPrior',
            "'needle_controller:SteeringPrior' is no steering law",
        ),
        (
            'types:SimpleNamespace',
            'is no steering law: it lacks aim, update, plan, expected, status',
        ),
        ('os:system', "law 'os:system' is no steering law: it lacks aim, update,"),
        ('needle_controller:GuideLaw', 'cannot be constructed: '),
    ],
)
def test_invalid_law_is_rejected_in_one_line(
    name: str, complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ParameterError, match=complaint):
        build_law(name, SteeringModel(NEEDLE, STEERING, [0.0, 0.01]), (0.0, 0.0), SteeringLimits())
    assert main(['steer', '--law', name]) == 2
    said = capsys.readouterr().err
    assert said.startswith('error: law ')
    assert said.count('\n') == 1


@pytest.mark.requirement('S-135')
@pytest.mark.parametrize(
    ('plan', 'fault'),
    [
        (lambda _: GuideSetpoint(7e-3, 0.0), 'requests the guide at x = 7.000 mm'),
        (lambda _: GuideSetpoint(0.0, np.nan), 'requests the guide at x = 0.000 mm, z = nan mm'),
        (lambda _: GuideSetpoint(0.0, 3e-3), 'requests a guide motion of 3.000 mm in a step'),
        (lambda step: GuideSetpoint(0.0, 1e-3 / (3 - step)), 'ZeroDivisionError'),
        (lambda _: None, 'FaultyLaw has failed: plan must return a GuideSetpoint, got None'),
        (lambda _: sys.exit(0), 'FaultyLaw has failed: SystemExit(0)'),
        (lambda step: GuideSetpoint(0.0, 0.0, step), 'requests turn 1 of the needle'),
    ],
)
def test_fault_of_a_law_stops_the_insertion(plan: Any, fault: str) -> None:
    """A setpoint outside the limits and an exception; the guide receives no such motion."""
    FaultyLaw.plans = plan
    robot = Robot(law=f'{__name__}:FaultyLaw')
    robot.steer()
    assert fault in robot.loop.fault
    assert np.abs(np.array(robot.tracked)[:, 1:]).max() < 2e-3


class FaultyGuide(GuideLaw):
    """A law whose choice has the wrong form."""

    choice: Any = None

    def choose(self, tip: Any, at: int) -> Any:  # noqa: ARG002
        return self.choice


def failed_steering(law: type, capsys: pytest.CaptureFixture[str]) -> str:
    """Run `needle steer` with a law that fails; return its only line without the name."""
    words = ['--target', '2mm,50mm,1mm', '--limit', '1mm']
    name = f'{__name__}:{law.__name__}'
    assert main(['steer', '--law', name, *words]) == 1
    found = capsys.readouterr()
    assert found.out == ''
    begin, line = f'error: the steering law {name} ', found.err
    assert line.startswith(begin)
    assert line.count('\n') == 1
    return line.removeprefix(begin).rstrip('\n')


@pytest.mark.parametrize(
    ('plan', 'fault'),
    [
        (lambda _: GuideSetpoint(0.05, 0.0), 'requests the guide at x = 50.000 mm'),
        (lambda _: GuideSetpoint(np.nan, 0.0), 'requests the guide at x = nan mm'),
        (lambda _: GuideSetpoint(0.0, 0.0, 1.0), 'requests turn 1 of the needle, to a roll of'),
        (lambda _: None, 'has failed: plan must return a GuideSetpoint, got None'),
        (lambda step: GuideSetpoint(1e-4 / (3 - step), 0.0), 'has failed: ZeroDivisionError('),
        (lambda _: sys.exit(0), 'has failed: SystemExit(0)'),
    ],
)
def test_fault_of_a_law_ends_the_command_in_one_line(
    plan: Any, fault: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(FaultyLaw, 'plans', plan)
    assert failed_steering(FaultyLaw, capsys).startswith(fault)


@pytest.mark.parametrize(
    ('member', 'value', 'fault'),
    [
        ('plan', lambda _: GuideSetpoint(0.0, 0.0), 'step must be 1 after plan 1, got 0'),
        ('expected', lambda _: (0.0, 0.0), 'expected must return a TipEstimate or None, got (0.'),
        ('status', lambda _: None, 'AttributeError('),
        ('warning', property(lambda law: 1 / (1 - law.step)), 'ZeroDivisionError('),
        ('update', lambda *_: 1 / 0, 'ZeroDivisionError('),
    ],
)  # fmt: skip
def test_failed_member_of_a_law_ends_the_command_in_one_line(
    member: str, value: Any, fault: str,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setattr(FaultyLaw, 'plans', lambda _: GuideSetpoint(0.0, 0.0))
    monkeypatch.setattr(FaultyLaw, member, value)
    assert failed_steering(FaultyLaw, capsys).startswith(f'has failed: {fault}')


@pytest.mark.parametrize('choice', [None, 1e-3, [0.0, 0.0, 0.0], [np.nan, 0.0], 'left', [1j, 0.0]])
def test_choice_of_a_guide_law_is_two_finite_numbers(
    choice: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(FaultyGuide, 'choice', choice)
    line = failed_steering(FaultyGuide, capsys)
    assert line.startswith('has failed: choose must return x and z of the guide [m], finite, got ')


def test_study_counts_setpoints_beyond_a_limit_and_ends_if_a_law_fails(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    study = build_study({
        'scenario': 'steering', 'samples': 2,
        'settings': {'law': f'{__name__}:FaultyLaw', 'depth': 0.02},
    })  # fmt: skip
    monkeypatch.setattr(FaultyLaw, 'plans', lambda _: GuideSetpoint(7e-3, 0.0))
    assert study.rows(0, 2)['stopped'].tolist() == [1.0, 1.0]
    monkeypatch.setattr(FaultyLaw, 'plans', lambda _: None)
    with pytest.raises(LawError, match='FaultyLaw has failed: plan must return a GuideSetpoint'):
        study.rows(0, 2)


@pytest.mark.parametrize('where', ['module', 'constructor'])
def test_law_that_exits_is_rejected_in_one_line(
    where: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    name = f'law_that_exits_in_its_{where}'
    inside = 'class Law:\n    def __init__(self, *_):\n        ' if where == 'constructor' else ''
    (tmp_path / f'{name}.py').write_text(f'import sys\n\n\n{inside}sys.exit(0)\n')
    monkeypatch.syspath_prepend(tmp_path)
    assert main(['steer', '--law', f'{name}:Law']) == 2
    assert capsys.readouterr().err.count('\n') == 1


@pytest.mark.requirement('S-135')
@pytest.mark.parametrize(
    ('member', 'value', 'fault'),
    [
        ('status', lambda law: {'gain': 1.0 / (2 - law.step)}, 'ZeroDivisionError'),
        ('status', lambda law: {'gain': 'high' if law.step > 1 else 1.0}, 'ValueError'),
        ('warning', property(lambda law: 1 / (2 - law.step)), 'ZeroDivisionError'),
        (
            'target', property(lambda law: np.zeros(2 + (law.step > 1)), lambda _, __: None),
            'the target of a law must be x and z, got shape (3,)',
        ),
    ],
)  # fmt: skip
def test_failed_report_of_a_law_stops_the_insertion(
    monkeypatch: pytest.MonkeyPatch, member: str, value: Any, fault: str
) -> None:
    """Its members fail with its calls, not when the node publishes its status."""
    FaultyLaw.plans = lambda _: GuideSetpoint(0.0, 0.0)
    monkeypatch.setattr(FaultyLaw, member, value, raising=False)
    robot = Robot(law=f'{__name__}:FaultyLaw')
    robot.steer()
    assert fault in robot.loop.fault


@pytest.mark.parametrize('law', ['springs', 'open_loop'])
@pytest.mark.parametrize(
    ('sees', 'fault'),
    [
        (lambda _tip: None, '7 tip measurements are missing'),
        (lambda tip: np.array([1e-3, tip[1], 0.0]), 'frozen: 3 identical measurements'),
    ],
)
def test_fault_of_the_sensor_stops_any_law(law: str, sees: Any, fault: str) -> None:
    robot = Robot(law=law)
    robot.tick(20)
    assert robot.aim() == ''
    robot.tick(300)
    robot.sees = sees
    robot.tick(4000)
    assert fault in robot.loop.fault
