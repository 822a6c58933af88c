# SPDX-License-Identifier: Apache-2.0
"""Recursive friction estimates equal the batch estimate and track changes."""

from dataclasses import replace
from typing import Any

from needle_dynamics import ParameterError
from needle_identification import FrictionSettings, identify_friction, Recording, RecursiveFriction
import numpy as np
from numpy.testing import assert_allclose
import pytest
from support.strokes import COULOMB, strokes, VISCOUS

RATE = 250.0


def fed(
    recording: Recording, forgetting: float = 8.0, settings: FrictionSettings | None = None
) -> RecursiveFriction:
    running = RecursiveFriction(settings or FrictionSettings(), RATE, forgetting)
    for row in zip(recording.time, recording.velocity, recording.force, strict=True):
        running.update(*row)
    return running


def joined(*recordings: Recording) -> Recording:
    """Concatenate recordings in time."""
    time = np.arange(sum(len(r.time) for r in recordings)) / RATE
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(r, name) for r in recordings])
        for name in ('depth', 'velocity', 'force')
    }
    return replace(recordings[0], time=time, **columns)


class Weighed(RecursiveFriction):
    """Keep all used samples for a batch solution."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.rows: list[tuple[float, float, float, float]] = []

    def _learn(self, velocity: float, acceleration: float, force: float) -> None:
        self.rows.append((np.sign(velocity), velocity, acceleration, force))
        super()._learn(velocity, acceleration, force)


def test_recursive_estimates_equal_weighted_least_squares() -> None:
    recording = strokes(seed=1)
    running = Weighed(FrictionSettings(), RATE, 3.0)
    for row in zip(recording.time, recording.velocity, recording.force, strict=True):
        running.update(*row)
    rows = np.array(running.rows)
    root = np.exp(-0.5 * np.arange(len(rows))[::-1] / RATE / 3.0)[:, np.newaxis]
    solution = np.linalg.lstsq(root * rows[:, :3], root[:, 0] * rows[:, 3], rcond=None)[0]
    # 1e-7: the condition number of the products, in rounding errors.
    assert_allclose([p.value for p in running.estimate()], solution[:2], rtol=1e-7)
    # Both discard samples near changes of regime.
    assert 0.8 < len(rows) / identify_friction(recording).samples < 1.1


@pytest.mark.parametrize('lag', [0.0, 0.004])
def test_exact_friction_is_recovered_recursively(lag: float) -> None:
    coulomb, viscous = fed(strokes(lag=lag)).estimate()
    # 1e-4 of the force at the largest speed: the lag is corrected to first order.
    assert_allclose(coulomb.value, COULOMB, rtol=1e-3)
    assert_allclose(viscous.value, VISCOUS, rtol=1e-4)


def test_a_step_is_tracked_within_the_forgetting_time() -> None:
    slippery = strokes(seed=2, push=0.0)
    rough = strokes(seed=3, push=0.0)
    rough = replace(rough, force=rough.force + 0.2 * np.sign(rough.velocity))
    forgetting = 2.0
    before = fed(slippery, forgetting).estimate()[0]
    after = fed(joined(slippery, rough), forgetting).estimate()[0]
    assert abs(before.value - COULOMB) < 4.0 * before.error
    # Nine seconds of motion are 4.5 forgetting times: 1 % of the old value remains.
    assert abs(after.value - COULOMB - 0.2) < 4.0 * after.error + 0.002
    slow = fed(joined(slippery, rough), 100.0).estimate()[0]
    assert COULOMB + 0.05 < slow.value < COULOMB + 0.15


def test_intervals_have_their_coverage() -> None:
    estimates = [fed(strokes(seed=seed)).estimate() for seed in range(40)]
    for k, truth in enumerate((COULOMB, VISCOUS)):
        values, errors = np.array([(e[k].value, e[k].error) for e in estimates]).T
        covered = [e[k].interval[0] <= truth <= e[k].interval[1] for e in estimates]
        # Three standard deviations of a binomial of 40 trials at 95 % are 10.3 %.
        assert np.mean(covered) >= 0.847
        # A standard deviation from 40 values has an error of 11 %: three of these.
        assert_allclose(np.sqrt(np.mean(errors**2)), values.std(), rtol=0.34)


def test_parameters_are_determined_only_after_sufficient_motion() -> None:
    recording = strokes(seed=1, push=0.0)
    running = RecursiveFriction(FrictionSettings(), RATE, 8.0)
    assert not any(p.determined for p in running.estimate())
    known = []
    for row in zip(recording.time, recording.velocity, recording.force, strict=True):
        running.update(*row)
        known.append(
            all(p.determined for p in running.estimate()) if row[0] % 0.2 < 4e-3 else None
        )
    determined = [k for k in known if k is not None]
    assert not determined[0]
    assert determined[-1]
    one_speed = fed(strokes(seed=1, push=0.0, speeds=(5e-3,) * 5)).estimate()
    assert not any(p.determined for p in one_speed)
    assert all(p.interval == (-np.inf, np.inf) for p in one_speed)


def test_there_is_no_forgetting_at_rest() -> None:
    recording = strokes(seed=4)
    rest = replace(
        recording, velocity=np.zeros_like(recording.velocity), force=np.zeros_like(recording.force)
    )
    one, other = fed(recording, 2.0).estimate(), fed(joined(recording, rest), 2.0).estimate()
    assert_allclose([p.value for p in other], [p.value for p in one], rtol=1e-9)


def test_gaps_and_nonfinite_values_are_ignored() -> None:
    recording = strokes(seed=5)
    kept = np.ones(len(recording.time), dtype=bool)
    kept[1500:1700] = False
    running = RecursiveFriction(FrictionSettings(), RATE, 8.0)
    for k in np.flatnonzero(kept):
        force = np.nan if k == 1000 else recording.force[k]
        running.update(recording.time[k], recording.velocity[k], force)
    for found, truth in zip(running.estimate(), (COULOMB, VISCOUS), strict=True):
        assert abs(found.value - truth) < 4.0 * found.error


def test_the_selected_terms_are_estimated() -> None:
    settings = FrictionSettings(terms=('coulomb', 'viscous', 'offset', 'direction'))
    found = fed(strokes(seed=6), settings=settings).estimate()
    known = {p.name: p.determined for p in found}
    assert not known['coulomb_friction']
    assert not known['offset']
    assert known['viscous_friction']
    settings = FrictionSettings(terms=('coulomb', 'viscous', 'offset'))
    offset = fed(strokes(seed=6, offset=0.1), settings=settings).estimate()[2]
    assert abs(offset.value - 0.1) < 4.0 * offset.error


@pytest.mark.parametrize(
    ('arguments', 'complaint'),
    [
        ((FrictionSettings(), 0.0, 8.0), 'rate must be finite and > 0'),
        ((FrictionSettings(), RATE, float('inf')), 'forgetting must be finite and > 0'),
        ((FrictionSettings(estimator='huber'), RATE, 8.0), "ordinary, got 'huber'"),
    ],
)
def test_invalid_rate_forgetting_and_estimator_are_rejected(
    arguments: tuple[FrictionSettings, float, float], complaint: str
) -> None:
    with pytest.raises(ParameterError, match=complaint):
        RecursiveFriction(*arguments)
