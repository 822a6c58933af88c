# SPDX-License-Identifier: Apache-2.0
"""`needle study` with the scenario `insertion`: a flexible needle pushed to a depth."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
import re
from typing import Any

from needle_controller import (
    Controller,
    ControllerOutput,
    ControllerSettings,
    Measurement,
    Observer,
    ObserverSettings,
    run_controller,
    SafetyLimits,
)
from needle_controller.in_loop.observed import TipObserver
from needle_controller.load_estimator import LoadEstimator
from needle_controller.safety.safety import Guard
from needle_dynamics import NeedleModel, NeedleParameters
from needle_identification.bags.bag import message_counts, read_topic
from needle_insertion.cli import main
from needle_ros.errors import ParameterError
from needle_ros.process_pool import processes
from needle_study.engine import compute, Results
from needle_study.insertion import CONTROLLERS, METRICS
from needle_study.study import build_study
from needle_study.summary import column
import numpy as np
import pytest
from support.studies import check_refused
import yaml

PHANTOM = NeedleParameters.preset('phantom')

#: Short insertions, from 2 cm.
POPULATION: dict[str, Any] = {
    'target': {'uniform': [0.025, 0.03]},
    'depth': {'uniform': [0.018, 0.02]},
    'tip': {'normal': [0.0, 2e-4], 'within': [-6e-4, 6e-4]},
    'coulomb_friction': {'lognormal': [1.0, 0.2], 'within': [0.5, 2.0]},
    'viscous_friction': {'lognormal': [1.0, 0.2], 'within': [0.5, 2.0]},
    'carriage_mass': {'uniform': [0.0, 0.2]},
    'tissue_stiffness': {'uniform': [0.5, 2.0]},
    'tissue_damping': {'uniform': [0.5, 2.0]},
    'depth_noise': {'choice': [0.0, 2e-6]},
    'velocity_noise': {'choice': [0.0, 2e-4]},
    'force_noise': {'choice': [0.0, 0.05]},
    'late': {'choice': [0, 2]},
}
SMALL: dict[str, Any] = {
    'scenario': 'insertion',
    'samples': 24,
    'seed': 5,
    'settings': {'wait': 0.5},
    'population': POPULATION,
}


def one(settings: dict[str, Any] | None = None, **drawn: float) -> dict[str, float]:
    """Return the metrics of one sample with given values."""
    scenario = build_study({**SMALL, 'settings': settings or {}, 'population': {}}).scenario
    rows = {name: np.array([value]) for name, value in drawn.items()}
    found = scenario.run(rows, [np.random.default_rng(1)])
    assert list(found) == list(METRICS)
    return {name: float(values[0]) for name, values in found.items()}


@pytest.mark.parametrize('controller', CONTROLLERS)
@pytest.mark.parametrize('design', ['sobol', 'latin'])
def test_samples_are_independent_of_chunks(controller: str, design: str) -> None:
    """Bit-identical for all variables."""
    settings = {'wait': 0.2, 'controller': controller}
    study = build_study({**SMALL, 'settings': settings, 'design': design})
    whole = study.rows(0, 20)
    assert not np.isnan(whole['error']).any()
    for first, count in ((0, 1), (1, 2), (3, 17)):
        part = study.rows(first, count)
        assert list(part) == list(whole)
        for name, values in part.items():
            assert np.array_equal(values, whole[name][first : first + count], equal_nan=True)


def test_table_is_independent_of_the_workers(tmp_path: Path) -> None:
    study, tables = build_study({**SMALL, 'settings': {'wait': 0.2}}), []
    for workers in (1, 2):
        results = Results(tmp_path / str(workers), study)
        compute(results, partial(processes, workers), workers, lambda _: None)
        tables.append(results.table.read_bytes())
    assert tables[0] == tables[1]


class Late:
    """Controller with an additional delay that is not in its model."""

    def __init__(self, controller: Controller, late: int) -> None:
        self._controller = controller
        self.period, self.delay = controller.period, controller.delay + late

    def command(self, measured: Measurement, load: float = 0.0) -> ControllerOutput:
        return self._controller.command(measured, load)


@pytest.mark.parametrize('law', ['adaptive', 'inverse_dynamics', 'pid'])
@pytest.mark.parametrize('late', [0, 3])
def test_metrics_match_the_controller_of_the_node(law: str, late: int) -> None:
    """The metrics equal those of the controller object of the node on the same needle."""
    settings = {'controller': law, 'step': 1e-5, 'reference': 'minimum_jerk', 'wait': 0.5}
    drawn = {'target': 0.025, 'depth': 0.02, 'tip': 3e-4, 'coulomb_friction': 1.3,
             'viscous_friction': 0.8, 'carriage_mass': 0.1, 'tissue_damping': 0.5}  # fmt: skip
    found = one(settings, **drawn, late=float(late))
    p = replace(
        PHANTOM,
        coulomb_friction=1.3 * PHANTOM.coulomb_friction,
        viscous_friction=0.8 * PHANTOM.viscous_friction,
        carriage_mass=0.1,
        tissue_damping=0.5 * PHANTOM.tissue_damping,
    )
    controller = Controller(
        PHANTOM, law, reference='minimum_jerk', settings=ControllerSettings(rotation=False)
    )
    controller.set_target(0.025)
    # Duration: 15/8 D / v, which exceeds the limit by the acceleration, plus the wait.
    duration = round(1e3 * (1.875 * 0.005 / 0.01 + 0.5)) * 1e-3
    run = run_controller(
        Late(controller, late), p, NeedleModel(p).state_at(0.02, 3e-4), duration=duration
    )
    # The same steps with the compiled and the Python controller: rounding, which a closed loop
    # with dry friction amplifies for a sample at start and stop.
    assert found['error'] == pytest.approx(abs(0.025 - run.depth[-1]), abs=1e-11)
    assert found['overshoot'] == pytest.approx(max(0.0, run.depth.max() - 0.025), abs=1e-11)
    assert found['force'] == pytest.approx(np.abs(run.forces[:, 0]).max(), rel=1e-6)
    assert found['deflection'] == pytest.approx(np.abs(run.tip_deflection).max(), rel=1e-9)
    assert found['stopped'] == found['left'] == 0.0


def test_observer_is_that_of_the_node_on_the_replayed_measurements() -> None:
    """The commands of a replayed sample, from its encoders and tip measurements."""
    settings = {'controller': 'inverse_dynamics', 'reference': 'minimum_jerk', 'wait': 0.2}
    study = build_study({
        **SMALL, 'settings': {**settings, 'observer': {'tip_force': 0.1}}, 'population': {},
    })  # fmt: skip
    drawn = {'target': 0.103, 'depth': 0.1, 'tip': 2e-3, 'tissue_stiffness': 1.4,
             'velocity_noise': 1e-4, 'tip_noise': 2e-4}  # fmt: skip
    replayed: dict[str, list[Any]] = {}
    for topic, _, values in study.scenario.replay(drawn, study.design.noise(0)):
        replayed.setdefault(topic.name, []).append(values)
    controller = Controller(
        PHANTOM, 'inverse_dynamics', reference='minimum_jerk',
        settings=ControllerSettings(rotation=False),
    )  # fmt: skip
    controller.set_target(0.103)
    used = TipObserver(PHANTOM, ObserverSettings(tip_force=0.1), 1e-3, 100.0).used
    estimator = LoadEstimator(PHANTOM, Observer(PHANTOM, used, 1e-3))
    expected, loads, errors = [], [], []
    commands = [values[1] for values in replayed['wrench_command']]
    for k in range(len(commands)):
        joints, (_, depth, tip) = replayed['joint_states'][k], replayed['tip_deflection'][k]
        assert joints[0] == depth
        measured = Measurement(time=1e-3 * k, depth=joints[0], velocity=joints[2])
        expected.append(controller.command(measured, estimator.load).force)
        estimator.take_tip(1_000_000 * k, tip)
        estimator.take_encoders(1_000_000 * k, measured)
        estimator.update()
        loads.append(estimator.load)
        errors.append(tip - estimator.observer.tip_deflection[0] if estimator.observer else 0.0)
    # Rounding of the law, amplified by the gain of a measured velocity.
    np.testing.assert_allclose(commands, expected, atol=1e-8)
    assert np.abs(loads).max() > 1e-3
    # The tip is measured with noise, and estimated with less: five standard errors.
    late = np.array(errors[-150:])
    assert late.std() == pytest.approx(2e-4, rel=0.3)
    # The vibration at the start is larger than the noise, the residual of the estimate smaller.
    tips = np.array([values[2] for values in replayed['tip_deflection']])[: len(errors)]
    first = slice(1, 31)
    assert np.sqrt(np.mean(tips[first] ** 2)) > 3.0 * 2e-4
    assert np.sqrt(np.mean(np.array(errors[first]) ** 2)) < 2e-4
    # The needle is straight at the end: a copy of the measurements would have their noise.
    assert np.sqrt(np.mean((tips[-150:] - late) ** 2)) < 0.5 * 2e-4


def test_invalid_observers_are_refused() -> None:
    for settings, message in (
        ({'observer': True, 'controller': 'open loop'}, 'observer is for adaptive'),
        ({'observer': 3}, 'observer must be names with values, got 3'),
        ({'observer': {'force_noise': 1.0}}, "unknown parameter 'force_noise'"),
        ({'observer': {'history': 1e-4}}, 'period must be > 0 and < history'),
        ({'observer': {'tip_noise': 0.0}}, 'settings.observer.tip_noise must be'),
    ):
        with pytest.raises(ParameterError) as caught:
            build_study({**SMALL, 'settings': settings, 'population': {}})
        assert message in str(caught.value)
    with pytest.raises(ParameterError, match='tip_noise'):
        build_study({**SMALL, 'population': {'tip_noise': {'uniform': [0.0, 1e-4]}}})


def test_model_mismatch_increases_the_tracking_error() -> None:
    """Exact parameters hit the target; unmodeled friction or delay degrades the tracking."""
    settings = {'controller': 'inverse_dynamics'}
    known = one(settings, target=0.03)
    assert known['hit'] == 1.0
    assert known['following'] < 5e-6
    assert np.isfinite(known['rest'])
    for name, value in (('viscous_friction', 1.5), ('coulomb_friction', 1.5), ('late', 30.0)):
        worse = one(settings, target=0.03, **{name: value})
        assert worse['following'] > 2.0 * known['following']
    # Encoder noise delays the rest of the needle.
    assert one(settings, target=0.03, depth_noise=2e-5)['rest'] > known['rest'] + 0.1


def test_unmodeled_delay_causes_a_limit_cycle() -> None:
    """Reversals at the end distinguish a limit cycle from a needle at rest."""
    settings = {'controller': 'pid', 'wait': 2.0}
    calm = one(settings, target=0.03)
    assert calm['reversals'] <= 2.0
    assert np.isfinite(calm['rest'])
    swings = one(settings, target=0.03, late=100.0)
    assert swings['reversals'] > 5.0
    assert np.isnan(swings['rest'])


def test_open_loop_error_follows_from_friction() -> None:
    """The nominal needle hits within one period; the error of others has a closed form."""
    settings, p = {'controller': 'open loop', 'wait': 0.1}, PHANTOM
    speed = (3.0 - p.coulomb_friction) / p.viscous_friction
    known = one(settings, target=0.03, depth=0.02)
    # M / mu_v is 7 us: the acceleration time is negligible.
    assert known['error'] < speed * 1e-3
    assert np.isnan(known['following'])
    assert np.isnan(known['stopped'])
    assert known['force'] == 3.0
    for name, factor in (('viscous_friction', 1.25), ('coulomb_friction', 2.0)):
        mu_s = p.coulomb_friction * (factor if name == 'coulomb_friction' else 1.0)
        mu_v = p.viscous_friction * (factor if name == 'viscous_friction' else 1.0)
        way = 0.01 * (3.0 - mu_s) / mu_v / speed
        found = one(settings, target=0.03, depth=0.02, **{name: factor})
        assert found['error'] == pytest.approx(0.01 - way, abs=speed * 1e-3)
    out = one(settings, target=0.02, depth=0.03)
    assert out['error'] < speed * 1e-3


def test_needles_outside_their_range_are_reported() -> None:
    """In open loop the push is too strong; in closed loop the guard stops earlier."""
    found = one({'controller': 'open loop'}, target=0.001, depth=0.02, viscous_friction=0.5)
    assert found['left'] == 1.0
    assert found['hit'] == 0.0
    assert np.isnan(found['rest'])
    wild = {'target': 0.03, 'late': 100.0, 'viscous_friction': 0.1}
    stopped = one({'controller': 'pid'}, **wild)
    assert (stopped['stopped'], stopped['left']) == (1.0, 0.0)
    free = one({'controller': 'pid', 'speed_limit': 10.0, 'error_limit': 10.0}, **wild)
    assert (free['stopped'], free['left']) == (0.0, 1.0)


@pytest.mark.parametrize(
    ('settings', 'limits'),
    [
        ({'speed_limit': 0.009}, {'speed': 0.009}),
        ({'reference': 'step', 'error_limit': 0.005}, {'tracking_error': 0.005}),
        ({'deflection_limit': 1e-4}, {'tip_deflection': 1e-4}),
        ({}, {}),
    ],
)
def test_guard_stops_as_in_the_node(settings: dict[str, Any], limits: dict[str, Any]) -> None:
    """The guard of the node finds a violation at the last replayed sample, and not before."""
    study = build_study({**SMALL, 'settings': settings, 'population': {}})
    drawn = {'target': 0.03, 'depth': 0.02, 'tip': 3e-4, 'velocity_noise': 2e-4}
    rows = {name: np.array([value]) for name, value in drawn.items()}
    found = study.scenario.run(rows, [study.design.noise(0)])
    guard = Guard(SafetyLimits(**limits), (PHANTOM.minimum_depth, PHANTOM.length))
    said: list[bool] = []
    for topic, _, values in study.scenario.replay(drawn, study.design.noise(0)):
        if topic.name == 'joint_states':
            measured = Measurement(time=0.0, depth=values[0], velocity=values[2])
            beyond = [guard.encoders(measured)]
            if settings.get('reference') == 'step':
                beyond.append(guard.tracking(0.03 - values[0]))
        elif topic.name == 'tip_deflection':
            beyond.append(guard.tip(values[2]))
            said.append(any(beyond))
    assert not any(said[:-1])
    assert said[-1] == bool(settings)
    assert found['stopped'][0] == float(bool(settings))
    assert found['hit'][0] == float(not settings)


def test_replayed_bag_matches_the_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Depth, force, deflection and target are bit-identical; encoders differ by noise."""
    file, folder = tmp_path / 'insertion.yaml', tmp_path / 'results'
    file.write_text(yaml.safe_dump(SMALL))
    words = ['study', str(file), '-o', str(folder), '--workers', '1']
    assert main(words) == 0
    assert re.search(r'Samples +24 ', capsys.readouterr().out)
    table = folder / 'samples.parquet'
    # With noise of the encoders, and without noise of the force.
    wanted = (column(table, 'depth_noise') > 0.0) & (column(table, 'force_noise') == 0.0)
    number = int(np.flatnonzero(wanted)[0])
    assert main([*words, '--replay', str(number)]) == 0
    assert 'the same numbers as in the table' in capsys.readouterr().out
    bag = folder / f'sample_{number}'
    counts = message_counts(bag)
    assert set(counts) == {'/joint_states', '/tip_deflection', '/wrench_command', '/target'}
    assert counts['/joint_states'] == counts['/tip_deflection'] == counts['/wrench_command'] + 1
    row = {name: column(table, name)[number] for name in (*METRICS, 'target')}
    ((_, target),) = read_topic(bag, '/target')
    assert target.point.y == row['target']
    tips = np.array([[m.point.y, m.point.z] for _, m in read_topic(bag, '/tip_deflection')])
    assert abs(row['target'] - tips[-1, 0]) == row['error']
    assert np.abs(tips[:, 1]).max() == row['deflection']
    acted = [m.effort[0] for _, m in read_topic(bag, '/joint_states')]
    assert np.abs(acted).max() == row['force']
    commands = [m.wrench.force.y for _, m in read_topic(bag, '/wrench_command')]
    late = int(column(table, 'late')[number])
    # A command takes effect after one period plus the unmodeled delay.
    assert acted[2 + late :] == commands[: len(commands) - 1 - late]
    off = np.array([m.position[0] for _, m in read_topic(bag, '/joint_states')]) - tips[:, 0]
    # Five standard errors of a standard deviation; the last sample has no command.
    assert off[:-1].std() == pytest.approx(2e-6, rel=5.0 / np.sqrt(2.0 * len(off)))


def test_shipped_example_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The shipped study with few samples completes, and most needles hit."""
    example = Path(__file__).parents[2] / 'examples' / 'studies' / 'insertion.yaml'
    document = {**yaml.safe_load(example.read_text()), 'samples': 20}
    file = tmp_path / 'few.yaml'
    file.write_text(yaml.safe_dump(document, sort_keys=False))
    assert main(['study', str(file), '-o', str(tmp_path / 'few'), '--workers', '1']) == 0
    capsys.readouterr()
    assert column(tmp_path / 'few' / 'samples.parquet', 'hit').mean() > 0.5
    again = ['study', str(file), '-o', str(tmp_path / 'few'), '--replay', '17']
    assert main(again) == 0
    assert 'the same numbers as in the table' in capsys.readouterr().out
    page = (tmp_path / 'few' / 'study.html').read_text()
    for words in ('Median error', 'viscous_friction', 'reversals of the velocity'):
        assert words in page


def test_default_step_is_converged() -> None:
    """Metrics agree with a step shorter by a factor of 20, to a thousandth of the tolerance."""
    drawn = {'target': 0.04, 'tip': 5e-4, 'coulomb_friction': 1.2, 'carriage_mass': 0.1}
    found, fine = (one(settings, **drawn) for settings in ({}, {'step': 1e-5}))
    for name in ('error', 'overshoot', 'following'):
        assert found[name] == pytest.approx(fine[name], abs=1e-3 * 1e-4)
    assert found['force'] == pytest.approx(fine['force'], rel=1e-3)
    assert found['deflection'] == pytest.approx(fine['deflection'], rel=1e-3)
    assert found['rest'] == pytest.approx(fine['rest'], abs=2e-3)


@pytest.mark.parametrize(
    ('change', 'complaint'),
    [
        ({'population': {'mu_s': 1}}, "population: unknown parameter 'mu_s'; "),
        ({'population': {'target': 0.3}}, 'target must be finite and in [0.001, 0.2] m, and'),
        ({'population': {'late': {'choice': [0, -1, 2]}}}, 'finite and in [0, 100] periods'),
        (
            {'settings': {'speed': 1e-9}},
            'must have <= 1000000 samples, and would have up to 1.99e',
        ),
        ({'settings': {'wait': 1e9}}, 'must have <= 1000000 samples, and would have up to 1e+12'),
        ({'settings': {'deep': 1}}, "settings: unknown parameter 'deep'"),
        ({'settings': {'needle': 'bone'}}, 'needle must be one of paper_si, paper_mm, phantom,'),
        ({'settings': {'controller': 'me'}}, 'controller must be one of adaptive'),
        ({'settings': {'needle': [1]}}, 'needle must be one of'),
        ({'settings': {'reference': 'leap'}}, 'reference must be one of trapezoid'),
        ({'settings': {'constants': {'leng': 1}}}, "'settings.constants.leng'; did you mean"),
        ({'settings': {'constants': 1}}, 'settings: constants must be names with values'),
        ({'settings': {'gains': {'kq': 1}}}, "unknown parameter 'settings.gains.kq'"),
        ({'settings': {'controller': 'pid', 'gains': {'kp': 1e6}}}, 'pid gains are unstable at'),
        ({'settings': {'delay': 0.5}}, 'delay must be a whole number of periods, got 0.5'),
        ({'settings': {'wait': 0}}, 'settings.wait must be finite, > 0 s, got 0'),
        ({'settings': {'uncertainty': {'coulomb': 2}}}, 'settings.uncertainty.coulomb must be'),
        ({'settings': {'controller': 'open loop', 'push': 0.5}}, 'push must be > Coulomb frict'),
        ({'settings': {'controller': 'open loop', 'gains': {'kp': 1}}}, 'gains are for adaptive,'),
        (
            {'settings': {'constants': {'formulation': 'as_printed'}}},
            "formulation must be 'complete' for controller",
        ),
    ],
)
def test_invalid_studies_are_rejected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Any, complaint: str
) -> None:
    """A one-line error names the file, and nothing is written."""
    check_refused({**SMALL, **change}, complaint, tmp_path, capsys)


def test_a_needle_file_belongs_to_the_study(tmp_path: Path) -> None:
    """Its checksum differs after a change."""
    needle = tmp_path / 'mine.yaml'
    found = []
    for length in (0.2, 0.21):
        needle.write_text(f'needle: phantom\nlength: {length}\n')
        document = {'scenario': 'insertion', 'settings': {'needle': str(needle)}}
        found.append(build_study(document).document['files'][str(needle)])
    assert found[0] != found[1]
    assert 'files' not in build_study({'scenario': 'insertion'}).document
