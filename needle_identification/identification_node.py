"""Node that identifies friction and stiffness, from recordings and from running topics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
import sys
import time
from typing import Any, ClassVar, Final

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import WrenchStamped
from needle_dynamics.compiled.cache import announce_compilation
from needle_identification.bags.bag import check_distinct
from needle_identification.estimation.estimate import Statistic, statistic
from needle_identification.estimation.formatting import measured
from needle_identification.friction.estimate import FrictionEstimate
from needle_identification.friction.identify import identify_friction
from needle_identification.friction.live import LiveFriction
from needle_identification.friction.settings import FrictionSettings
from needle_identification.friction.summary import summarize
from needle_identification.recordings.reading import (
    read_friction_recording,
    read_indentation_recording,
    TIMES,
)
from needle_identification.result import model_parameters, NODES, write_result
from needle_identification.stiffness.estimate import StiffnessEstimate
from needle_identification.stiffness.identify import identify_stiffness
from needle_identification.stiffness.settings import StiffnessSettings
from needle_identification.stiffness.summary import summarize_stiffness
from needle_ros.base_node import BaseNode, LATCHED, run, SENSOR
from needle_ros.errors import (
    NeedleError,
    ParameterError,
)
from needle_ros.settings import check_constants, constant
from needle_ros.timing import nanoseconds
from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.service import Service
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

#: Time that a node has to answer [s].
_ANSWER_TIME: Final = 5.0

#: What can be identified.
WHAT: Final = ('friction', 'stiffness')

_IDENTIFY: Final[Mapping[str, Callable[[Any, Any], Any]]] = {
    'friction': identify_friction,
    'stiffness': identify_stiffness,
}
_AXES: Final = ('x', 'y', 'z')
_COEFFICIENTS: Final = ('model.coulomb_friction', 'model.viscous_friction')


@dataclass(frozen=True, slots=True, kw_only=True)
class IdentificationSettings:
    """What the node itself needs to know."""

    level: float = constant(0.0, 'N', 'stiffness: force of the result; the largest there is if 0')
    forgetting: float = constant(
        60.0, 's', 'live: time in motion after which a sample counts 1/e', open_low=True
    )

    def __post_init__(self) -> None:
        check_constants(self)


class IdentificationNode(BaseNode):
    """
    Publishes ``friction`` or ``stiffness`` (latched) from the recordings named in ``bags``.

    It identifies when it is activated with recordings, and whenever ``~/identify`` is called;
    ``bags`` may change in between. With ``live`` it also takes ``joint_states`` and
    ``base_wrench`` as they come and publishes ``friction`` once a second. ``~/apply`` sets
    what was identified last in the nodes named in ``apply_to``; the answer tells what each took.

    Recordings are identified all or none, within the callback: the node does nothing else for
    some tenths of a second per recording.
    """

    LIVE: ClassVar[frozenset[str]] = frozenset({'bags'})

    def __init__(self, **node_options: Any) -> None:
        super().__init__('identification', **node_options)
        # An empty list would have no type.
        self.declare_text('bags', [''], 'recordings to identify from')
        self.declare_text('what', 'friction', ' or '.join(WHAT))
        self.declare_text('output', '', 'parameter file to write the result to; none if empty')
        self.declare_text('wrench_topic', '', 'topic of the force; found by its type if empty')
        self.declare_text('motion_topic', '', 'topic of the motion; found by its type if empty')
        self.declare_text('force_axis', 'y', 'friction: axis of the force, may be signed: -x')
        self.declare_text(
            'motion_axis',
            '',
            'friction: axis or joint of the motion, may be signed; y or insertion if empty',
        )
        self.declare_text('axes', ['x', 'z'], 'stiffness: axes of the plane, may be signed')
        self.declare_text('time', 'header', f'time that counts: {" or ".join(TIMES)}')
        self.declare_settings('friction.', FrictionSettings())
        self.declare_settings('stiffness.', StiffnessSettings())
        self.declare_text('live', False, 'identify friction from the running topics too')
        self.declare_settings('', IdentificationSettings())
        self.declare_text('apply_to', list(NODES), 'nodes that ~/apply sets parameters of')
        self._bags: list[Path] = []
        self._found: Sequence[Statistic] = ()
        self._words = ''
        self._live: LiveFriction | None = None
        self._applications: list[_Application] = []
        self._setters: dict[str, Client] = {}
        self._friction = self.create_publisher(DiagnosticArray, 'friction', LATCHED)
        self._stiffness = self.create_publisher(DiagnosticArray, 'stiffness', LATCHED)
        self.create_service(Trigger, '~/identify', self._on_identify)
        _answer_later(self.create_service(Trigger, '~/apply', self._on_apply))
        # A simulation that pauses must not leave a caller waiting.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_ANSWER_TIME / 10.0, self._end_applications, clock=steady)

    # Transitions.

    def configure(self) -> None:
        """Read what to identify from and how."""
        self._what = self.text('what', WHAT)
        self.text('time', TIMES)
        self._settings: dict[str, Any] = {
            'friction': self.settings('friction.', FrictionSettings),
            'stiffness': self.settings('stiffness.', StiffnessSettings),
        }
        self._own = self.settings('', IdentificationSettings)
        self._is_live = bool(self.get_parameter('live').value)
        self._force_sign, self._force_axis = _signed(self.text('force_axis'))
        if self._force_axis not in _AXES:
            raise ParameterError(
                f'force_axis must be x, y or z, or signed: -x, got {self.text("force_axis")!r}'
            )
        self._joint_sign, self._joint = _signed(self.text('motion_axis') or 'insertion')
        if len(self.get_parameter('axes').value) != 2:
            raise ParameterError(f'axes must be two, got {list(self.get_parameter("axes").value)}')
        self._bags = _paths(self.get_parameter('bags').value)
        self._setters = {
            name: self.create_client(SetParameters, f'{name}/set_parameters')
            for name in self.get_parameter('apply_to').value
        }

    def cleanup(self) -> None:
        """Let go of the nodes that results are applied to."""
        for client in self._setters.values():
            self.destroy_client(client)
        self._setters.clear()

    def activate(self) -> None:
        """Identify, if there is something to identify from, and listen, if that is wanted."""
        if self._bags:
            self._identify()
        if self._is_live:
            friction = self._settings['friction']
            self._live = LiveFriction(friction, self._own.forgetting)
            self._listening = (
                self.create_subscription(JointState, 'joint_states', self._on_motion, SENSOR),
                self.create_subscription(WrenchStamped, 'base_wrench', self._on_force, SENSOR),
            )
            self._timer = self.create_timer(1.0, self._publish_live)

    def deactivate(self) -> None:
        """Stop listening."""
        if self._is_live:
            self.destroy_timer(self._timer)
            for subscription in self._listening:
                self.destroy_subscription(subscription)

    def change(self, changes: Mapping[str, Any]) -> None:
        """Identify from other recordings when asked next."""
        self._bags = _paths(changes['bags'])

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Report the last result."""
        if self._live is not None:
            values: dict[str, object] = {'samples': self._live.samples, **self._live.dropped}
            if not self._live.samples:
                message = f'no joint_states of {self._joint} paired with base_wrench'
                return DiagnosticStatus.WARN, message, values
            return DiagnosticStatus.OK, _sentence(self._live_statistics()), values
        if not self._found:
            return DiagnosticStatus.OK, 'nothing identified yet', {}
        return DiagnosticStatus.OK, self._words, {}

    # Recordings.

    def _on_identify(
        self, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        try:
            self._identify()
            response.success, response.message = True, self._words
        except NeedleError as error:
            response.message = str(error)
            self.get_logger().error(response.message)
        return response

    def _identify(self) -> None:
        """Identify from the recordings, all or none, publish and write the result."""
        check_distinct(self._bags)
        estimates = []
        for bag in self._bags:
            recording = self._read(bag)
            estimate = _IDENTIFY[self._what](recording, self._settings[self._what])
            for words in (*recording.losses, *estimate.warnings):
                self.get_logger().warning(f'{bag}: {words}')
            estimates.append(estimate)
        friction = summarize(estimates) if self._what == 'friction' else None
        stiffness = None
        if self._what == 'stiffness':
            stiffness = summarize_stiffness(
                estimates,
                force=self._own.level or None,
                level_tolerance=self._settings['stiffness'].level_tolerance,
            )
        output = self.text('output')
        if output:
            write_result(Path(output), friction, stiffness)
        statuses: list[DiagnosticStatus] = []
        if friction is not None:
            self._found = friction.statistics
            samples = sum(one.samples for one in friction.estimates)
            statuses += [_of_statistic(one, samples=samples) for one in friction.statistics]
            statuses += [_of_friction(one) for one in friction.estimates]
            self._publish(self._friction, statuses)
        if stiffness is not None:
            self._found = (stiffness.tissue_stiffness,)
            statuses.append(_of_statistic(stiffness.tissue_stiffness))
            for level in stiffness.levels:
                statuses += [
                    _of_statistic(one, f' at {level.force:.2f} N') for one in level.statistics
                ]
            statuses += [_of_stiffness(one) for one in stiffness.estimates]
            self._publish(self._stiffness, statuses)
        self._words = f'{_sentence(self._found)} from {len(estimates)} recordings'
        self.get_logger().info(self._words)

    def _read(self, bag: Path) -> Any:
        """Read a recording as the parameters say."""
        topics: dict[str, Any] = {
            'wrench_topic': self.text('wrench_topic') or None,
            'motion_topic': self.text('motion_topic') or None,
            'time': self.text('time'),
        }
        if self._what == 'stiffness':
            axes = tuple(self.get_parameter('axes').value)
            return read_indentation_recording(bag, axes=axes, **topics)
        return read_friction_recording(
            bag,
            force_axis=self.text('force_axis'),
            motion_axis=self.text('motion_axis') or None,
            **topics,
        )

    def _publish(self, publisher: Publisher, statuses: list[DiagnosticStatus]) -> None:
        message = DiagnosticArray(status=statuses)
        message.header.stamp = self.get_clock().now().to_msg()
        publisher.publish(message)

    # Running topics.

    def _on_motion(self, message: JointState) -> None:
        live = self._live
        if live is None or self._joint not in message.name:
            return
        at, sign = list(message.name).index(self._joint), self._joint_sign
        if len(message.position) > at:
            speed = sign * message.velocity[at] if len(message.velocity) > at else None
            live.take_motion(nanoseconds(message.header.stamp), sign * message.position[at], speed)

    def _on_force(self, message: WrenchStamped) -> None:
        if self._live is not None:
            force = getattr(message.wrench.force, self._force_axis)
            self._live.take_force(nanoseconds(message.header.stamp), self._force_sign * force)

    def _live_statistics(self) -> list[Statistic]:
        estimates = () if self._live is None else self._live.estimate()
        return [replace(statistic([one]), interval=one.interval) for one in estimates]

    def _publish_live(self) -> None:
        found = self._live_statistics()
        if self._live is not None and found:
            if any(one.count for one in found):
                self._found = found
            samples = self._live.samples
            self._publish(
                self._friction,
                [_of_statistic(one, samples=samples, source='live') for one in found],
            )

    # Into running nodes.

    def _on_apply(
        self, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response | Future:
        """Set what was found last; the answer comes when all nodes have answered."""
        values = model_parameters(self._found)
        if not values:
            response.message = 'nothing identified yet that plant and controller take'
            return response
        request = SetParameters.Request(
            parameters=[
                Parameter(name, value=one).to_parameter_msg() for name, one in values.items()
            ]
        )
        asked = {
            name: client.call_async(request) if client.service_is_ready() else None
            for name, client in self._setters.items()
        }
        waiting = _Application(values, asked, response)
        self._applications.append(waiting)
        for future in asked.values():
            if future is not None:
                future.add_done_callback(lambda _future: self._end_applications())
        self._end_applications()
        return waiting.answer

    def _end_applications(self) -> None:
        """Answer those calls of ``~/apply`` that are complete or have waited long enough."""
        for waiting in [one for one in self._applications if one.is_over]:
            self._applications.remove(waiting)
            response = waiting.finish()
            # Two lines of code: rclpy refuses a second severity from the same one.
            if response.success:
                self.get_logger().info(response.message)
            else:
                self.get_logger().error(response.message)


class _Application:
    """What other nodes were asked to take, and their answers."""

    def __init__(
        self,
        values: Mapping[str, float | str],
        asked: Mapping[str, Future | None],
        response: Trigger.Response,
    ) -> None:
        self.answer = Future()
        self._values, self._asked, self._response = values, asked, response
        self._deadline = time.monotonic() + _ANSWER_TIME
        # A target that runs takes the coefficients of (15); the others are offered.
        self._needed = [name for name in _COEFFICIENTS if name in values] or list(values)

    @property
    def is_over(self) -> bool:
        """True if all have answered or time is up."""
        done = all(future is None or future.done() for future in self._asked.values())
        return done or time.monotonic() > self._deadline

    def finish(self) -> Trigger.Response:
        """Say what was set where, or why not; this is a success if a node took all it needs."""
        told = [self._outcome(name, future) for name, future in self._asked.items()]
        verdicts = [verdict for verdict, _ in told if verdict is not None]
        self._response.success = bool(verdicts) and all(verdicts)
        self._response.message = '; '.join(words for _, words in told)
        self.answer.set_result(self._response)
        return self._response

    def _outcome(self, node: str, future: Future | None) -> tuple[bool | None, str]:
        if future is None:
            return None, f'{node}: no such node'
        if not future.done():
            return False, f'{node}: no answer within {_ANSWER_TIME:g} s'
        results = dict(zip(self._values, future.result().results, strict=True))
        taken = [name for name, result in results.items() if result.successful]
        words = [f'{name} = {_brief(self._values[name])}' for name in taken]
        words += [
            f'not {name}: {one.reason}' for name, one in results.items() if name not in taken
        ]
        return all(name in taken for name in self._needed), f'{node}: {", ".join(words)}'


def _answer_later(service: Service) -> None:
    """
    Let the callback of a service return a future of its response.

    Rclpy's events executor takes no coroutines for callbacks: what it gets back is what it sends.
    """
    send = service.send_response

    def send_later(response: Any, header: Any) -> None:
        if isinstance(response, Future):
            response.add_done_callback(lambda done: send(done.result(), header))
        else:
            send(response, header)

    service.send_response = send_later  # type: ignore[method-assign]


def _paths(names: Sequence[str]) -> list[Path]:
    return [Path(name) for name in names if name]


def _signed(axis: str) -> tuple[float, str]:
    return (-1.0, axis[1:]) if axis.startswith('-') else (1.0, axis)


def _brief(value: float | str) -> str:
    return value if isinstance(value, str) else f'{value:.6g}'


def _of_statistic(
    one: Statistic, where: str = '', *, samples: int | None = None, source: str = 'recordings'
) -> DiagnosticStatus:
    values = {
        'estimate': one.mean,
        'interval_low': one.interval[0],
        'interval_high': one.interval[1],
        'unit': one.unit,
        'standard_error': one.error,
        'standard_deviation': one.deviation,
        'recordings': one.count,
        'samples': samples,
    }
    level = DiagnosticStatus.OK if one.count else DiagnosticStatus.WARN
    status = _status(f'{one.name}{where}', measured(one.mean, one.error, one.unit), values)
    status.level, status.hardware_id = level, source
    return status


def _of_friction(estimate: FrictionEstimate) -> DiagnosticStatus:
    others = (one for one in (estimate.breakaway, estimate.lag) if one is not None)
    return _status(
        estimate.name,
        f'R^2 = {estimate.determination:.4f}',
        {
            **{
                one.name: measured(one.value, one.error, one.unit)
                for one in (*estimate.parameters, *others)
            },
            'samples': estimate.samples,
            'residual': estimate.residual,
            'determination': estimate.determination,
            'condition': estimate.condition,
        },
    )


def _of_stiffness(estimate: StiffnessEstimate) -> DiagnosticStatus:
    worst = min(level.determination for level in estimate.levels)
    return _status(
        estimate.name,
        f'R^2 >= {worst:.4f}',
        {
            'presses': sum(level.presses for level in estimate.levels),
            'determination': worst,
            'condition': max(level.condition for level in estimate.levels),
            'off_plane': estimate.off_plane,
            **{f'at {level.force:.2f} N': level.words for level in estimate.levels},
        },
    )


def _status(name: str, words: str, values: Mapping[str, object]) -> DiagnosticStatus:
    return DiagnosticStatus(
        level=DiagnosticStatus.OK,
        name=name,
        message=words,
        values=[
            KeyValue(key=key, value=str(value))
            for key, value in values.items()
            if value is not None
        ],
    )


def _sentence(found: Sequence[Statistic]) -> str:
    return ', '.join(f'{one.symbol} = {measured(one.mean, one.error, one.unit)}' for one in found)


def main() -> int:
    """Run the node."""
    announce_compilation()
    return run(IdentificationNode)


if __name__ == '__main__':
    sys.exit(main())
