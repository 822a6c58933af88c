# SPDX-License-Identifier: Apache-2.0
"""Node `slicer`: OpenIGTLink connection to 3D Slicer, targets in and needle pose out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
import sys
from time import monotonic, monotonic_ns
from typing import Any, Final, TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, PoseArray, PoseStamped, PoseWithCovarianceStamped
from needle_controller.steering.insertion_plan import read_plan
from needle_insertion.graph.messages import target_message
from needle_insertion.slicer.link import Connection, LinkSettings
from needle_insertion.slicer.needle import MILLIMETERS, NeedleView, NodeStates, Registration, Shape
from needle_insertion.slicer.plan_files import planned_shape, PlannedShape
from needle_insertion.slicer.planning import SlicerPlanner, SlicerPlanSettings
from needle_ros import contract
from needle_ros.base_node import BaseNode, steady_timer
from needle_ros.contract import Topic
from needle_ros.errors import JobError, MessageError
from needle_ros.event_log import EventLog, Severity
from needle_ros.life_cycle_node import imports, PreparationProgress
from needle_ros.publishers_node import next_stamp
from needle_ros.requests import PendingRequest
from needle_ros.run_node import run
from needle_ros.status import Diagnosis, read_reports, SlicerPhase, SlicerStatus
from needle_ros.timing import nanoseconds, RateCounter, set_time
from needle_ros.wire import Reading

if TYPE_CHECKING:
    from needle_insertion.slicer.link import Frame
    from needle_insertion.slicer.messages import Interpreter

#: Time between two checks of the connection, and between two shapes [s].
_CHECK: Final = 0.02
_PERIOD: Final = 0.05

_AT_ONCE: Final = 16  #: largest number of messages per reading
_MOST_IGNORED: Final = 20  #: largest number of devices that are named because they are ignored

_PACKAGE: Final = 'pyigtl'

#: Modules and kernels of plans.
_OF_PLANS: Final = ('scipy.optimize', 'scipy.sparse', 'numba.core.boxing')
_KERNELS: Final = (
    'needle_planning.compiled.boxes',
    'needle_dynamics.compiled.cut',
    'needle_dynamics.compiled.cutting_needle',
    'needle_dynamics.compiled.superposition',
)
_TAKER: Final = 'controller or steering'  #: of targets until a node has answered


class SlicerNode(BaseNode):
    """
    Connect 3D Slicer by OpenIGTLink: targets to ``target``, the needle to 3D Slicer.

    It receives POINT, TRANSFORM and STRING messages with a target, in mm in the frame of the
    images, and publishes each target until a node acknowledges it. It transmits the shape of the
    needle and the pose of its tip at 20 Hz, the predicted tip pose, and the state of all nodes
    from ``/diagnostics``. The needle of ``plan`` is transmitted to each new peer.

    With ``planning.labels``, a label map (IMAGE) and a target become a plan, in a thread: its
    needle and one line about it are transmitted, and no target is published.

    ``registration.*`` is the pose of ``needle_entry`` in the images. The pose of the tip is also
    published on ``tip_pose``.

    The source of the shape is ``needle_poses``. Without this topic the shape is the line from the
    guide (``joint_states``) to the tip (``tip_deflection``), marked as not measured.

    A timer of the node serves the connection, without threads and blocking calls.
    """

    def __init__(self, **node_options: Any) -> None:
        super().__init__('slicer', **node_options)
        self.declare_settings('', LinkSettings())
        self.declare_settings('registration.', Registration())
        self.declare_settings('planning.', SlicerPlanSettings())
        self._link: Connection | None = None
        self._events, self._view, self._states = EventLog(), NeedleView(), NodeStates()
        self._interpreter: Interpreter | None = None
        #: Needle of the plan, and the peer that has received it.
        self._planned: PlannedShape | None = None
        self._planned_at = ''
        #: Planner, if there are labels; its last transmitted state, and the peer that has it.
        self._planner: SlicerPlanner | None = None
        self._told = '', ''
        self._shapes = self._targets = self._stamp = 0
        self._rate = RateCounter()
        #: Why the last target was refused, and types and devices that were named.
        self._refused, self._ignored = '', set[tuple[str, str]]()
        #: Unanswered target with its message.
        self._sending: tuple[PendingRequest, PointStamped] | None = None

    # Transitions.

    def preparation(self) -> Iterable[PreparationProgress]:
        """Import and compile also the functions of plans, if there are labels."""
        yield from super().preparation()
        if not self.text('planning.labels'):
            return
        # It imports Numba.
        from needle_dynamics.compiled.cache import prepare

        yield from imports(_OF_PLANS)
        for step in prepare(_KERNELS):
            yield PreparationProgress(*step)

    def configure(self) -> None:
        if find_spec(_PACKAGE) is None:
            raise JobError(
                f'the Python package {_PACKAGE} is not installed: '
                f"python3 -m pip install '{_PACKAGE}>=0.3.4'"
            )
        from needle_insertion.slicer import messages

        settings = self.settings('', LinkSettings)
        registration = self.settings('registration.', Registration)
        planning = self.settings('planning.', SlicerPlanSettings)
        largest = messages.largest_target
        self._interpreter = messages.Interpreter(registration, settings.reach)
        self._planned = planned_shape(read_plan(settings.plan)) if settings.plan else None
        if planning.labels:
            read = messages.read_segmentation
            self._planner = SlicerPlanner(planning, read, self._events, self._planned)
            largest = messages.largest_of_plans

        def wanted(kind: str, device: str) -> int:
            if not (size := largest(kind, device)):
                self._ignore(kind, device)
            return size

        self._link = Connection(settings, wanted, self._events)
        self._target = self.publisher(contract.TARGET)
        self._tip_pose = self.publisher(contract.TIP_POSE)
        # Sensor drivers may publish their shapes with the QoS of sensors.
        self.subscribe(replace(contract.NEEDLE_POSES, qos=contract.SENSOR), self._on_poses)
        self.listen(contract.JOINT_STATES, self._on_joints)
        self.listen(contract.TIP_DEFLECTION, self._on_tip)
        self.subscribe(contract.TIP_EXPECTED, self._on_expected)
        self.subscribe(contract.DIAGNOSTICS, self._on_diagnostics)

    def cleanup(self) -> None:
        if self._link is not None:
            self._link.close()
        if self._planner is not None:
            self._planner.close()
        self._link = self._interpreter = self._planner = None

    def activate(self) -> None:
        self._due = monotonic()
        self._timer = steady_timer(self, _CHECK, self._tick)

    def deactivate(self) -> None:
        self.destroy_timer(self._timer)
        if self._link is not None:
            self._link.close()

    def about(self) -> str:
        return (
            f'{self._link.state if self._link is not None else ""}; publishes '
            f'{contract.TARGET.name} and {contract.TIP_POSE.name}, subscribes to '
            f'{contract.NEEDLE_POSES.name}, or {contract.JOINT_STATES.name} and '
            f'{contract.TIP_DEFLECTION.name}'
        )

    # Messages of the nodes.

    @contextmanager
    def _rejecting(self, topic: Topic) -> Iterator[None]:
        try:
            yield
        except MessageError as error:
            self._events.reject(f'{topic.name} refused: {error}')

    def _on_poses(self, message: PoseArray) -> None:
        points = [(p.position.x, p.position.y, p.position.z) for p in message.poses]
        turn = _quaternion(message.poses[-1].orientation) if message.poses else []
        stamp = nanoseconds(message.header.stamp)
        with self._rejecting(contract.NEEDLE_POSES):
            _check_frame(message.header.frame_id)
            self._view.take_poses(stamp, points, turn, monotonic())

    def _on_joints(self, reading: Reading) -> None:
        if reading.joint(contract.INSERTION) is None:
            return
        # A guide without joints is at the entry point.
        at_x, at_z = reading.joint(contract.GUIDE_X), reading.joint(contract.GUIDE_Z)
        x, z = (0.0 if state is None else state[0] for state in (at_x, at_z))
        with self._rejecting(contract.JOINT_STATES):
            self._view.take_guide(x, z, monotonic())

    def _on_tip(self, reading: Reading) -> None:
        with self._rejecting(contract.TIP_DEFLECTION):
            _check_frame(reading.frame)
            self._view.take_tip(reading.stamp, reading.values[0], monotonic())

    def _on_expected(self, message: PoseWithCovarianceStamped) -> None:
        pose = message.pose.pose
        at = [pose.position.x, pose.position.y, pose.position.z]
        stamp = nanoseconds(message.header.stamp)
        with self._rejecting(contract.TIP_EXPECTED):
            _check_frame(message.header.frame_id)
            self._view.take_expected(stamp, at, _quaternion(pose.orientation))
            self._states.mark_changed(monotonic())

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for report in read_reports(message):
            self._states.take(report, monotonic())
            if self._sending is not None:
                self._sending[0].take_status(report.name, report.requests)

    # Messages of the peer.

    def _tick(self) -> None:
        link, interpreter = self._link, self._interpreter
        if link is None or interpreter is None:
            return
        frames = link.poll()
        if self._planner is None:
            self._take(interpreter, frames)
        else:
            self._take_for_plans(self._planner, frames)
            self._planner.poll()
            if (planned := self._planner.shape) is not self._planned:
                self._planned, self._planned_at = planned, ''
            self._send_plan_state(link, interpreter, self._planner.state)
        now = monotonic()
        if now >= self._due:
            # A delay of less than a period does not delay the next shape.
            self._due = max(self._due + _PERIOD, now - _PERIOD)
            if (shape := self._view.shape(now)) is not None:
                self._publish_tip(shape)
                self._send_shape(link, interpreter, shape)
        if self._states.is_due(link.peer, now):
            link.send(interpreter.state(self.now(), self._states.lines(now)))
            if self._view.expected is not None:
                link.send(interpreter.tip_expected(self._view.expected))
        self._send_plan(link)
        self._repeat_target()
        self.publish_events(self._events)

    def _repeat_target(self) -> None:
        if self._sending is None:
            return
        pending, message = self._sending
        if pending.done:
            self._sending = None
            accepted, line = pending.outcome
            if not accepted:
                self._refused = line
                self._events.add(Severity.ERROR, line, 'answer')
        elif pending.repeat():
            self._target.publish(message)

    def _take(self, interpreter: Interpreter, frames: list[Frame]) -> None:
        newest = None
        for frame in frames[-_AT_ONCE:]:
            try:
                found = interpreter.target(frame)
            except MessageError as error:
                self._refused = f'target refused: {error}'
                self._events.reject(self._refused)
                continue
            if found is None:
                self._ignore(frame.kind, frame.device)
            else:
                newest, self._refused = (frame, found.tolist()), ''
        if len(frames) > 2:
            self._events.add(
                Severity.WARNING,
                f'{len(frames)} messages within {_CHECK:g} s: only the newest target is used',
                'flood',
            )
        if newest is None:
            return
        frame, (x, y, z) = newest
        # The clock of the peer is not synchronized.
        self._stamp = next_stamp(self, self._stamp)
        message = target_message(self._stamp, (x, y, z))
        self._target.publish(message)
        self._sending = PendingRequest(contract.TARGET, self._stamp, _TAKER), message
        self._targets += 1
        subscribers = self._target.get_subscription_count()
        words = ', '.join(f'{MILLIMETERS * one:.2f}' for one in (x, y, z))
        self._events.add(
            Severity.INFO if subscribers else Severity.WARNING,
            f'target ({words}) mm in {contract.ENTRY}, by {frame.kind} of {frame.device}'
            + ('' if subscribers else f': no node subscribes to {contract.TARGET.name}'),
            'target',
        )

    def _take_for_plans(self, planner: SlicerPlanner, frames: list[Frame]) -> None:
        from needle_insertion.slicer.messages import target_in_images

        # Of several segmentations and targets of the same moment, the newest are used.
        for frame in [one for one in frames if one.kind == 'IMAGE'][-1:]:
            planner.take_segmentation(frame)
        for frame in [one for one in frames if one.kind != 'IMAGE'][-_AT_ONCE:]:
            try:
                found = target_in_images(frame)
            except MessageError as error:
                planner.refuse_target(str(error))
                continue
            if found is None:
                self._ignore(frame.kind, frame.device)
            else:
                planner.take_target(found)
                self._targets += 1

    def _ignore(self, kind: str, device: str) -> None:
        """Log once for each type and device that it has no target and no label map."""
        from needle_insertion.slicer.messages import ACCEPTED, TYPES

        named = self._ignored
        if kind in TYPES and (kind, device) not in named and len(named) < _MOST_IGNORED:
            named.add((kind, device))
            self._events.add(Severity.INFO, f'{kind} of {device!r} is ignored: {ACCEPTED}')

    def _send_plan_state(self, link: Connection, interpreter: Interpreter, state: str) -> None:
        from needle_insertion.slicer.messages import PLAN_STATE

        if (link.peer, state) != self._told and link.peer:
            message = interpreter.state(self.now(), [state], PLAN_STATE)
            self._told = link.peer if link.send(message) else '', state

    def _publish_tip(self, shape: Shape) -> None:
        message = PoseStamped()
        message.header.frame_id = contract.ENTRY
        set_time(message.header.stamp, shape.stamp)
        position, turn = message.pose.position, message.pose.orientation
        position.x, position.y, position.z = shape.points[-1].tolist()
        turn.x, turn.y, turn.z, turn.w = shape.turn.tolist()
        self._tip_pose.publish(message)

    def _send_shape(self, link: Connection, interpreter: Interpreter, shape: Shape) -> None:
        if not link.peer:
            return
        points, header = interpreter.shape(shape, self._shapes)
        if link.send(points) and link.send(header):
            self._shapes += 1
            self._rate.add(monotonic_ns())
        link.send(interpreter.tip(shape))

    def _send_plan(self, link: Connection) -> None:
        if self._planned is None or link.peer == self._planned_at:
            return
        from needle_insertion.slicer.messages import plan_messages

        sent = [link.send(one) for one in plan_messages(self._planned, self.now())]
        # A lost peer receives it again when it returns.
        self._planned_at = link.peer if all(sent) else ''

    # Status.

    def diagnose(self) -> Diagnosis[SlicerStatus]:
        link = self._link
        if link is None or not self.is_active:
            return Diagnosis(Severity.INFO, self.state, SlicerStatus())
        shape = self._view.shape(monotonic())
        source = '' if shape is None else shape.source
        shown = source or (
            f'none, neither {contract.NEEDLE_POSES.name} nor {contract.JOINT_STATES.name} with '
            f'{contract.TIP_DEFLECTION.name} received'
        )
        broken = SlicerPhase.ERROR if link.error else SlicerPhase.WAITING
        planning = self._planner.state if self._planner is not None else ''
        phase = SlicerPhase.CONNECTED if link.peer else broken
        status = SlicerStatus(
            phase=phase,
            peer=link.peer,
            error=link.error,
            shape_source=source,
            shapes=self._shapes,
            shape_rate=self._rate.rate(monotonic_ns()),
            left_out=link.left_out,
            targets=self._targets,
            rejected=self._events.rejected,
            last_rejection=self._events.last_rejection,
            planning=planning,
        )
        refused = Severity.WARNING if self._refused else Severity.INFO
        severity = Severity.ERROR if link.error else refused
        message = '; '.join(filter(None, (link.state, f'shape: {shown}', self._refused, planning)))
        return Diagnosis(severity, message, status)


def _quaternion(orientation: Any) -> list[float]:
    return [orientation.x, orientation.y, orientation.z, orientation.w]


def _check_frame(frame: str) -> None:
    # The plant may have a prefix.
    if frame and not frame.endswith(contract.ENTRY):
        raise MessageError(f'its frame must be {contract.ENTRY} or none, got {frame!r}')


if __name__ == '__main__':
    sys.exit(run(SlicerNode))
