# SPDX-License-Identifier: Apache-2.0
"""Effect of faults on measurements."""

from collections.abc import Sequence
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from needle_dynamics.simulated.faults import FaultParameters, FAULTS, SensorFault
from needle_ros.errors import ParameterError
import numpy as np
import pytest

STREAM = [(k, [float(k), 10.0 * k]) for k in range(200)]


def through(
    kind: str,
    probability: float = 1.0,
    delay: float = 0.05,
    size: float = 0.0,
    seed: int = 1,
    biased: Sequence[int] = (0,),
) -> list[Any]:
    """Return the published measurements of each call."""
    parameters = FaultParameters(probability=probability, delay=delay, size=size)
    fault = SensorFault(kind, parameters, 100.0, seed)
    return [fault.apply(stamp, values, biased) for stamp, values in STREAM]


def test_dropped_measurements_are_lost() -> None:
    """All with probability 1; otherwise this fraction, with the others unchanged and in order."""
    assert not any(through('drop'))
    left = [reading for leaves in through('drop', 0.3) for reading in leaves]
    # Five standard deviations of a binomial number.
    assert len(left) == pytest.approx(140, abs=5 * np.sqrt(200 * 0.3 * 0.7))
    assert all(reading in STREAM for reading in left)
    assert left == sorted(left)


def test_delayed_measurements_keep_their_stamps() -> None:
    """0.05 s at 100 Hz are five calls."""
    leaves = through('delay')
    assert leaves[:5] == [[]] * 5
    assert leaves[5:] == [[reading] for reading in STREAM[:-5]]


def test_random_delays_change_the_order() -> None:
    """Only measurements that are still delayed are missing."""
    left = [reading for leaves in through('delay', 0.5) for reading in leaves]
    assert left != sorted(left)
    assert len(set(map(str, left))) == len(left) >= 195


def test_duplicates_are_published_twice() -> None:
    assert through('duplicate') == [[reading] * 2 for reading in STREAM]


def test_reordered_measurements_change_places() -> None:
    """Every second measurement is published before its predecessor."""
    left = [reading[0] for leaves in through('reorder') for reading in leaves]
    assert left == [k + d for k in range(0, 200, 2) for d in (1, 0)]


def test_frozen_values_repeat_with_new_stamps() -> None:
    assert through('freeze') == [[(k, [0.0, 0.0])] for k in range(200)]


@given(st.floats(-1e3, 1e3))
def test_bias_and_saturation_change_only_the_given_values(size: float) -> None:
    """Stamps are never changed."""
    biased, bounded = through('bias', size=size), through('saturate', size=size)
    for (stamp, values), [(at, found)], [(when, kept)] in zip(
        STREAM, biased, bounded, strict=True
    ):
        assert at == when == stamp
        assert found == [values[0] + size, values[1]]
        assert kept == [min(values[0], abs(size)), values[1]]


def test_nan_fault_affects_all_values() -> None:
    assert np.isnan([values for [(_, values)] in through('nan')]).all()


@pytest.mark.parametrize('kind', FAULTS)
def test_same_seed_gives_the_same_faults(kind: str) -> None:
    runs = [str(through(kind, 0.5, size=1.0, seed=seed)) for seed in (1, 1, 2)]
    assert runs[0] == runs[1] != runs[2]


def test_unknown_fault_kind_is_rejected() -> None:
    """The message lists the valid kinds."""
    with pytest.raises(ParameterError, match=r"must be one of drop, delay, .*, got 'rust'"):
        SensorFault('rust', FaultParameters(), 100.0, 1)
