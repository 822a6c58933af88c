"""What faults do to measurements."""

from collections.abc import Sequence
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from needle_dynamics.simulated.faults import Fault, FaultParameters, FAULTS
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
    """Return what leaves at each call."""
    parameters = FaultParameters(probability=probability, delay=delay, size=size)
    fault = Fault(kind, parameters, 100.0, seed)
    return [fault.leaves(stamp, values, biased) for stamp, values in STREAM]


def test_dropped_measurements_are_lost() -> None:
    """With certainty all; else about that part of them, the rest unchanged and in order."""
    assert not any(through('drop'))
    left = [reading for leaves in through('drop', 0.3) for reading in leaves]
    # Five standard deviations of a binomial number.
    assert len(left) == pytest.approx(140, abs=5 * np.sqrt(200 * 0.3 * 0.7))
    assert all(reading in STREAM for reading in left)
    assert left == sorted(left)


def test_delayed_measurements_leave_later_with_their_own_stamps() -> None:
    """0.05 s at 100 Hz is five calls."""
    leaves = through('delay')
    assert leaves[:5] == [[]] * 5
    assert leaves[5:] == [[reading] for reading in STREAM[:-5]]


def test_some_delayed_are_overtaken() -> None:
    """A delay of some changes the order too; nothing is lost but what is still under way."""
    left = [reading for leaves in through('delay', 0.5) for reading in leaves]
    assert left != sorted(left)
    assert len(set(map(str, left))) == len(left) >= 195


def test_duplicates_are_equal() -> None:
    """Each leaves twice at once."""
    assert through('duplicate') == [[reading] * 2 for reading in STREAM]


def test_reordered_measurements_change_places() -> None:
    """Each second one leaves before the one that came before it."""
    left = [reading[0] for leaves in through('reorder') for reading in leaves]
    assert left == [k + d for k in range(0, 200, 2) for d in (1, 0)]


def test_frozen_values_stay_while_stamps_go_on() -> None:
    """The first values that are hit are repeated."""
    assert through('freeze') == [[(k, [0.0, 0.0])] for k in range(200)]


@given(st.floats(-1e3, 1e3))
def test_a_bias_adds_to_what_is_measured_and_a_range_bounds_it(size: float) -> None:
    """Only the values that are said to be are changed; stamps never."""
    biased, bounded = through('bias', size=size), through('saturate', size=size)
    for (stamp, values), [(at, found)], [(when, kept)] in zip(
        STREAM, biased, bounded, strict=True
    ):
        assert at == when == stamp
        assert found == [values[0] + size, values[1]]
        assert kept == [min(values[0], abs(size)), values[1]]


def test_not_a_number() -> None:
    """Every value is hit."""
    assert np.isnan([values for [(_, values)] in through('nan')]).all()


@pytest.mark.parametrize('kind', FAULTS)
def test_the_same_seed_hits_the_same(kind: str) -> None:
    """With one seed runs are equal, with another they are not."""
    runs = [str(through(kind, 0.5, size=1.0, seed=seed)) for seed in (1, 1, 2)]
    assert runs[0] == runs[1] != runs[2]


def test_an_unknown_kind_is_named() -> None:
    """The valid ones are listed."""
    with pytest.raises(ParameterError, match=r"must be one of drop, delay, .*, got 'rust'"):
        Fault('rust', FaultParameters(), 100.0, 1)
