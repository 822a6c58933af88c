# SPDX-License-Identifier: Apache-2.0
"""Node `steering`: steer the tip to a target by motions of the guide."""

from collections.abc import Callable, Collection, Iterable
from dataclasses import asdict
import json
import sys
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
from needle_controller.steering.executive import SteeringExecutive
from needle_controller.steering.insertion_plan import in_layers, read_plan
from needle_controller.steering.insertion_record import RecordFile, SteeringRecord
from needle_controller.steering.law import DEFAULT_LAW, find_law, STEERING_LAWS, TipEstimate
from needle_controller.steering.motion import JointMotion
from needle_controller.steering.planning import ThreadJob
from needle_controller.steering.responses import OF_NEEDLE, OF_STEERING, SteeringModel
from needle_controller.steering.settings import ContactSettings, ExecutiveSettings, SteeringPrior
from needle_dynamics.model_node import CompiledNode, declare_needle
from needle_dynamics.needles import DEFAULT_NEEDLE
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.simulated.assembly import defaults_of
from needle_dynamics.steering.parameters import SteeringParameters
from needle_ros import contract
from needle_ros.base_node import steady_timer
from needle_ros.errors import MessageError, ParameterError
from needle_ros.event_log import Severity
from needle_ros.life_cycle_node import imports, PreparationProgress
from needle_ros.publishers_node import Publishers
from needle_ros.requests import RequestStatus, Verdict
from needle_ros.run_node import run
from needle_ros.settings import from_values
from needle_ros.status import Diagnosis, read_reports, SteeringStatus
from needle_ros.system_state import Authority
from needle_ros.system_state_node import SystemStateTopics
from needle_ros.timing import NANOSECONDS, nanoseconds, set_time
from needle_ros.trajectory_action_node import TrajectoryClient
from needle_ros.wire import Reading
import numpy as np
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from std_msgs.msg import Header, String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

_WATCH = 0.05  #: Time between two checks for missing inputs, and for a plan that is computed [s].
_ACTION = 'trajectory_action'  #: Parameter with the action of a robot.
_ARRIVAL = Duration(seconds=1.0)  #: Longest time until a motion is acknowledged, in lock-step.
_PLAN = 'plan'  #: Parameter with the file of a plan.
_OF_PLANS = ('needle_controller.steering.contact',)  #: Modules that a plan needs.
_SELDOM = 10.0  #: Shortest time between two warnings of a record that cannot be written [s].


class SteeringNode(CompiledNode):
    """
    Steer the tip to a ``target`` (point x, y, z [m]; y is the depth) by guide and roll.

    The needle is inserted in steps. At the end of each step it rests, and the readings of
    ``tip_deflection`` are averaged to a measurement of the tip. Then the guide moves, by a
    ``joint_trajectory`` of `insertion`, `guide_x` and `guide_z`, with ``turns`` also `roll`; when
    it has arrived the next step begins. With ``continuous`` the needle does not rest, and the
    guide follows its depth. A robot follows all joints; where a controller moves the needle, with
    its parameter ``steered``, it follows the insertion. ``joint_states`` must have these joints.

    The steering law is ``law``, see `build_law`. The nominal model of needle and tissue is
    ``model.*`` and ``steering.*``, its uncertainty ``prior.*``. The plan is computed in a thread:
    messages and ``~/stop`` do not wait for it. A target out of reach is rejected with the
    reachable range. Each motion is sent again until the robot follows it. The needle stops when
    the tip measurement freezes, is missing, slips or is implausible, when a node rejects a motion,
    when a joint does not arrive, and by ``~/stop`` of any node. ``~/pause`` holds needle and
    guide, ``~/retract`` withdraws the needle to ``retract_depth`` and returns the guide to its
    zero. ``tip_expected`` is the expected position of the tip at the target depth, if the law
    predicts it. ``insertion_record`` and a file have the plan, the measurements and the estimate:
    after a restart of the node, the target resumes the insertion if needle, guide and tip are
    where the record leaves them.

    With ``plan``, a file of ``needle plan``, an insertion has the steps of the plan, and its tip
    follows the path; a target must have the depth of the plan. Above a probability of contact of
    ``contact.limit`` the needle stops, is withdrawn, or follows another path.

    The node passes messages to an `SteeringExecutive`, which decides, and publishes its motions.
    """

    KERNELS = (
        'needle_controller.compiled.guide_plan',
        'needle_controller.compiled.hypotheses',
        # Of the laws `springs` and `broyden`.
        'needle_dynamics.compiled.cut',
        'needle_dynamics.compiled.cutting_needle',
        'needle_dynamics.compiled.superposition',
    )

    def __init__(self, **node_options: Any) -> None:
        super().__init__('steering', **node_options)
        self.declare_settings('', ExecutiveSettings())
        self.declare_settings('prior.', SteeringPrior())
        self.declare_settings('contact.', ContactSettings())
        self.declare_text(
            'law', DEFAULT_LAW, f'steering law: one of {", ".join(STEERING_LAWS)}, or module:Class'
        )
        self.declare_text(
            _ACTION,
            '',
            'action follow_joint_trajectory of a robot that moves needle and guide, such as '
            '/arm/follow_joint_trajectory; empty: the topic joint_trajectory',
        )
        self.declare_text(_PLAN, '', 'file of `needle plan -o` to insert along; empty: no plan')
        needle = declare_needle(self, DEFAULT_NEEDLE)
        for prefix, names in (('model.', OF_NEEDLE), ('steering.', OF_STEERING)):
            self.declare_settings(prefix, defaults_of(prefix, needle), names)

        self._loop: SteeringExecutive | None = None
        #: Sends the motions to the action of a robot.
        self._client: TrajectoryClient | None = None
        self._file = RecordFile(self.get_fully_qualified_name(), self.context.get_domain_id())
        #: Record before a restart and the source of its measurements, until they are compared.
        self._before: tuple[SteeringRecord, str] | None = None
        self._published_tip: TipEstimate | None = None  #: Expected tip of the last publication.
        self._authority = Authority()  #: State of the system, also before the node is configured.
        self._system = SystemStateTopics(self, self._authority, self._on_request, self._obey)
        #: Reports the processed sample, with simulated time.
        self._processed: Publisher | None = None
        #: Processed sample that is not reported yet: a plan is computed first.
        self._unreported: int | None = None
        self._moved = False  #: Whether a motion was sent since the last report.

    # Transitions.

    def preparation(self) -> Iterable[PreparationProgress]:
        """Import also the monitoring of the clearance, with a plan."""
        yield from super().preparation()
        if self.text(_PLAN):
            yield from imports(_OF_PLANS)

    def configure(self) -> None:
        """Create the steering executive from the parameters."""
        name, values = self.text('needle'), self.values()

        def given(prefix: str, names: Collection[str]) -> dict[str, Any]:
            own = {name: values[f'{prefix}{name}'] for name in names}
            return {**asdict(defaults_of(prefix, name)), **own}

        needle = from_values(NeedleParameters, given('model.', OF_NEEDLE), 'model.')
        steering = from_values(SteeringParameters, given('steering.', OF_STEERING), 'steering.')
        prior = self.settings('prior.', SteeringPrior)
        # Load or compile the functions before any motion; and reject invalid constants.
        SteeringModel(needle, steering, [0.0, 1e-3], prior)
        settings = self.settings('', ExecutiveSettings)
        law = self.text('law')
        find_law(law)
        plan = read_plan(file) if (file := self.text(_PLAN)) else None
        if plan is not None and plan.needle != name:
            raise ParameterError(f'{file} is a plan for the needle {plan.needle}, got {name}')
        if plan is not None:
            needle, steering, prior = in_layers(plan.layers, needle, steering, prior)
        self._loop = SteeringExecutive(
            needle,
            steering,
            prior,
            settings,
            start=ThreadJob,
            law=law,
            plan=plan,
            contact=self.settings('contact.', ContactSettings),
        )
        self._loop.authority = self._authority
        self._measurers = Publishers(self, contract.MEASURER, self._watch)
        if action := self.text(_ACTION):
            if settings.continuous:
                raise ParameterError(
                    f'continuous must be false with {_ACTION}: needle and guide are moved by '
                    'separate trajectories, of which the action follows one'
                )
            self._client = TrajectoryClient(self, action, self._take_answers)
        self._trajectory = self.publisher(contract.JOINT_TRAJECTORY)
        self._tip_expected = self.publisher(contract.TIP_EXPECTED)
        self._record = self.publisher(contract.INSERTION_RECORD)
        try:
            self._before = self._file.read()
        except MessageError as error:
            self.get_logger().warning(f'the insertion before cannot be resumed: {error}')
        for topic, take in (
            (contract.JOINT_STATES, SteeringExecutive.joints),
            (contract.TIP_DEFLECTION, SteeringExecutive.tip),
        ):
            self.listen(topic, self._passing(take), self._watch)
        self.subscribe(contract.TARGET, self._on_target)
        self.subscribe(contract.DIAGNOSTICS, self._on_diagnostics)

    def cleanup(self) -> None:
        self._loop = self._published_tip = self._before = None
        if self._client is not None:
            self._client.destroy()
            self._client = None

    def activate(self) -> None:
        """Start to process measurements, and to check for missing inputs."""
        self._timer = steady_timer(self, _WATCH, self._watch)
        if self.get_parameter('use_sim_time').value:
            self._processed = self.publisher(contract.PROCESSED, always=True)

    def deactivate(self) -> None:
        """Bring needle and guide to rest."""
        if self._loop is not None:
            self._act(self._loop.halt('the node was deactivated', self.now()))
        self.destroy_timer(self._timer)
        if self._processed is not None:
            self.destroy_publisher(self._processed)
            self._processed = None

    def about(self) -> str:
        values = self.values()
        return (
            f'law {values["law"]}, needle {values["needle"]}, steps of '
            f'{1e3 * values["step_length"]:g} mm; takes {contract.TARGET.name}, '
            f'{contract.JOINT_STATES.name} and {contract.TIP_DEFLECTION.name}, publishes '
            f'{values[_ACTION] or contract.JOINT_TRAJECTORY.name} and {contract.TIP_EXPECTED.name}'
        )

    # Inputs.

    def _passing(
        self, take: Callable[[SteeringExecutive, Reading, int], JointMotion | None]
    ) -> Callable[[Reading], None]:

        def on_reading(reading: Reading) -> None:
            if self._loop is not None and self.is_active:
                self._act(take(self._loop, reading, self.now()))
                if take is SteeringExecutive.joints:
                    self._unreported = reading.stamp
                    self._report_processed()

        return on_reading

    def _report_processed(self) -> None:
        """Report a processed sample to a plant in lock-step, after all motions arrived."""
        processed, stamp, loop = self._processed, self._unreported, self._loop
        if processed is None or stamp is None or loop is None or loop.busy:
            return
        self._unreported = None
        if not processed.get_subscription_count():
            return
        if self._moved:
            self._trajectory.wait_for_all_acked(_ARRIVAL)
            self._moved = False
        message = Header(frame_id=self.get_fully_qualified_name())
        set_time(message.stamp, stamp)
        processed.publish(message)

    def _on_target(self, message: PointStamped) -> None:
        stamp = nanoseconds(message.header.stamp)
        if self._loop is None or not self.is_active:
            why = 'the node is not active'
            self.get_logger().error(f'target rejected: {why}', throttle_duration_sec=1.0)
            if self._loop is not None:
                self._loop.requests.answer(contract.TARGET, stamp, Verdict.REJECTED, why)
                self._act(None)
            return
        self._recall(self._loop)
        header, point = message.header, message.point
        at = (point.x, point.y, point.z)
        self._act(self._loop.target(stamp, header.frame_id, at, self.now()))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        if self._client is not None:
            # The action answers; receivers of the topic take none of the motions.
            return
        for report in read_reports(message):
            if report.requests.takes:
                self._take_answers(report.name, report.requests)

    def _take_answers(self, receiver: str, answers: RequestStatus) -> None:
        if self._loop is not None and self.is_active:
            self._act(self._loop.receive(receiver, answers, self.now()))

    def _on_request(self, word: str) -> tuple[bool, str]:
        if self._loop is None:
            return self._authority.request(word)
        success, line, move = self._loop.request(word, self.now())
        self._act(move)
        return success, line

    @property
    def _source(self) -> str:
        """Identifiers of the publishers of the joint states."""
        found = self.get_publishers_info_by_topic(contract.JOINT_STATES.name)
        return ' '.join(sorted(bytes(one.endpoint_gid).hex() for one in found))

    def _recall(self, loop: SteeringExecutive) -> None:
        """Use the record before a restart, if the measurements are from the same source."""
        if self._before is None or not (source := self._source):
            return
        (record, owner), self._before = self._before, None
        if owner == source:
            loop.planner.recalled = record
            self._record.publish(String(data=json.dumps(record.to_values())))

    def _keep(self, record: SteeringRecord) -> None:
        text = json.dumps(record.to_values())
        self._record.publish(String(data=text))
        try:
            self._file.write(text, self._source)
        except ParameterError as error:
            self.get_logger().warning(
                f'the insertion cannot be resumed: {error}', throttle_duration_sec=_SELDOM
            )

    def _obey(self) -> None:
        if self._loop is not None and self.is_active:
            self._act(self._loop.obey(self.now()))

    def _watch(self, _matched: int = 0) -> None:
        """Check for missing inputs, for duplicate publishers, and for a plan that is computed."""
        if self._loop is None or not self.is_active:
            return
        self._recall(self._loop)
        count = self._measurers.count
        self._loop.count_publishers(count(contract.JOINT_STATES), count(contract.TIP_DEFLECTION))
        # The state may have changed before the activation.
        self._obey()
        self._act(self._loop.watch(self.now()))
        self._report_processed()

    # Outputs.

    def _act(self, move: JointMotion | None) -> None:
        """Publish a motion, the expected tip, lines for the log and answers to requests."""
        loop = self._loop
        if loop is None:
            return
        # Not of a node that is deactivated: its insertion can be resumed.
        record = loop.keeper.changed(loop.fault) if self.is_active else None
        if record is not None:
            self._keep(record)
        if move is not None:
            message = self._message(move)
            if self._client is not None:
                self._client.send(message)
            else:
                self._trajectory.publish(message)
                self._moved = True
        self._system.publish()
        if loop.expected is not self._published_tip:
            self._published_tip = loop.expected
            if loop.expected is not None:
                self._publish_tip(loop.expected, loop.depth)
        self.publish_events(loop.events)
        if loop.requests.due():
            self.publish_diagnostics()

    def _message(self, move: JointMotion) -> JointTrajectory:
        message = JointTrajectory(joint_names=list(move.joints))
        set_time(message.header.stamp, move.stamp)
        rows = zip(move.times.tolist(), move.positions, move.velocities, strict=True)
        for time, positions, velocities in rows:
            point = JointTrajectoryPoint(
                positions=positions.tolist(), velocities=velocities.tolist()
            )
            set_time(point.time_from_start, round(time * NANOSECONDS))
            message.points.append(point)
        return message

    def _publish_tip(self, there: TipEstimate, depth: float) -> None:
        message = PoseWithCovarianceStamped()
        message.header.frame_id = contract.ENTRY
        message.header.stamp = self.get_clock().now().to_msg()
        position, (x, z) = message.pose.pose.position, there.mean.tolist()
        position.x, position.y, position.z = x, depth, z
        message.pose.pose.orientation.w = 1.0
        covariance = np.zeros((6, 6))
        covariance[np.ix_((0, 2), (0, 2))] = there.covariance
        message.pose.covariance = covariance.ravel()
        self._tip_expected.publish(message)

    def diagnose(self) -> Diagnosis[SteeringStatus]:
        if self._loop is None:
            return Diagnosis(Severity.INFO, self.state, SteeringStatus())
        if not self.is_active:
            status = SteeringStatus(requests=self._loop.requests.status())
            return Diagnosis(Severity.INFO, self.state, status)
        return Diagnosis(*self._loop.diagnose(self.now()))


if __name__ == '__main__':
    sys.exit(run(SteeringNode))
