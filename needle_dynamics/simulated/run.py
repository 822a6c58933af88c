"""
A run of a simulated plant: its samples, and what was done to it between them.

The node advances one, and so does a replay: what was done is an `Event`, which counts from the
next sample on, and which a replay performs again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from needle_dynamics.simulated.assembly import PlantConstants
from needle_dynamics.simulated.commands import Command, Commands
from needle_dynamics.simulated.measured import Measurement, SimulatedPlant
from needle_ros.contract import INSERTION, JOINT_COMMANDS, JOINT_STATES, Topic
from needle_ros.errors import ParameterError
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import Reading

#: Kinds of events.
CONFIGURED: Final = 'configured'
TIME: Final = 'time'
TRAJECTORY: Final = 'trajectory'
MOTION: Final = 'motion'
PARAMETERS: Final = 'parameters'
TARE: Final = 'tare'
RESET: Final = 'reset'

#: Stamps are rounded to nanoseconds, so that a period may be off by one [ns].
_ROUNDING: Final = 2


class Event(NamedTuple):
    """
    What was done to a plant beside commands; it counts from the next sample on.

    Attributes
    ----------
    kind : str
        ``configured``: the plant was made from the parameters in ``content``. ``time``: the
        sample is not one period after the one before. ``trajectory``: ``content`` has the
        arguments of `Plant.follow`. ``motion``: likewise, from `joint_commands`.
        ``parameters``: those in ``content`` changed. ``tare``: the force sensor was zeroed.
        ``reset``: state, sensor and noise are at their start.
    content : Mapping[str, Any]
        Values that JSON can hold.

    """

    kind: str
    content: Mapping[str, Any] = {}


class PlantRun:
    """
    A simulated plant under commands and events.

    Parameters
    ----------
    values : Mapping[str, Any]
        Parameters of the plant by name, see `PlantConstants.of`.
    number : int
        Number of samples that were taken before it.

    Attributes
    ----------
    constants : PlantConstants
        Its constants now.
    plant : SimulatedPlant
        The plant.
    commands : Commands
        The commands.
    number : int
        Number of samples taken, with those before it.
    topics : dict
        Topics that it publishes on, by name.

    Raises
    ------
    ParameterError
        If a parameter is not valid; the message names it.
    InsertedLengthError
        If the needle cannot be where it shall start.

    """

    def __init__(self, values: Mapping[str, Any], number: int = 0) -> None:
        self._values = dict(values)
        self.constants = PlantConstants.of(values)
        self.plant: SimulatedPlant = self.constants.make()
        own = self.constants.own
        self.commands = Commands(
            own.command_timeout,
            own.force_limit,
            own.torque_limit,
            interval=1.0 / own.rate,
            force_rate_limit=own.force_rate_limit,
            power_limit=own.power_limit,
        )
        self._joint_commands = self.constants.joint_commands()
        self.number = number
        self.topics: dict[str, Topic] = {topic.name: topic for topic in self.plant.topics}
        self._period = NANOSECONDS / own.rate
        #: Time of the newest sample [ns].
        self._stamp = -NANOSECONDS
        self._events = [Event(CONFIGURED, self._values)]
        #: What was measured last.
        self._measured: list[Measurement] = []

    # Commands.

    def begin(self) -> None:
        """Forget commands and who gave them, as at an activation."""
        self.commands.begin()
        self._joint_commands.forget()

    def command_joints(self, reading: Reading, now: int) -> tuple[bool, str]:
        """
        Take in a message of `joint_commands`, by the rules of all commands.

        Parameters
        ----------
        reading : Reading
            The message.
        now : int
            Simulated time [ns].

        Returns
        -------
        counts : bool
            Whether it counts; an invalid one counts as no force and no motion.
        complaint : str
            What is wrong with it, '' for nothing.

        """
        commands = self.commands
        try:
            asked = self._joint_commands.read(reading, self._positions(), now)
            counts, complaint = commands.offer(asked.stamp, '', asked.force, asked.torque, now)
            if counts and not complaint and commands.may_move(now):
                for goals, within in asked.motions:
                    content = {
                        'joints': list(goals),
                        'times': [within],
                        'positions': [list(goals.values())],
                        'efforts': [[]],
                    }
                    self.perform(Event(MOTION, content))
                self._joint_commands.accept(asked)
        except ParameterError as error:
            commands.refuse()
            return True, f'{JOINT_COMMANDS.name}: {error}; no force is applied'
        return counts, complaint

    def _positions(self) -> dict[str, float]:
        """Return where the joints are [m or rad], as the encoders have it."""
        if not self._measured or JOINT_STATES.name not in self.topics:
            return {INSERTION: self.plant.depth}
        joints = self.topics[JOINT_STATES.name].joints
        # It is the last measurement, with the positions first.
        values = self._measured[-1][2]
        return {joint.name: value for joint, value in zip(joints, values, strict=False)}

    # Events.

    def perform(self, event: Event) -> None:
        """
        Do something to the plant, for the first time or as it was recorded.

        Parameters
        ----------
        event : Event
            What to do.

        Raises
        ------
        ParameterError
            If the plant cannot follow the trajectory, or a parameter is not valid.
        JobError
            If the plant moves, or has not rested long enough, for a tare.

        """
        if event.kind in (TRAJECTORY, MOTION):
            self.plant.follow(**event.content)
        elif event.kind == PARAMETERS:
            if not self._change(event.content):
                return
        elif event.kind == TARE:
            self.plant.tare()
        elif event.kind == RESET:
            self.plant = self.constants.make()
            self.commands.forget()
            self._joint_commands.forget()
        self._events.append(event)

    def _change(self, changes: Mapping[str, Any]) -> bool:
        """Go on with other friction; return whether it is another."""
        values = {**self._values, **changes}
        before, self.constants = self.constants, PlantConstants.of(values)
        self._values = values
        if self.constants.model == before.model:
            return False
        self.plant.change(self.constants.model)
        return True

    def events(self) -> list[Event]:
        """
        Hand over the events since the last call.

        Returns
        -------
        list of Event
            Called after a sample: those that count from this sample on.

        """
        events, self._events = self._events, []
        return events

    # Samples.

    def take(self, stamp: int, command: Command | None = None) -> list[Measurement]:
        """
        Take a sample.

        Parameters
        ----------
        stamp : int
            Its time [ns].
        command : Command, optional
            What acted since the sample before, if that is known; otherwise the command held.

        Returns
        -------
        list of Measurement
            What the plant publishes, `joint_states` last: who answers it has all the others.

        Raises
        ------
        InsertedLengthError
            If the needle left the tissue.

        """
        acting = self.commands.held if command is None else command
        before = self.plant.depth
        measured = self.plant.take(acting.force, acting.torque)
        # Whole nanoseconds first: a float has too few digits for a stamp.
        if abs(stamp - self._stamp - self._period) > _ROUNDING:
            self._events.append(Event(TIME))
        self._stamp = stamp
        self.number += 1
        self.commands.hold(stamp, self.plant.depth - before)
        self._measured = measured
        return measured
