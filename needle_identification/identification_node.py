# SPDX-License-Identifier: Apache-2.0
"""Node that identifies friction and stiffness from recordings and from running topics."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
import sys
from time import monotonic
from typing import Any, ClassVar, Final

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from needle_identification.estimation.estimate import measured, Statistic
from needle_identification.friction.estimate import FrictionEstimate, FrictionSummary, summarize
from needle_identification.friction.identify import identify_friction
from needle_identification.friction.settings import FrictionSettings
from needle_identification.recordings import TIMES
from needle_identification.recordings.live import LiveRecording
from needle_identification.recordings.reading import (
    read_friction_recording,
    read_indentation_recording,
    scaled_axis,
)
from needle_identification.result import limited, model_parameters, NODES, write_result
from needle_identification.stiffness.identify import (
    identify_stiffness,
    StiffnessEstimate,
    StiffnessSummary,
    summarize_stiffness,
)
from needle_identification.stiffness.plateaus import StiffnessSettings
from needle_ros import contract
from needle_ros.base_node import BaseNode, profile, steady_timer
from needle_ros.calls_node import Calls
from needle_ros.errors import NeedleError, ParameterError
from needle_ros.event_log import Severity
from needle_ros.quantities import AXES, signed, signed_axis
from needle_ros.requests import no_answer
from needle_ros.run_node import run
from needle_ros.services_node import answer_later
from needle_ros.settings import CheckedSettings, constant, positive
from needle_ros.status import Diagnosis, IdentificationStatus
from needle_ros.wire import Reading
from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.exceptions import InvalidServiceNameException
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.task import Future
from std_srvs.srv import Trigger

WHAT: Final = ('friction', 'stiffness')  #: quantities that can be identified

#: Parameters that a running plant can change; all others are fixed.
_COEFFICIENTS: Final = ('model.coulomb_friction', 'model.viscous_friction')

#: QoS for all samples that arrive during an identification, and the least time from its start to
#: the next start, as a multiple of its duration.
_ALL: Final = profile(contract.SENSOR._replace(depth=5000), request=True)
_REST: Final = 5.0
_TAKE_PERIOD: Final = 0.02  # period of taking received messages [s]


@dataclass(frozen=True, slots=True, kw_only=True)
class IdentificationSettings(CheckedSettings):
    """Settings of the node; each field has its meaning and unit."""

    level: float = constant(0.0, 'N', 'stiffness: force level of the result; 0: the largest')
    window: float = positive(60.0, 's', 'live: duration of the last motions that are used')


def _outcome(
    node: str, values: Mapping[str, float | str], answer: Future | None
) -> tuple[bool | None, str]:
    """Return whether a node set all that it can (None: there is no such node), and a message."""
    if answer is None:
        return None, f'{node}: no such node'
    response = answer.result()
    if response is None:
        return False, no_answer(f'{node}/set_parameters')
    results = dict(zip(values, response.results, strict=True))
    taken = [name for name, result in results.items() if result.successful]
    shown = {k: v if isinstance(v, str) else f'{v:.6g}' for k, v in values.items()}
    words = [f'{name} = {shown[name]}' for name in taken]
    words += [f'not {name}: {one.reason}' for name, one in results.items() if name not in taken]
    needed = [name for name in _COEFFICIENTS if name in values] or list(values)
    return all(name in taken for name in needed), f'{node}: {", ".join(words)}'


class IdentificationNode(BaseNode):
    """
    Identifies friction or stiffness from recordings and from running topics.

    The result is published latched on ``friction`` or ``stiffness``. Recordings named in ``bags``
    are identified on activation and by each call of ``~/identify``; ``bags`` may change in
    between. With ``live`` the node also subscribes to ``joint_states`` and ``base_wrench``, and
    once a second identifies ``friction`` from their last motions as from a recording. ``~/apply``
    sets the last result in the nodes named in ``apply_to``; the response lists the parameters that
    each node set.

    Identification fails as a whole if a recording cannot be identified. It runs within the
    callback, which blocks the node for some tenths of a second per recording.
    """

    LIVE: ClassVar[frozenset[str]] = frozenset({'bags'})

    def __init__(self, **node_options: Any) -> None:
        super().__init__('identification', **node_options)
        # The type of an empty list is undefined.
        self.declare_text('bags', [''], 'recordings to identify from')
        self.declare_text('what', 'friction', ' or '.join(WHAT), WHAT)
        self.declare_text('output', '', 'parameter file to write the result to; none if empty')
        self.declare_text(
            'wrench_topic', '', 'of a bag, topic of the force; found by its type if empty'
        )
        self.declare_text(
            'motion_topic', '', 'of a bag, topic of the motion; found by its type if empty'
        )
        self.declare_text('force_axis', 'y', 'friction: axis of the force, may be signed: -x')
        self.declare_text(
            'motion_axis',
            '',
            'friction: axis or joint of the motion, may be signed; y or insertion if empty',
        )
        self.declare_text('axes', ['x', 'z'], 'stiffness: axes of the plane, may be signed')
        self.declare_text('time', 'header', f'stamps to use: {" or ".join(TIMES)}', TIMES)
        self.declare_settings('friction.', FrictionSettings())
        self.declare_settings('stiffness.', StiffnessSettings())
        self.declare_text('live', False, 'identify friction from the running topics too')
        self.declare_settings('', IdentificationSettings())
        self.declare_text('apply_to', list(NODES), 'nodes in which ~/apply sets parameters')
        self._bags: list[str] = []
        self._found: Sequence[Statistic] = ()
        self._words = ''
        self._live: LiveRecording | None = None
        #: Warnings or error of the live identification, and time of the next one [s].
        self._doubts, self._next = '', 0.0
        self._setters: dict[str, Client] = {}
        self._calls = Calls(self)

    # Transitions.

    def configure(self) -> None:
        """Read the recordings, axes and settings of identification."""
        self.text('what', WHAT)
        self._by_header = self.text('time', TIMES) == 'header'
        self.settings('friction.', FrictionSettings)
        self.settings('stiffness.', StiffnessSettings)
        self.settings('', IdentificationSettings)
        self._is_live = bool(self.get_parameter('live').value)
        if self._is_live:
            # The first identification imports these: not while samples arrive.
            import_module('scipy.interpolate')
            import_module('scipy.stats')
        force, unit = scaled_axis(self.text('force_axis'), 'force')
        sign, axis = signed_axis(force, 'force_axis')
        #: Factor to SI with the sign, and name, of the axis of the force and of the joint.
        self._force_axis = sign * unit, axis
        motion, unit = scaled_axis(self.text('motion_axis') or contract.INSERTION, 'depth')
        sign, joint = signed(motion)
        self._joint = sign * unit, joint
        if len(axes := self.value('axes')) != 2:
            raise ParameterError(f'axes must be two, got {axes}')
        self._bags = [name for name in self.value('bags') if name]
        self._setters = {name: self._setter(name) for name in self.value('apply_to')}
        self._friction = self.publisher(contract.FRICTION, always=True)
        self._stiffness = self.publisher(contract.STIFFNESS, always=True)
        self.create_service(Trigger, '~/identify', self._on_identify)
        answer_later(self.create_service(Trigger, '~/apply', self._on_apply))

    def _setter(self, name: str) -> Client:
        try:
            return self.create_client(SetParameters, f'{name}/set_parameters')
        except InvalidServiceNameException as error:
            raise ParameterError(f'apply_to must have names of nodes, got {name!r}') from error

    def cleanup(self) -> None:
        self._calls.abandon()
        self._setters.clear()

    def activate(self) -> None:
        """Identify from the recordings if any are named; with ``live``, subscribe."""
        if self._bags:
            self._identify()
        if self._is_live:
            self._doubts = ''
            self._live = LiveRecording(self.settings('', IdentificationSettings).window)
            self._queues = (
                self.queue(contract.JOINT_STATES, self._on_motion, _ALL),
                self.queue(contract.BASE_WRENCH, self._on_force, _ALL),
            )
            self._taking = steady_timer(self, _TAKE_PERIOD, self._take)
            self._timer = self.create_timer(1.0, self._identify_live)

    def about(self) -> str:
        topics = f'{contract.JOINT_STATES.name} and {contract.BASE_WRENCH.name}'
        live = f', and live from {topics}' if self._is_live else ''
        return f'{self.text("what")} from {len(self._bags)} recordings at ~/identify{live}'

    def deactivate(self) -> None:
        if self._is_live:
            self.destroy_timer(self._timer)
            self.destroy_timer(self._taking)
            for subscription, _ in self._queues:
                subscription.destroy()

    def change(self, changes: Mapping[str, Any]) -> None:
        self._bags = [name for name in changes['bags'] if name]

    def diagnose(self) -> Diagnosis[IdentificationStatus]:
        status = IdentificationStatus()
        if self._live is not None:
            samples, discarded = self._live.samples, dict(self._live.dropped)
            status = IdentificationStatus(samples=samples, discarded=discarded)
            if not samples:
                message = f'no joint_states of {self._joint[1]} paired with base_wrench'
                return Diagnosis(Severity.WARNING, message, status)
            words = (_sentence(self._found), self._doubts, *self._live.losses)
            message = '; '.join(filter(None, words))
            severity = Severity.WARNING if self._doubts else Severity.INFO
            return Diagnosis(severity, message, status)
        message = self._words if self._found else 'nothing identified yet'
        return Diagnosis(Severity.INFO, message, status)

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
        """Identify from all recordings, publish the result and write it to ``output``."""
        reading: dict[str, Any] = {
            'wrench_topic': self.text('wrench_topic') or None,
            'motion_topic': self.text('motion_topic') or None,
            'time': self.text('time'),
        }
        summary: FrictionSummary | StiffnessSummary
        found: Sequence[Statistic]
        if self.text('what') == 'friction':
            reading['force_axis'] = self.text('force_axis')
            reading['motion_axis'] = self.text('motion_axis') or None
            read: Callable[[str], Any] = partial(read_friction_recording, **reading)
            terms = self.settings('friction.', FrictionSettings)
            identify = partial(identify_friction, settings=terms, among=len(self._bags))
            summary = friction = summarize(self._estimates(read, identify))
            found, publisher = friction.statistics, self._friction
            write = partial(write_result, friction=friction)
        else:
            reading['axes'] = tuple(self.value('axes'))
            read = partial(read_indentation_recording, **reading)
            settings = self.settings('stiffness.', StiffnessSettings)
            summary = stiffness = summarize_stiffness(
                self._estimates(read, partial(identify_stiffness, settings=settings)),
                force=self.settings('', IdentificationSettings).level or None,
                level_tolerance=settings.level_tolerance,
            )
            found, publisher = (stiffness.tissue_stiffness,), self._stiffness
            write = partial(write_result, friction=None, stiffness=stiffness)
        if output := self.text('output'):
            write(output)
        for words in summary.warnings:
            self.get_logger().warning(words)
        self._found = found
        self._publish(publisher, _summary_statuses(summary))
        self._words = f'{_sentence(found)} from {len(summary.estimates)} recordings'
        self.get_logger().info(self._words)

    def _estimates(self, read: Callable[[str], Any], identify: Callable[[Any], Any]) -> list[Any]:
        estimates = []
        digests: dict[bytes, str] = {}
        for bag in self._bags:
            recording = read(bag)
            if recording.digest in digests:
                same = digests[recording.digest]
                self.get_logger().warning(f'{bag}: the same samples as {same}: counts once')
                continue
            digests[recording.digest] = bag
            estimate = identify(recording)
            for words in (*recording.losses, *estimate.warnings):
                self.get_logger().warning(f'{bag}: {words}')
            estimates.append(estimate)
        return estimates

    def _publish(self, publisher: Publisher, statuses: Sequence[DiagnosticStatus]) -> None:
        message = DiagnosticArray(status=statuses)
        message.header.stamp = self.get_clock().now().to_msg()
        publisher.publish(message)

    # Running topics.

    def _take(self) -> None:
        for _, take_all in self._queues:
            take_all()

    def _on_motion(self, reading: Reading, received: int) -> None:
        factor, joint = self._joint
        found = reading.joint(joint)
        if self._live is not None and found is not None:
            position, velocity, _ = found
            stamp = reading.stamp if self._by_header else received
            self._live.take_motion(stamp, factor * position, factor * velocity, received)

    def _on_force(self, reading: Reading, received: int) -> None:
        if self._live is not None:
            factor, axis = self._force_axis
            force = factor * reading.values[0][AXES.index(axis)]
            stamp = reading.stamp if self._by_header else received
            self._live.take_force(stamp, force, received)

    def _identify_live(self) -> None:
        """Identify, and publish the result; at most a fifth of the time is spent here."""
        begin, doubts = monotonic(), self._doubts
        if self._live is None or not self._live.samples or begin < self._next:
            return
        try:
            self._live.check_current()
            recording = self._live.recording()
            estimate = identify_friction(recording, self.settings('friction.', FrictionSettings))
        except NeedleError as error:
            self._doubts = str(error)
        else:
            self._doubts = '; '.join(estimate.warnings)
            summary = summarize([estimate])
            self._found = summary.statistics
            self._publish(self._friction, _summary_statuses(summary, 'live'))
        if self._doubts != doubts:
            self.report_change()
        self._next = begin + _REST * (monotonic() - begin)

    # Parameters of running nodes.

    def _on_apply(
        self, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response | Future:
        """Set the last result in other nodes; respond after all of them have responded."""
        values, beyond = model_parameters(self._found), limited(self._found)
        if not values:
            response.message = 'nothing identified yet that plant and controller can use'
            return response
        parameters = [Parameter(name, value=one) for name, one in values.items()]
        request = SetParameters.Request(parameters=[one.to_parameter_msg() for one in parameters])
        answers = {
            name: self._calls.call(client, request) if client.service_is_ready() else None
            for name, client in self._setters.items()
        }
        later = Future()

        def answer_all(_answer: Future | None = None) -> None:
            """Respond when all calls are answered or have failed."""
            if later.done() or not all(one is None or one.done() for one in answers.values()):
                return
            outcomes = [_outcome(name, values, answer) for name, answer in answers.items()]
            verdicts = [verdict for verdict, _ in outcomes if verdict is not None]
            response.success = bool(verdicts) and all(verdicts)
            response.message = '; '.join([*(words for _, words in outcomes), *beyond])
            later.set_result(response)
            # Two statements: rclpy rejects a second severity from the same source line.
            if response.success:
                self.get_logger().info(response.message)
            else:
                self.get_logger().error(response.message)

        for answer in filter(None, answers.values()):
            answer.add_done_callback(answer_all)
        answer_all()
        return later


def _summary_statuses(
    summary: FrictionSummary | StiffnessSummary, source: str = 'recordings'
) -> list[DiagnosticStatus]:
    """Return one status per parameter and force level, then one per recording."""
    if isinstance(summary, FrictionSummary):
        samples = sum(one.samples for one in summary.estimates)
        statuses = [
            _of_statistic(one, samples=samples, source=source) for one in summary.statistics
        ]
        return [*statuses, *(_of_friction(one, source) for one in summary.estimates)]
    statuses = [_of_statistic(summary.tissue_stiffness)]
    for level in summary.levels:
        at = f' at {level.force:.2f} N'
        statuses += [_of_statistic(one, level=at) for one in level.statistics]
    return [*statuses, *map(_of_stiffness, summary.estimates)]


def _of_statistic(
    one: Statistic, *, level: str = '', samples: int | None = None, source: str = 'recordings'
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
    message = measured(one.mean, one.error, one.unit)
    status = _status(f'{one.name}{level}', message, values, source)
    status.level = DiagnosticStatus.OK if one.count else DiagnosticStatus.WARN
    return status


def _of_friction(estimate: FrictionEstimate, source: str) -> DiagnosticStatus:
    parameters = (*estimate.parameters, estimate.breakaway, estimate.lag)
    values = {
        **{p.name: measured(p.value, p.error, p.unit) for p in parameters if p is not None},
        'samples': estimate.samples,
        'residual': estimate.residual,
        'determination': estimate.determination,
        'condition': estimate.condition,
        'warnings': '; '.join(estimate.warnings) or None,
    }
    return _status(estimate.name, f'R^2 = {estimate.determination:.4f}', values, source)


def _of_stiffness(estimate: StiffnessEstimate) -> DiagnosticStatus:
    worst = min(level.determination for level in estimate.levels)
    values = {
        'presses': sum(level.presses for level in estimate.levels),
        'determination': worst,
        'condition': max(level.condition for level in estimate.levels),
        'off_plane': estimate.off_plane,
        **{f'at {level.force:.2f} N': level.words for level in estimate.levels},
    }
    return _status(estimate.name, f'R^2 >= {worst:.4f}', values)


def _status(
    name: str, message: str, values: Mapping[str, object], source: str = ''
) -> DiagnosticStatus:
    pairs = [KeyValue(key=k, value=str(v)) for k, v in values.items() if v is not None]
    return DiagnosticStatus(name=name, message=message, hardware_id=source, values=pairs)


def _sentence(found: Sequence[Statistic]) -> str:
    """Format parameters in one line, such as ``mu_s = 0.5600 ± 0.0083 N, mu_v = ...``."""
    return ', '.join(f'{one.symbol} = {measured(one.mean, one.error, one.unit)}' for one in found)


if __name__ == '__main__':
    sys.exit(run(IdentificationNode))
