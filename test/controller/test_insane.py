# SPDX-License-Identifier: Apache-2.0
"""Any finite floats on any input: limited force, and motion after one clear_stop."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from benchmarks.loop import Loop, LoopFault, Sent
from hypothesis import example, given, settings
from hypothesis import strategies as st
from needle_controller import Observer, ObserverSettings
from needle_controller.gains import LAWS
from needle_dynamics import NeedleParameters, ParameterError
from needle_ros.system_state import CLEAR_STOP
import pytest

PHANTOM = NeedleParameters.preset('phantom')

#: Samples per second, the implausible sample, its successors, and samples from the release on.
RATE, AT, AFTER, SANE = 100.0, 50, 100, 1000

TOPICS = ('joint_states', 'base_wrench', 'tip_deflection', 'target')


class Insane(LoopFault):
    """Replaces the first values by these numbers."""

    def __init__(self, values: Sequence[float]) -> None:
        self._values = values

    def measured(self, sent: Sent) -> Iterable[Sent]:
        told = [*self._values, *sent.values[len(self._values) :]]
        return (sent._replace(values=told[: len(sent.values)]),)


@pytest.mark.requirement('S-001', 'S-039')
@settings(max_examples=20, deadline=None)
@example('adaptive', 'joint_states', [0.02, 0.0, 1e300, 0.0, 0.0, 0.0], 1)
@example('adaptive', 'base_wrench', [0.0, 1e300, 0.0, 0.0, 0.0, 0.0], 3)
@example('adaptive', 'base_wrench', [0.0, 0.0, 1e300, 1e300, 0.0, 0.0], 1)
@example('pid', 'tip_deflection', [0.0, 0.0, 1e300], 1)
@given(
    st.sampled_from(LAWS),
    st.sampled_from(TOPICS),
    st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=6, max_size=6),
    st.integers(1, 3),
)
def test_controller_recovers_from_implausible_inputs(
    law: str, topic: str, values: list[float], times: int
) -> None:
    """At most one stop must be cleared; then the target is reached with a limited force."""
    loop = Loop(law, RATE)
    loop.target(0.05)
    for k in range(AFTER):
        insane = AT <= k < AT + times
        if insane and topic == 'target':
            loop.supervisor.target(0, '', values[0], values[1], loop.now)
        loop.step(topic, Insane(values) if insane else None)
        assert abs(loop.acting) <= 15.0
    if loop.supervisor.safety.stop is not None:
        assert loop.supervisor.request(CLEAR_STOP, loop.now)[0]
    loop.target(0.03)
    for _ in range(SANE):
        loop.step()
        # Friction at the speed of the reference, 10 mm/s, is 3.6 N; a step takes up to its limit.
        assert abs(loop.acting) <= 15.0
        assert loop.supervisor.safety.stop is None
    assert abs(loop.depth - 0.03) < 1e-4
    # At rest the force is within dry friction.
    assert abs(loop.acting) < 2.0


@pytest.mark.requirement('S-037')
@pytest.mark.parametrize('value', [1e100, -1e100, 1e7, float('inf'), float('nan')])
def test_observer_ignores_implausible_sensors(value: float) -> None:
    """A single reading has no effect on later estimates."""
    loads = []
    for shown in (value, None):
        observer = Observer(PHANTOM, ObserverSettings(), period=0.01)
        for k in range(200):
            stamp = 10_000_000 * k
            wrench = (shown, shown) if k == 50 and shown is not None else None
            observer.update(stamp, 0.05, 0.0, wrench)
            if k == 60 and shown is not None:
                observer.add_tip(stamp, shown)
                observer.add_wrench(stamp, shown, shown)
        loads.append(observer.load)
    assert loads[0] == loads[1]


@pytest.mark.requirement('S-038')
def test_observer_rejects_an_implausible_velocity() -> None:
    """It is finite, and would give a load of 1e296 N."""
    observer = Observer(PHANTOM, ObserverSettings(), 1e-3)
    observer.update(0, 0.05, 0.0)
    with pytest.raises(ParameterError, match='the speed at most a needle length in a period'):
        observer.update(1_000_000, 0.05, 1e60)
    observer.update(2_000_000, 0.05, 0.0)
    assert abs(observer.load) < 1.0
