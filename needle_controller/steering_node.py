"""Node `steering`: brings the tip to a target by moving the guide, one step at a time."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import asdict
import sys
from time import monotonic
from typing import Any

from builtin_interfaces.msg import Duration
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
from needle_controller.steering.belief import SteeringBelief
from needle_controller.steering.controller import TipEstimate
from needle_controller.steering.motion import Move
from needle_controller.steering.outer_loop import OuterLoop
from needle_controller.steering.responses import OF_NEEDLE, OF_STEERING, SteeringModel
from needle_controller.steering.settings import OuterLoopSettings
from needle_dynamics.compiled.cache import announce_compilation
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.simulated.assembly import defaults_of
from needle_dynamics.steering.parameters import NEEDLES, SteeringParameters
from needle_ros import contract
from needle_ros.base_node import BaseNode
from needle_ros.publishers_node import Publishers
from needle_ros.run_node import run
from needle_ros.settings import from_values
from needle_ros.timing import NANOSECONDS, nanoseconds
from needle_ros.wire import Reading
import numpy as np
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration as Delay
from rclpy.publisher import Publisher
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

#: Needle and tissue that are believed by default.
_PRESET = 'bending_35mm'

#: Time between two looks for what does not come [s].
_WATCH = 0.05

#: Longest time in which a motion arrives, in lock-step.
_ARRIVAL = Delay(seconds=1.0)


class SteeringNode(BaseNode):
    """
    Brings the tip to a ``target`` (point x, y, z [m]; y is the depth) by guide and roll.

    The needle goes in by steps. At the end of each it rests, and the readings of
    ``tip_deflection`` that come then are a look at the tip. Then the guide moves, by a
    ``joint_trajectory`` of `insertion`, `guide_x` and `guide_z`, with ``turns`` also `roll`; when
    it has arrived the next step begins. If it is ``continuous`` the needle does not rest, and the
    guide follows its depth. A robot follows all of it; where a controller moves the needle, with
    its parameter ``steered``, it follows the insertion. ``joint_states`` must have these joints.

    What is believed of needle and tissue is ``model.*`` and ``steering.*``, how far it may be
    wrong ``belief.*``. A target out of reach is refused, with what is within it. The needle stops
    when the tip freezes, is lost, slips or cannot be that of this needle, when a joint does not
    get to where it was sent, and by ``~/stop``. ``tip_expected`` says where the tip will be at
    the target depth.

    The node passes messages to an `OuterLoop`, which decides, and publishes what comes back.
    """

    def __init__(self, **node_options: Any) -> None:
        super().__init__('steering', **node_options)
        self.declare_settings('', OuterLoopSettings())
        self.declare_settings('belief.', SteeringBelief())
        # Fixed at start: the other defaults follow from it.
        self.declare_parameter(
            'model.preset',
            _PRESET,
            ParameterDescriptor(description=f'one of {", ".join(NEEDLES)}', read_only=True),
        )
        preset = str(self.get_parameter('model.preset').value)
        for prefix, names in (('model.', OF_NEEDLE), ('steering.', OF_STEERING)):
            self.declare_settings(prefix, defaults_of(prefix, preset), names)

        self._loop: OuterLoop | None = None
        #: What was last said of the tip.
        self._told: TipEstimate | None = None
        self._measurers = Publishers(self, contract.MEASURER, self._watch)
        self._trajectory = self.publisher(contract.JOINT_TRAJECTORY)
        self._tip_expected = self.publisher(contract.TIP_EXPECTED)
        for topic, take in (
            (contract.JOINT_STATES, OuterLoop.joints),
            (contract.TIP_DEFLECTION, OuterLoop.tip),
        ):
            self.listen(topic, self._passing(take), self._watch)
        self.subscribe(contract.TARGET, self._on_target)
        self.create_service(Trigger, '~/stop', self._on_stop)
        #: Reports which sample was processed, while the time is that of a plant.
        self._processed: Publisher | None = None
        #: Whether a motion was sent since the last report.
        self._moved = False
        #: A clock that stands still or jumps does not stop the watch.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)

    # Transitions.

    def configure(self) -> None:
        """Make the loop from the parameters."""
        preset, values = self.text('model.preset', tuple(NEEDLES)), self.values()

        def given(prefix: str, names: Collection[str]) -> dict[str, Any]:
            own = {name: values[f'{prefix}{name}'] for name in names}
            return {**asdict(defaults_of(prefix, preset)), **own}

        needle = from_values(NeedleParameters, given('model.', OF_NEEDLE), 'model.')
        steering = from_values(SteeringParameters, given('steering.', OF_STEERING), 'steering.')
        belief = self.settings('belief.', SteeringBelief)
        # Compile, or load what was compiled, before anything moves; and refuse what cannot be.
        SteeringModel(needle, steering, [0.0, 1e-3], belief)
        sim_time = self.get_parameter('use_sim_time').value
        self._loop = OuterLoop(
            needle,
            steering,
            belief,
            self.settings('', OuterLoopSettings),
            # In simulated time planning takes no time.
            (lambda: self.now() / NANOSECONDS) if sim_time else monotonic,
        )

    def cleanup(self) -> None:
        """Forget the loop."""
        self._loop = self._told = None

    def activate(self) -> None:
        """Begin to listen, and to watch for what does not come."""
        self._timer = self.create_timer(_WATCH, self._watch, clock=self._steady)
        if self.get_parameter('use_sim_time').value:
            self._processed = self.publisher(contract.PROCESSED, always=True)

    def deactivate(self) -> None:
        """Bring needle and guide to rest."""
        if self._loop is not None:
            self._act(self._loop.stop('the node was deactivated'))
        self.destroy_timer(self._timer)
        if self._processed is not None:
            self.destroy_publisher(self._processed)
            self._processed = None

    def about(self) -> str:
        """Name constants, steps and topics."""
        values = self.values()
        return (
            f'preset {values["model.preset"]}, steps of {1e3 * values["step_length"]:g} mm; takes '
            f'{contract.TARGET.name}, {contract.JOINT_STATES.name} and '
            f'{contract.TIP_DEFLECTION.name}, publishes {contract.JOINT_TRAJECTORY.name} and '
            f'{contract.TIP_EXPECTED.name}'
        )

    # What comes in.

    def _passing(
        self, take: Callable[[OuterLoop, Reading, int], Move | None]
    ) -> Callable[[Reading], None]:
        """Return what passes a reading on, and does what comes of it."""

        def on_reading(reading: Reading) -> None:
            if self._loop is not None and self.is_active:
                self._act(take(self._loop, reading, self.now()))
                if take is OuterLoop.joints:
                    self._report_processed(reading.stamp)

        return on_reading

    def _report_processed(self, stamp: int) -> None:
        """Report to a plant in lock-step that a sample is processed, once all motions arrived."""
        processed = self._processed
        if processed is None or not processed.get_subscription_count():
            return
        if self._moved:
            self._trajectory.wait_for_all_acked(_ARRIVAL)
            self._moved = False
        whole, part = divmod(stamp, NANOSECONDS)
        message = Header(frame_id=self.get_fully_qualified_name())
        message.stamp.sec, message.stamp.nanosec = whole, part
        processed.publish(message)

    def _on_target(self, message: PointStamped) -> None:
        if self._loop is None or not self.is_active:
            self.get_logger().error(
                'target refused: the node is not active', throttle_duration_sec=1.0
            )
            return
        header, point = message.header, message.point
        at = (point.x, point.y, point.z)
        stamp = nanoseconds(header.stamp)
        self._act(self._loop.target(stamp, header.frame_id, at, self.now()))

    def _on_stop(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._loop is not None and self._loop.steers:
            self._act(self._loop.stop('~/stop'))
            response.message = 'stopped; retract the needle before the next target'
        else:
            response.message = 'nothing was under way'
        response.success = True
        return response

    def _watch(self, _came: int = 0) -> None:
        """Look for what does not come, and who publishes what there may be one source of."""
        if self._loop is None or not self.is_active:
            return
        count = self._measurers.count
        self._loop.count_publishers(count(contract.JOINT_STATES), count(contract.TIP_DEFLECTION))
        self._act(self._loop.watch(self.now()))

    # What goes out.

    def _act(self, move: Move | None) -> None:
        """Publish a motion, and what there is to say."""
        loop = self._loop
        if loop is None:
            return
        if move is not None:
            self._trajectory.publish(self._message(move))
            self._moved = True
        if loop.expected is not self._told:
            self._told = loop.expected
            if loop.expected is not None:
                self._tell_tip(loop.expected, loop.depth)
        self.tell(loop.journal)

    def _message(self, move: Move) -> JointTrajectory:
        message = JointTrajectory(joint_names=list(move.joints))
        message.header.stamp = self.get_clock().now().to_msg()
        rows = zip(move.times.tolist(), move.positions, move.velocities, strict=True)
        for time, positions, velocities in rows:
            whole, part = divmod(round(time * NANOSECONDS), NANOSECONDS)
            message.points.append(
                JointTrajectoryPoint(
                    positions=positions.tolist(),
                    velocities=velocities.tolist(),
                    time_from_start=Duration(sec=whole, nanosec=part),
                )
            )
        return message

    def _tell_tip(self, there: TipEstimate, depth: float) -> None:
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

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Say what it does, what it expects and what is wrong."""
        if self._loop is None or not self.is_active:
            return super().diagnose()
        severity, state, values = self._loop.diagnose(self.now())
        return severity.level, state, values


def main() -> int:
    """Run the node; return its exit status."""
    announce_compilation()
    return run(SteeringNode)


if __name__ == '__main__':
    sys.exit(main())
