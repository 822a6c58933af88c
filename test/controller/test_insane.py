"""Any finite floats on any input, then sane ones: sane force, and motion after one clear_stop."""

from __future__ import annotations

from collections.abc import Sequence

from hypothesis import example, given, settings
from hypothesis import strategies as st
from needle_controller import (
    Controller,
    ControllerSettings,
    Observer,
    ObserverSettings,
    SafetyLimits,
    Supervisor,
)
from needle_controller.controller import LAWS
from needle_dynamics import NeedleParameters, ParameterError
from needle_dynamics.simulated.plant import Plant
from needle_dynamics.simulated.run import PlantRun
from needle_ros.contract import Topic
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import Reader, Reading
import pytest

PHANTOM = NeedleParameters.preset('phantom')
RATE, EPOCH = 100.0, 1_700_000_000 * NANOSECONDS
PERIOD = round(NANOSECONDS / RATE)

#: The insane sample, its successors, and the samples from the release of the stop to the end.
AT, AFTER, SANE = 50, 100, 1000

TOPICS = ('joint_states', 'base_wrench', 'tip_deflection', 'target')


class Loop:
    """The supervisor around the plant, over the bytes of the wire, without ROS."""

    def __init__(self, law: str) -> None:
        self.plant = PlantRun(
            {'model.preset': 'phantom', 'rate': RATE, 'depth': 0.02, 'force_limit': 15.0}
        )
        self.ends = {
            name: (topic.template().serialize, Reader(topic.type_name).read)
            for name, topic in self.plant.topics.items()
        }
        self.supervisor = Supervisor(lambda: 1e-9 * self.now)
        self.now = EPOCH
        control = ControllerSettings(rate=RATE)
        self.supervisor.configure(
            Controller(PHANTOM, law, settings=control), SafetyLimits(), ObserverSettings()
        )
        self.supervisor.activate(self.now, {'wrench_command': 1})
        self.force = 0.0
        self.supervisor.target(0, '', 0.05, 0.0, self.now)

    def reading(self, topic: Topic, values: Sequence[float]) -> Reading:
        """Send values over the wire."""
        serialize, read = self.ends[topic.name]
        return read(serialize(self.now, *values))

    def step(self, insane: tuple[str, Sequence[float]] | None = None) -> None:
        """Take a sample, pass it on, and apply the answer."""
        self.now += PERIOD
        said = []
        for name, _, true in self.plant.take(self.now):
            told = insane[1] if insane is not None and name == insane[0] else []
            values = [*told, *true][: len(true)]
            said.append((name, self.reading(self.plant.topics[name], values)))
        take = self.supervisor
        if insane is not None and insane[0] == 'target':
            take.target(0, '', insane[1][0], insane[1][1], self.now)
        for name, reading in said:
            act = {
                'joint_states': take.encoders,
                'base_wrench': take.wrench,
                'tip_deflection': take.tip,
            }.get(name)
            answer = act(reading, self.now) if act else None
            if answer is not None:
                self.force = answer.force
                frame = 'needle_base'
                self.plant.commands.offer(answer.stamp, frame, answer.force, 0.0, self.now)
        take.watch(self.now, {'wrench_command': 1})


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
def test_it_recovers(law: str, topic: str, values: list[float], times: int) -> None:
    """At most one stop is to be cleared; then the needle goes to its target, with sane force."""
    loop = Loop(law)
    for k in range(AFTER):
        loop.step((topic, values) if AT <= k < AT + times else None)
        assert abs(loop.force) <= 15.0
    if loop.supervisor.safety.stop is not None:
        assert loop.supervisor.clear_stop(loop.now).success
    loop.supervisor.target(0, '', 0.03, 0.0, loop.now)
    for _ in range(SANE):
        loop.step()
        # Friction at the speed of the reference, 10 mm/s, is 3.6 N; a step takes up to its limit.
        assert abs(loop.force) <= 15.0
        assert loop.supervisor.safety.stop is None
    assert isinstance(loop.plant.plant, Plant)
    assert abs(loop.plant.plant.integrator.depth - 0.03) < 1e-4
    # At rest nothing but dry friction is held.
    assert abs(loop.force) < 2.0


def test_the_observer_refuses_an_absurd_speed() -> None:
    """It is finite, and would make a load of 1e296 N."""
    observer = Observer(PHANTOM, ObserverSettings(), 1e-3)
    observer.update(0.0, 0.05, 0.0)
    with pytest.raises(ParameterError, match='the speed at most a needle length in a period'):
        observer.update(1e-3, 0.05, 1e60)
    observer.update(2e-3, 0.05, 0.0)
    assert abs(observer.load) < 1.0
