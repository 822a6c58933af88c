# SPDX-License-Identifier: Apache-2.0
"""
Run of a simulated plant: samples and events, shared by the node and the replay.

An `Event` is an input other than a command. It takes effect from the next sample on, and a replay
performs it again. `Executions` are the paths under way, which a pause holds.
"""

from collections.abc import Collection, Mapping, Sequence
from math import nan
from typing import Any, Final, NamedTuple

from needle_dynamics.simulated.assembly import PlantConstants
from needle_dynamics.simulated.commands import AppliedForces, Commands, moved_joints
from needle_dynamics.simulated.indenter import JOINTS as PRESS_JOINTS
from needle_dynamics.simulated.plant import Measurement, SimulatedPlant
from needle_ros.contract import INSERTION, JOINT_COMMANDS, JOINT_STATES, Topic
from needle_ros.errors import ParameterError
from needle_ros.system_state import Mode, RETRACT_DEPTH
from needle_ros.timing import NANOSECONDS
from needle_ros.trajectories import FollowedJoint, JointPath
from needle_ros.wire import Reading

#: Event kinds.
CONFIGURED: Final = 'configured'
TIME: Final = 'time'
TRAJECTORY: Final = 'trajectory'
MOTION: Final = 'motion'
PARAMETERS: Final = 'parameters'
TARE: Final = 'tare'
RESET: Final = 'reset'

_HALT: Final = 0.05  #: time in which joints settle at their positions [s]
_JOINED: Final = 1e-4  #: distance from a command at which a joint follows again [m or rad]
_WITHDRAWAL: Final = 0.01  #: mean velocity of a retraction [m/s]
_ROUNDING: Final = 2  #: tolerance of the period due to the rounding of stamps [ns]


class Event(NamedTuple):
    """Input of a plant other than commands, effective from the next sample on."""

    #: ``configured``: the plant was built from the parameters in ``content``. ``time``: the sample
    #: is not one period after the previous one. ``trajectory``: ``content`` has the arguments of
    #: `Plant.follow`. ``motion``: likewise, from `joint_commands`. ``parameters``: the parameters
    #: in ``content`` changed. ``tare``: the force sensor was zeroed. ``reset``: state, sensor and
    #: noise were reset to their start.
    kind: str
    content: Mapping[str, Any] = {}  #: JSON-compatible values


class PlantRun:
    """Simulated plant with commands and events; ``number`` counts samples since the first run."""

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
        #: Stamp of the newest sample [ns].
        self._stamp = -NANOSECONDS
        self._events = [Event(CONFIGURED, self._values)]
        #: Latest measurements.
        self._measured: list[Measurement] = []
        #: Joints that the latest `joint_commands` have moved.
        self.commanded: set[str] = set()
        self.mode = Mode.RUNNING  #: Mode of the system, for `joint_commands`.
        #: Joints that ignore `joint_commands` since a stop or a withdrawal.
        self._apart: set[str] = set()

    # Commands.

    def begin(self) -> None:
        """Discard commands and their senders, as at an activation."""
        self.commands.begin()
        self._joint_commands.forget()

    def command_joints(self, reading: Reading, now: int) -> tuple[bool, str]:
        """Process a `joint_commands` message at a time [ns]; return as `Commands.offer`."""
        commands = self.commands
        self.commanded = set()
        try:
            asked = self._joint_commands.read(reading, self._positions(), now)
            counts, refusal = commands.offer(asked.stamp, '', asked.force, asked.torque, now)
            moves = commands.may_move(now) and self.mode is not Mode.PAUSED
            if counts and not refusal and moves:
                for asked_for, within in asked.motions:
                    if goals := self._joined(asked_for):
                        content = {
                            'joints': list(goals),
                            'times': [within],
                            'positions': [list(goals.values())],
                            'efforts': [[]],
                        }
                        self.perform(Event(MOTION, content))
                        self.commanded |= {*goals}
                self._joint_commands.accept(asked)
        except ParameterError as error:
            commands.refuse()
            return True, f'{JOINT_COMMANDS.name}: {error}; no force is applied'
        return counts, refusal

    def _joined(self, goals: Mapping[str, float]) -> Mapping[str, float]:
        """Return the goals of joints that do not ignore them; a goal at the joint ends this."""
        if self.mode is Mode.RETRACTING:
            # The plant withdraws the needle; the guide returns to its zero.
            goals = {name: goal for name, goal in goals.items() if name != INSERTION}
        # A driver of ros2_control does not know a stop: its setpoint has moved on.
        if not self._apart:
            return goals
        at = self._positions()
        self._apart -= {
            name for name, goal in goals.items() if abs(goal - at.get(name, goal)) <= _JOINED
        }
        return {name: goal for name, goal in goals.items() if name not in self._apart}

    def followed(self) -> dict[str, FollowedJoint]:
        """Return reference and measurement of each joint that follows trajectories."""
        at = self._measured_joints()
        return {
            name: FollowedJoint(reference, at[name])
            for name, reference in self.plant.references().items()
        }

    def _measured_joints(self) -> dict[str, tuple[float, float, float]]:
        if JOINT_STATES.name in self.topics:
            joints = self.topics[JOINT_STATES.name].joints
            *_, (_, _, values) = self._measured
            count = len(joints)
            return {
                joint.name: (values[k], values[k + count], values[k + 2 * count])
                for k, joint in enumerate(joints)
            }
        (_, _, wrench), (_, _, pose) = self._measured
        x, z = PRESS_JOINTS
        return {x: (pose[0], nan, wrench[0]), z: (pose[2], nan, wrench[2])}

    def _positions(self) -> dict[str, float]:
        """Return the joint positions measured by the encoders [m or rad]."""
        if not self._measured or JOINT_STATES.name not in self.topics:
            return {INSERTION: self.plant.depth}
        return {name: position for name, (position, _, _) in self._measured_joints().items()}

    def halt(self) -> None:
        """End every force and motion, of the needle and of all joints that move by themselves."""
        self.commands.stop()
        self._apart = {*moved_joints(self.constants.mode, steered=self.constants.steered)}
        self.hold(moved_joints(self.constants.mode, steered=self.constants.steered))

    def hold(self, joints: Sequence[str]) -> None:
        """End the motion of joints at their positions, or every force of an indenter."""
        if self.constants.mode == 'indenter':
            self._follow(PRESS_JOINTS, _HALT, [], [0.0] * len(PRESS_JOINTS))
        # Before the first sample, all joints rest.
        elif joints and self._measured:
            ends = self._positions()
            if INSERTION in joints:
                ends[INSERTION] = self._braked(*self._measured_joints()[INSERTION][:2])
            self._follow(joints, 0.0, [ends[name] for name in joints], [])

    def _braked(self, depth: float, velocity: float) -> float:
        """Return the depth of the needle at rest [m]; withdrawn, where the base stops."""
        # A return to the present depth would insert it.
        outward, constants = min(velocity, 0.0), self.constants
        distance = outward**2 / (2.0 * constants.base.acceleration_limit)
        lowest = min(depth, constants.model.minimum_depth)
        return max(depth - distance + outward / constants.own.rate, lowest)

    def withdraw(self) -> None:
        """Withdraw the needle by its own base, if it has one."""
        if self.constants.mode == 'robot':
            self._apart.add(INSERTION)
            at = self._positions()[INSERTION]
            end = min(at, RETRACT_DEPTH)
            self._follow((INSERTION,), (at - end) / _WITHDRAWAL + _HALT, [end], [])

    def _follow(
        self, joints: Sequence[str], time: float, positions: list[float], efforts: list[float]
    ) -> None:
        """Perform a trajectory with one point at a time from now [s]."""
        content = {'joints': [*joints], 'times': [time], 'positions': [positions]}
        self.perform(Event(TRAJECTORY, {**content, 'efforts': [efforts]}))

    # Events.

    def perform(self, event: Event) -> None:
        """Apply an event; ParameterError if it is invalid, JobError if the sensor is not tared."""
        if event.kind in (TRAJECTORY, MOTION):
            self.plant.follow(**event.content)
        elif event.kind == PARAMETERS:
            if not self._change(event.content):
                return
        elif event.kind == TARE:
            self.plant.tare()
        elif event.kind == RESET:
            self.plant = self.constants.make()
            self._measured = []
            self.commands.forget()
            self._joint_commands.forget()
        self._events.append(event)

    def _change(self, changes: Mapping[str, Any]) -> bool:
        values = {**self._values, **changes}
        constants = PlantConstants.of(values)
        changes_model = constants.model != self.constants.model
        if changes_model:
            self.plant.change(constants.model)
        self.constants, self._values = constants, values
        return changes_model

    def events(self) -> list[Event]:
        """Return and clear the events since the last call."""
        events, self._events = self._events, []
        return events

    # Samples.

    def take(self, stamp: int, command: AppliedForces | None = None) -> list[Measurement]:
        """Take a sample after a command, by default the acting one; `joint_states` is last."""
        acting = self.commands.acting if command is None else command
        before = self.plant.depth
        measured = self.plant.take(acting.force, acting.torque)
        # Integer difference first: a float has too few digits for a stamp.
        if abs(stamp - self._stamp - self._period) > _ROUNDING:
            self._events.append(Event(TIME))
        self._stamp = stamp
        self.number += 1
        self.commands.hold(stamp, self.plant.depth - before)
        self._measured = measured
        return measured


def follow(path: JointPath, moved: Sequence[str], plant_run: PlantRun, elapsed: float) -> None:
    """Follow a trajectory, at a time after its start [s]; without points, stop its joints."""
    if path.stops:
        if path.joints and not moved:
            raise ParameterError(f'moves none of the joints {list(path.joints)}')
        plant_run.hold(moved)
        return
    joints, times, positions, _, efforts = path.after(elapsed)
    content = {'joints': joints, 'times': times, 'positions': positions, 'efforts': efforts}
    plant_run.perform(Event(TRAJECTORY, content))


class _Execution(NamedTuple):
    """Path that some of its joints follow, and its start in the time of the plant [s]."""

    path: JointPath
    joints: frozenset[str]
    begun: float


class Executions:
    """
    Paths under way of the joints ``moved``; a pause holds the rest of each.

    `sampled` is the stamp of the newest sample [ns], 0 before the first.
    """

    def __init__(self, plant_run: PlantRun, moved: Collection[str]) -> None:
        self._run, self._moved = plant_run, moved
        self.sampled = 0
        self.period = round(NANOSECONDS / plant_run.constants.own.rate)
        self._running: list[_Execution] = []
        self._held: list[_Execution] = []
        self._paused: float | None = None  #: start of the pause in the time of the plant [s]

    @property
    def paused(self) -> bool:
        return self._paused is not None

    @property
    def joints_held(self) -> set[str]:
        return {name for one in self._held for name in one.joints}

    def follow(self, path: JointPath, joints: Collection[str], elapsed: float) -> None:
        """Follow a path with some joints, at a time after its start [s]."""
        follow(path, tuple(joints), self._run, elapsed)
        self.forget(joints)
        if not path.stops:
            begun = self._run.plant.time - elapsed
            self._running.append(_Execution(path, frozenset(joints), begun))

    def forget(self, joints: Collection[str]) -> None:
        """Discard the paths of joints that something else moves."""
        for paths in (self._running, self._held):
            kept = [one._replace(joints=one.joints - {*joints}) for one in paths]
            paths[:] = [one for one in kept if one.joints]

    def pause(self, *, withdraws: bool = False) -> None:
        """Hold the joints that move, or all if the plant withdraws; begin no motion."""
        plant = self._run.plant
        self._paused = plant.time
        moving = {name for name, joint in plant.references().items() if not joint.arrived}
        self._held = [one for one in self._running if one.joints & moving]
        self._running, joints = [], self.joints_held
        # At rest nothing changes: an indenter keeps its force.
        if joints or withdraws:
            self._run.hold([name for name in self._moved if name in joints or withdraws])

    def resume(self) -> None:
        """End a pause: follow the rest of the paths that it holds."""
        begun, held = self._paused or 0.0, self._held
        self._paused, self._held = None, []
        for one in held:
            path = one.path.only(one.joints)
            self.follow(path, path.joints, begun - one.begun)
