# SPDX-License-Identifier: Apache-2.0
"""Base class of all nodes: life cycle, contract topics, diagnostics."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from importlib import import_module
from time import time_ns
import traceback
from typing import Any, ClassVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from needle_ros import contract
from needle_ros.contract import Qos, Topic
from needle_ros.errors import MessageError, NeedleError, printable
from needle_ros.event_log import EventLog, Severity
from needle_ros.life_cycle_node import imports, LifeCycle, Preparation, PreparationProgress
from needle_ros.parameter_node import ParameterNode
from needle_ros.process import HIGHEST, set_priority
from needle_ros.status import Diagnosis, HARDWARE, NodeStatus, STALE, TASK
from needle_ros.wire import MessageReader, Reading
from rcl_interfaces.msg import IntegerRange, ParameterDescriptor
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from std_msgs.msg import String


def profile(qos: Qos, *, request: bool = False) -> QoSProfile:
    """Convert a contract QoS to rclpy; `request` selects the profile of a subscription."""
    lossy, latched = request and qos.lossy, qos.latched
    lease = {'liveliness_lease_duration': Duration(seconds=qos.lease)} if qos.lease else {}
    return QoSProfile(
        depth=qos.depth,
        reliability=ReliabilityPolicy.BEST_EFFORT if lossy else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        liveliness=LivelinessPolicy.AUTOMATIC,
        **lease,
    )


def key_values(values: Mapping[str, str]) -> list[KeyValue]:
    """Convert values to those of a DiagnosticStatus."""
    return [KeyValue(key=key, value=value) for key, value in values.items()]


def steady_timer(node: Node, period: float, act: Callable[[], object]) -> Timer:
    """Create a timer [s] that also runs while the ROS clock is stopped, or jumps."""
    return node.create_timer(period, act, clock=Clock(clock_type=ClockType.STEADY_TIME))


def messages_of(
    subscription: Subscription, kind: Any, most: int
) -> Iterator[tuple[bytes, dict[str, Any]]]:
    """Take the received messages of a raw subscription, with their receive time and number."""
    handle: Any = subscription.handle
    with handle:
        for _ in range(most):
            taken = handle.take_message(kind, True)
            if taken is None:
                break
            yield taken


def _nothing(*_: object) -> None:
    pass


def message_class(*type_names: str, kind: str = 'msg') -> Any:
    """Import the class of the only type of a topic, such as ``sensor_msgs/msg/JointState``."""
    # rosidl_runtime_py has the same function, but is not in the wheels.
    if len(type_names) != 1:
        raise MessageError(f'topic has several types: {", ".join(type_names)}')
    package, _, name = type_names[0].partition(f'/{kind}/')
    try:
        return getattr(import_module(f'{package}.{kind}'), name)
    except (ImportError, AttributeError, TypeError) as error:
        raise MessageError(f'{type_names[0]} is not installed') from error


#: QoS profiles of the subscriptions of the suite.
LATCHED, COMMAND, SENSOR, NEWEST = (
    profile(qos, request=True)
    for qos in (contract.LATCHED, contract.COMMAND, contract.SENSOR, contract.NEWEST)
)

_SUCCESS = TransitionCallbackReturn.SUCCESS

_PRIORITY = 'realtime_priority'  #: Parameter with the real-time priority.
_LONG = 2.0  #: Period of log lines about a running preparation [s].


class BaseNode(ParameterNode):
    """
    Lifecycle node with parameters from dataclasses and diagnostics.

    A subclass declares its parameters in ``__init__`` (`declare_settings`), overrides the hooks,
    and raises `NeedleError` in them to refuse a transition. Publishers, subscriptions, services,
    clients and timers of `configure` or later are destroyed with the configuration.
    """

    IMPORTS: ClassVar[tuple[str, ...]] = ()  #: Modules with a slow import, before `configure`.

    def __init__(self, name: str, **node_options: Any) -> None:
        super().__init__(name, **node_options)
        self._get_now = self.get_clock().handle.get_now
        self.failure: str | None = None  #: Reason of the last refused transition.
        #: Whether the node failed at its task: its process ends with status 1.
        self.failed = False
        self.invalid: Counter[str] = Counter()  #: Number of invalid messages by topic.
        self._preparation = Preparation(self.preparation())
        self._life_cycle = LifeCycle(self, self._preparation, self._is_valid)
        self._lasting: set[Any] | None = None  #: `_entities` before the configuration, if any.
        self.declare_text('autostart', True, 'configure and activate at start')
        self.declare_parameter(
            _PRIORITY,
            0,
            ParameterDescriptor(
                description='priority of the process under the Linux policy SCHED_FIFO while the '
                'node is active; 0: no real-time scheduling',
                integer_range=[IntegerRange(from_value=0, to_value=HIGHEST)],
            ),
        )
        self._configuration = self.publisher(contract.CONFIGURATION, always=True)
        self._diagnostics = self.publisher(contract.DIAGNOSTICS, always=True)
        self._last_severity = Severity.INFO
        steady_timer(self, 1.0, self.publish_diagnostics)
        self.add_post_set_parameters_callback(self._after_change)

    # Hooks of subclasses.

    def preparation(self) -> Iterable[PreparationProgress]:
        """Return the slow steps before `configure`, such as imports; a thread runs them."""
        return imports(self.IMPORTS)

    def cleanup(self) -> None:
        """Discard the objects of `configure`, also after an error halfway."""

    def configure(self) -> None:
        """Read the parameters and create the publishers and subscriptions of the node."""

    def activate(self) -> None:
        """Start the periodic work of the node."""

    def about(self) -> str:
        """Return the log line of the activation: configuration and main topics; may be empty."""
        return ''

    def deactivate(self) -> None:
        """Stop the periodic work, and command zero force."""

    def diagnose(self) -> Diagnosis[NodeStatus]:
        """Return severity, one-line message and typed status."""
        return Diagnosis(Severity.INFO, self.state, NodeStatus())

    @property
    def state(self) -> str:
        """Message of a node without faults."""
        return 'active' if self.is_active else 'not active'

    # Messages.

    def now(self) -> int:
        """Return the time of the node clock [ns]."""
        # Clock.now creates objects and takes three times as long.
        return int(self._get_now().nanoseconds)

    def publisher(self, topic: Topic, *, always: bool = False) -> Publisher:
        """Create a publisher of a contract topic, limited to the active state unless `always`."""
        create = self.create_publisher if always else self.create_lifecycle_publisher
        offered: Publisher = create(message_class(topic.type_name), topic.name, profile(topic.qos))
        return offered

    def writer(self, topic: Topic) -> Callable[[bytes], None]:
        """Create a publisher of serialized messages, limited to the active state."""
        offered: Any = self.publisher(topic)
        # Publisher.publish checks the type and the life of each message in Python.
        publish = offered.handle.publish_raw
        return lambda data: publish(data) if offered.is_activated else None

    def subscribe(self, topic: Topic, take: Callable[[Any], None]) -> Subscription:
        kind = message_class(topic.type_name)
        return self.create_subscription(kind, topic.name, take, profile(topic.qos, request=True))

    def listen(
        self,
        topic: Topic,
        take: Callable[[Reading], None],
        matched: Callable[[int], None] | None = None,
        qos: QoSProfile | None = None,
    ) -> Subscription:
        """
        Subscribe to a topic by bytes; `matched` receives the number of new publishers, or 0.

        ``qos`` is the requested QoS, by default that of the topic.
        """
        taken = self._parsed(topic, lambda reading, _: take(reading))

        def on_match(event: Any) -> None:
            if matched is not None:
                matched(event.total_count_change)

        def on_bytes(data: bytes) -> None:
            taken(data, 0)

        events = SubscriptionEventCallbacks(matched=on_match)
        return self.create_subscription(
            message_class(topic.type_name),
            topic.name,
            on_bytes,
            qos or profile(topic.qos, request=True),
            raw=True,
            event_callbacks=events,
        )

    def queue(
        self, topic: Topic, take: Callable[[Reading, int], None], qos: QoSProfile
    ) -> tuple[Subscription, Callable[[], None]]:
        """
        Subscribe, with a function that takes all messages, each with its receive time [ns].

        The receive time is that of the middleware, however late the message is taken.
        """
        kind, taken = message_class(topic.type_name), self._parsed(topic, take)
        # Events of a subscription that is destroyed in a callback would end the executor.
        events = SubscriptionEventCallbacks(use_default_callbacks=False)
        subscription = self.create_subscription(
            kind, topic.name, _nothing, qos, raw=True, event_callbacks=events
        )
        self.take_over(subscription)

        def take_all() -> None:
            for data, about in messages_of(subscription, kind, qos.depth):
                taken(data, about['received_timestamp'] or time_ns())

        return subscription, take_all

    def take_over(self, subscription: Subscription) -> None:
        """Keep the executor from taking messages: it would do so without their receive time."""
        self._subscriptions.remove(subscription)

    def _parsed(
        self, topic: Topic, take: Callable[[Reading, int], None]
    ) -> Callable[[bytes, int], None]:
        """Return a function that parses a message, or counts and reports an invalid one."""
        name, read = topic.name, MessageReader(topic.type_name).read

        def taken(data: bytes, received: int) -> None:
            try:
                reading = read(data)
            except MessageError as error:
                self.invalid[name] += 1
                self.get_logger().error(
                    f'invalid message on {name}: message {error}', throttle_duration_sec=1.0
                )
                return
            take(reading, received)

        return taken

    def destroy_timer(self, timer: Timer) -> bool:
        # EventsExecutor can call a destroyed timer once more.
        timer.callback = _nothing
        return bool(super().destroy_timer(timer))

    def _after_change(self, _parameters: list[Parameter]) -> None:
        if self._configured and self._changed:
            self._configuration.publish(String(data=self.configuration()))

    # Lifecycle: rclpy calls the methods `on_...`.

    @property
    def is_active(self) -> bool:
        return bool(self._state_machine.current_state[1] == 'active')

    def begin(self, refused: Callable[[], object]) -> None:
        """Prepare, configure and activate in a spinning executor; `refused` handles a failure."""
        self._life_cycle.when_prepared(lambda: self.start() or refused())

    @property
    def is_preparing(self) -> bool:
        return self._preparation.is_running

    def start(self) -> bool:
        """Configure and activate synchronously; return whether both transitions succeeded."""
        return bool(self.trigger_configure() == _SUCCESS and self.trigger_activate() == _SUCCESS)

    def stop(self) -> None:
        if self.is_active:
            self.trigger_deactivate()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:

        def configure() -> None:
            self._check_overrides()
            self._preparation.complete()
            self._lasting = self._entities()
            try:
                self.configure()
            except NeedleError:
                self._clean_up()
                raise
            self._configured = True
            if self._parameter_overrides:
                count = len(self._parameter_overrides)
                self.get_logger().info(f'{count} of {count} given parameters applied')
            self._configuration.publish(String(data=self.configuration()))

        return self._attempt(configure, super().on_configure, state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:

        def activate() -> None:
            # Threads of new timers inherit the priority.
            self._schedule(realtime=True)
            self.activate()

        done = self._attempt(activate, super().on_activate, state)
        if done == _SUCCESS:
            self.get_logger().info(': '.join(filter(None, ('active', self.about()))))
        elif done == TransitionCallbackReturn.FAILURE:
            self._schedule(realtime=False)
        return done

    def _schedule(self, *, realtime: bool) -> None:
        if priority := self.get_parameter(_PRIORITY).value:
            set_priority(priority if realtime else 0)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._attempt(self._deactivate, super().on_deactivate, state)

    def _deactivate(self) -> None:
        self.deactivate()
        self._schedule(realtime=False)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._configured = False
        return self._attempt(self._clean_up, super().on_cleanup, state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:

        def leave() -> None:
            if state.label == 'active':
                self._deactivate()
            self._clean_up()

        return self._attempt(leave, super().on_shutdown, state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._configured = False
        self._clean_up()
        self._schedule(realtime=False)
        return super().on_error(state)

    def _entities(self) -> set[Any]:
        return {*self.publishers, *self.subscriptions, *self.services, *self.clients, *self.timers}

    def _clean_up(self) -> None:
        """Call `cleanup`, and destroy all that was created since the node was unconfigured."""
        self.cleanup()
        lasting, self._lasting = self._lasting, None
        if lasting is None:
            return
        for found, destroy in (
            (self.publishers, self.destroy_lifecycle_publisher),
            (self.subscriptions, self.destroy_subscription),
            (self.services, self.destroy_service),
            (self.clients, self.destroy_client),
            (self.timers, self.destroy_timer),
        ):
            for one in {*found} - lasting:
                destroy(one)

    def _attempt(
        self,
        action: Callable[[], None],
        inherited: Callable[[LifecycleState], TransitionCallbackReturn],
        state: LifecycleState,
    ) -> TransitionCallbackReturn:
        try:
            action()
        except NeedleError as error:
            self.failure = printable(str(error))
            self.get_logger().error(self.failure)
            return TransitionCallbackReturn.FAILURE
        # rclpy would ignore the error.
        except Exception as error:  # noqa: BLE001
            self.failure = f'{type(error).__name__}: {error}'
            self.get_logger().error(traceback.format_exc())
            return TransitionCallbackReturn.ERROR
        self.failure = None
        return inherited(state)

    # Diagnostics.

    def publish_diagnostics(self) -> None:
        """Publish the state of the node; called once a second and on change."""
        diagnosis = self.diagnose()
        severity, message = diagnosis.severity, diagnosis.message
        if self.is_preparing:
            message = str(self._preparation.progress)
            self.get_logger().info(message, throttle_duration_sec=_LONG, skip_first=True)
        if self.failure:
            severity, message = Severity.ERROR, self.failure
        self._last_severity = severity
        failure = self.failure or ''
        status = replace(diagnosis.status, invalid_messages=self.invalid, failure=failure)
        finalized = self._state_machine.current_state[1] == 'finalized'
        published = DiagnosticStatus(
            level=STALE if finalized else severity.level,
            name=f'{self.get_fully_qualified_name()}: {TASK}',
            message=message,
            hardware_id=self.get_namespace().strip('/') or HARDWARE,
            values=key_values(status.to_values()),
        )
        array = DiagnosticArray(status=[published])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def publish_events(self, events: EventLog) -> None:
        """Log the new lines of an event log (`EventLog`), and publish diagnostics on change."""
        if not events.changed:
            return
        log = self.get_logger()
        for severity, line in events.take():
            # rclpy allows only one severity per call site.
            if severity is Severity.ERROR:
                log.error(line)
            elif severity is Severity.WARNING:
                log.warning(line)
            else:
                log.info(line)
        self.publish_diagnostics()

    def report_change(self) -> None:
        """Publish diagnostics if the level has changed."""
        if self.diagnose().severity != self._last_severity:
            self.publish_diagnostics()
