# SPDX-License-Identifier: Apache-2.0
"""Plant and supervisor connected by serialized messages, without ROS, faster than real time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from heapq import heappop, heappush
from typing import Any, Final, NamedTuple

from needle_controller import (
    Controller,
    ControllerSettings,
    ForceCommand,
    ObserverSettings,
    SafetyLimits,
)
from needle_controller.supervisor import Supervisor
from needle_dynamics import NeedleParameters
from needle_dynamics.simulated.run import PlantRun
from needle_ros.contract import BASE_WRENCH, JOINT_STATES, TIP_DEFLECTION
from needle_ros.errors import MessageError
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import MessageReader

#: Start time [ns].
EPOCH: Final = 1_700_000_000 * NANOSECONDS

#: Measurements in the order of transmission.
MEASURED: Final = (BASE_WRENCH.name, TIP_DEFLECTION.name, JOINT_STATES.name)


class Sent(NamedTuple):
    """A measurement in transmission."""

    stamp: int
    values: Sequence[float]
    late: int = 0
    frame: str | None = None


class Commanded(NamedTuple):
    """A command in transmission."""

    stamp: int
    force: float
    late: int = 0
    frame: str = 'needle_base'


class LoopFault:
    """Fault of a topic; the base class transmits everything unchanged."""

    def measured(self, sent: Sent) -> Iterable[Sent]:
        """Return the measurements received in place of a measurement."""
        return (sent,)

    def commanded(self, command: Commanded) -> Iterable[Commanded]:
        """Return the commands received in place of a command."""
        return (command,)


class Loop:
    """
    A plant and its controller.

    `friction` is the true friction as a multiple of the nominal one, `plant` are further
    parameters of the plant, and `options` of the controller.

    Attributes
    ----------
    rate : float
        Rate of the measurements [Hz].
    now : int
        Time [ns].
    publishers : dict
        Number of publishers of topics with a single source.
    depth : float
        True insertion depth [m].
    acting : float
        Force that acts on the needle [N].

    """

    def __init__(
        self,
        law: str = 'adaptive',
        rate: float = 200.0,
        seed: int = 1,
        friction: float = 1.0,
        *,
        needle: str = 'phantom',
        plant: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        nominal = NeedleParameters.preset(needle)
        true = {
            'model.coulomb_friction': friction * nominal.coulomb_friction,
            'model.viscous_friction': friction * nominal.viscous_friction,
        }
        own = {'needle': needle, 'rate': rate, 'depth': 0.02, 'seed': seed}
        self.run = PlantRun({**own, **true, **(plant or {})})
        self.rate, self.now, self._period = rate, EPOCH, round(NANOSECONDS / rate)
        self.publishers = {'wrench_command': 1}
        self.supervisor = Supervisor(lambda: self.now / NANOSECONDS)
        controller = Controller(nominal, law, settings=ControllerSettings(rate=rate), **options)
        self.supervisor.configure(controller, SafetyLimits(), ObserverSettings())
        self.supervisor.activate(self.now, self.publishers)
        self.depth, self.acting = 0.02, 0.0
        self._take = {
            BASE_WRENCH.name: self.supervisor.wrench,
            TIP_DEFLECTION.name: self.supervisor.tip,
            JOINT_STATES.name: self.supervisor.encoders,
        }
        self._ends = {
            name: (topic, MessageReader(topic.type_name).read)
            for name, topic in self.run.topics.items()
        }
        #: Messages in transmission: time of arrival, order, and content.
        self._waiting: list[tuple[int, int, str | None, bytes | Commanded]] = []
        self._order = 0

    def target(self, depth: float) -> None:
        """Set a target depth [m]."""
        self.supervisor.target(0, '', depth, 0.0, self.now)

    def step(self, topic: str = '', fault: LoopFault | None = None) -> None:
        """Take a sample, transmit it with a fault on a topic, and apply the commands."""
        self.now += self._period
        told = {name: values for name, _, values in self.run.take(self.now)}
        # Lateral tip coordinates are the reading of the tip sensor.
        for name in MEASURED:
            if name not in told:
                continue
            sent = Sent(self.now, told[name])
            hit = fault is not None and name == topic
            for one in fault.measured(sent) if hit and fault is not None else (sent,):
                self._post(one.late, name, self._written(name, one))
        while self._waiting and self._waiting[0][0] <= self.now:
            _, _, name_, what = heappop(self._waiting)
            self._arrive(name_, what, fault if topic == 'wrench_command' else None)
        self._answer(self.supervisor.watch(self.now, self.publishers), None)
        self.run.commands.count_commanders(self.publishers['wrench_command'])
        self.depth = self.run.plant.depth
        self.acting = self.run.commands.acting.force

    def _written(self, name: str, sent: Sent) -> bytes:
        topic, _ = self._ends[name]
        if sent.frame is not None:
            topic = replace(topic, frame=sent.frame)
        return topic.template().serialize(sent.stamp, *sent.values)

    def _post(self, late: int, name: str | None, what: bytes | Commanded) -> None:
        self._order += 1
        heappush(self._waiting, (self.now + late, self._order, name, what))

    def _arrive(self, name: str | None, what: bytes | Commanded, fault: LoopFault | None) -> None:
        if isinstance(what, Commanded):
            self.run.commands.offer(what.stamp, what.frame, what.force, 0.0, self.now)
        elif name is not None:
            try:
                reading = self._ends[name][1](what)
            except MessageError:
                return
            self._answer(self._take[name](reading, self.now), fault)

    def _answer(self, answer: ForceCommand | None, fault: LoopFault | None) -> None:
        if answer is None:
            return
        command = Commanded(answer.stamp, answer.force)
        for one in fault.commanded(command) if fault is not None else (command,):
            if one.late:
                self._post(one.late, None, one)
            else:
                self._arrive(None, one, None)
