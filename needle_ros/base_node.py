"""
What every node of this suite shares: lifecycle, parameters from dataclasses, diagnostics.

A node's parameters are the fields of frozen dataclasses; `constant` gives each its unit,
meaning and range, and the dataclass refuses what is not valid when it is made, so that a bad
parameter file ends in a refused `configure` with one line that names the parameter.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable, Mapping
import ctypes
from dataclasses import fields
import gc
import os
import signal
import sys
import time
import traceback
from types import FrameType
from typing import Any, ClassVar, TypeVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import WrenchStamped
from needle_ros.errors import (
    NeedleError,
    ParameterError,
)
from needle_ros.packed import Layout, Reading
from needle_ros.settings import from_values, unknown_name
from needle_ros.timing import nanoseconds
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
import rclpy
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_msgs.msg import String
import yaml

#: Latched topics: the last message reaches who comes late.
LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

#: Commands: only the newest counts, and it must arrive.
COMMAND = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)

#: Sensor streams; a burst after a stall of the reader is not lost.
SENSOR = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)

#: Set in the environment of a node that shall not outlive the process that started it.
END_WITH_PARENT = 'NEEDLE_END_WITH_PARENT'

_PR_SET_PDEATHSIG = 1

_Settings = TypeVar('_Settings')
_SUCCESS = TransitionCallbackReturn.SUCCESS


def reading_of(message: Any) -> Reading:
    """Return what a joint state, wrench or point with a header says."""
    header = message.header
    stamp, names = nanoseconds(header.stamp), ()
    values: tuple[tuple[float, ...], ...]
    if isinstance(message, JointState):
        names = tuple(message.name)
        values = tuple(message.position), tuple(message.velocity), tuple(message.effort)
    elif isinstance(message, WrenchStamped):
        force, torque = message.wrench.force, message.wrench.torque
        values = ((force.x, force.y, force.z, torque.x, torque.y, torque.z),)
    else:
        values = ((message.point.x, message.point.y, message.point.z),)
    return Reading(stamp, header.frame_id, names, values)


def layout_of(kind: type, reading: Reading) -> Layout:
    """Return the layout of the message of a type that says this."""
    counts = [len(block) for block in reading.values]
    if kind is JointState:
        return Layout(reading.frame, names=reading.names, counts=counts)
    return Layout(reading.frame, numbers=counts[0])


class BaseNode(LifecycleNode):
    """
    A lifecycle node that reads its parameters into dataclasses and says how it is.

    A subclass declares its parameters in ``__init__`` (`declare_settings`), overrides
    `configure`, `activate`, `deactivate` and `diagnose`, and raises `NeedleError` for whatever
    makes a transition impossible: the transition is then refused and the reason logged.
    Parameters that it names in `LIVE` may change while it is configured: `change` is then called.
    """

    #: Names of the parameters that may change while the node is configured.
    LIVE: ClassVar[frozenset[str]] = frozenset()

    def __init__(self, name: str, **node_options: Any) -> None:
        super().__init__(name, **node_options)
        self.failure: str | None = None
        #: Messages that were none, by topic.
        self.unreadable: Counter[str] = Counter()
        self._descriptions: dict[str, Mapping[str, Any]] = {}
        self._configured = False
        self.declare_text('autostart', True, 'configure and activate at start')
        self._configuration = self.create_publisher(String, '~/configuration', LATCHED)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._last_level = DiagnosticStatus.OK
        # Not the node's clock: a simulation that stands still must be told of too.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._health_timer = self.create_timer(1.0, self.publish_diagnostics, clock=steady)
        self.add_on_set_parameters_callback(self._check_change)
        self.add_post_set_parameters_callback(self._after_change)

    # What a subclass fills in.

    def cleanup(self) -> None:
        """Undo `configure`, as far as it came."""

    def configure(self) -> None:
        """Read the parameters and make what the node needs; raise `NeedleError` to refuse."""

    def activate(self) -> None:
        """Begin to act; raise `NeedleError` to refuse."""

    def deactivate(self) -> None:
        """Stop acting and leave the world safe."""

    def change(self, changes: Mapping[str, Any]) -> None:
        """Go on with other values of parameters in `LIVE`; raise `NeedleError` to refuse them."""

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Return level, message and values for /diagnostics."""
        return DiagnosticStatus.OK, 'active' if self.is_active else 'not active', {}

    # Messages.

    def now(self) -> int:
        """Return the time of the node's clock [ns]."""
        # Without the objects that Clock.now makes, which take longer than to look.
        return int(self.get_clock().handle.get_now().nanoseconds)

    def listen(
        self, kind: type, topic: str, qos: QoSProfile, take: Callable[[Reading], None]
    ) -> Subscription:
        """
        Subscribe to joint states, wrenches or points that come at the sample rate.

        Parameters
        ----------
        kind : type
            JointState, WrenchStamped or PointStamped.
        topic : str
            Topic.
        qos : QoSProfile
            Quality of service.
        take : callable
            Called with each `Reading`.

        """
        layout: Layout | None = None

        def on_bytes(data: bytes) -> None:
            nonlocal layout
            reading = layout.deserialize(data) if layout is not None else None
            if reading is None:
                try:
                    reading = reading_of(deserialize_message(data, kind))
                except RuntimeError as error:
                    self.unreadable[topic] += 1
                    reason = ' '.join(str(error).split())
                    self.get_logger().error(
                        f'{topic} cannot be read: {reason}', throttle_duration_sec=1.0
                    )
                    return
                layout = layout_of(kind, reading)
            take(reading)

        return self.create_subscription(kind, topic, on_bytes, qos, raw=True)

    # Parameters.

    def declare_text(self, name: str, default: str | bool | list[str], description: str) -> None:
        """Declare a parameter that is not a number."""
        self.declare_parameter(name, default, ParameterDescriptor(description=description))

    def declare_settings(self, prefix: str, defaults: object) -> None:
        """
        Declare one parameter per field of a dataclass.

        Parameters
        ----------
        prefix : str
            Namespace of the parameters, ``''`` for none.
        defaults : object
            Instance of the dataclass that holds the default values.

        """
        for item in fields(defaults):  # type: ignore[arg-type]
            meta = item.metadata
            unit = f' [{meta["unit"]}]' if meta.get('unit') else ''
            descriptor = ParameterDescriptor(
                description=f'{meta.get("description", item.name)}{unit}',
                # An integer is accepted where a float is meant; the dataclass checks the rest.
                dynamic_typing=True,
            )
            if 'low' in meta:
                descriptor.floating_point_range = [
                    FloatingPointRange(from_value=meta['low'], to_value=meta['high'])
                ]
            default = getattr(defaults, item.name)
            if isinstance(default, tuple):
                default = list(default)
            self.declare_parameter(f'{prefix}{item.name}', default, descriptor)

    def settings(
        self,
        prefix: str,
        kind: Callable[..., _Settings],
        changes: Mapping[str, Any] | None = None,
    ) -> _Settings:
        """
        Read the parameters that `declare_settings` declared into the dataclass.

        Parameters
        ----------
        prefix : str
            Namespace of the parameters.
        kind : type
            The dataclass.
        changes : Mapping[str, Any], optional
            Values to take instead, by the names of the parameters.

        Raises
        ------
        ParameterError
            Naming the parameter with its prefix.

        """
        values = {
            item.name: (changes or {}).get(f'{prefix}{item.name}', self._value(prefix + item.name))
            for item in fields(kind)  # type: ignore[arg-type]
        }
        return from_values(kind, values, prefix)

    def _value(self, name: str) -> Any:
        return self.get_parameter(name).value

    def text(
        self,
        name: str,
        valid: tuple[str, ...] = (),
        changes: Mapping[str, Any] | None = None,
    ) -> str:
        """
        Read a text parameter, one of ``valid`` if that is given; ``changes`` as in `settings`.

        Raises
        ------
        ParameterError
            Naming the parameter, what was found and what would be valid.

        """
        value = (changes or {}).get(name, self.get_parameter(name).value)
        if not isinstance(value, str) or (valid and value not in valid):
            raise ParameterError(f'{name} must be one of {", ".join(valid)}, got {value!r}')
        return value

    def configuration(self) -> str:
        """Return all parameters as a ROS parameter file."""
        values = {}
        for name, parameter in sorted(self._parameters.items()):
            value = parameter.value
            if isinstance(value, (list, tuple, array)):
                value = list(value)
            # A parameter file cannot hold an empty list: where one is valid it is the default.
            if not name.startswith(('qos_overrides', 'start_type')) and value not in ([], None):
                values[name] = value
        document = {self.get_fully_qualified_name(): {'ros__parameters': values}}
        return str(yaml.safe_dump(document, sort_keys=False))

    def _check_overrides(self) -> None:
        known = sorted(self._parameters)
        unknown = sorted(set(self._parameter_overrides) - set(known))
        if unknown:
            count = len(self._parameter_overrides)
            complaints = '; '.join(unknown_name(name, known) for name in unknown)
            raise ParameterError(
                f'{count - len(unknown)} of {count} parameters given are known: {complaints}'
            )

    def _check_change(self, parameters: list[Parameter]) -> SetParametersResult:
        if not self._configured:
            return SetParametersResult(successful=True)
        fixed = [parameter.name for parameter in parameters if parameter.name not in self.LIVE]
        if fixed:
            return SetParametersResult(
                successful=False,
                reason=f'{", ".join(fixed)}: cannot change while configured; clean up the node '
                'first',
            )
        try:
            self.change({parameter.name: parameter.value for parameter in parameters})
        except NeedleError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _after_change(self, _parameters: list[Parameter]) -> None:
        if self._configured:
            self._configuration.publish(String(data=self.configuration()))

    # Lifecycle.

    @property
    def is_active(self) -> bool:
        """True while the node acts."""
        return bool(self._state_machine.current_state[1] == 'active')

    def start(self) -> bool:
        """Configure and activate; return whether that went well."""
        return bool(self.trigger_configure() == _SUCCESS and self.trigger_activate() == _SUCCESS)

    def stop(self) -> None:
        """Deactivate if active."""
        if self.is_active:
            self.trigger_deactivate()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters; refuse what is not valid with one line that names it."""

        def configure() -> None:
            self._check_overrides()
            try:
                self.configure()
            except NeedleError:
                self.cleanup()
                raise
            self._configured = True
            if self._parameter_overrides:
                count = len(self._parameter_overrides)
                self.get_logger().info(f'{count} of {count} parameters given applied')
            self._configuration.publish(String(data=self.configuration()))

        return self._attempt(configure, super().on_configure, state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to act."""
        return self._attempt(self.activate, super().on_activate, state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop acting."""
        return self._attempt(self.deactivate, super().on_deactivate, state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Make the parameters free to change."""
        self._configured = False
        return self._attempt(self.cleanup, super().on_cleanup, state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Leave the world safe."""

        def leave() -> None:
            if state.label == 'active':
                self.deactivate()

        return self._attempt(leave, super().on_shutdown, state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Return to unconfigured after an error that was not foreseen."""
        self._configured = False
        self.cleanup()
        return super().on_error(state)

    def _attempt(
        self,
        action: Callable[[], None],
        inherited: Callable[[LifecycleState], TransitionCallbackReturn],
        state: LifecycleState,
    ) -> TransitionCallbackReturn:
        try:
            action()
        except NeedleError as error:
            self.failure = str(error)
            self.get_logger().error(self.failure)
            return TransitionCallbackReturn.FAILURE
        # rclpy would drop it without a word.
        except Exception as error:  # noqa: BLE001
            self.failure = f'{type(error).__name__}: {error}'
            self.get_logger().error(traceback.format_exc())
            return TransitionCallbackReturn.ERROR
        self.failure = None
        return inherited(state)

    # Diagnostics.

    def publish_diagnostics(self) -> None:
        """Publish the state of the node; called once a second and on change."""
        level, message, values = self.diagnose()
        if self.failure:
            level, message = DiagnosticStatus.ERROR, self.failure
        self._last_level = level
        for topic, count in self.unreadable.items():
            values[f'messages of {topic} that cannot be read'] = count
        status = DiagnosticStatus(
            level=level,
            name=self.get_fully_qualified_name(),
            message=message,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def report_change(self) -> None:
        """Publish diagnostics now if the level has changed."""
        if self.diagnose()[0] != self._last_level:
            self.publish_diagnostics()


def run(kind: Callable[[], BaseNode], arguments: list[str] | None = None) -> int:
    """
    Run one node until SIGINT or SIGTERM, then deactivate it while the graph still lives.

    Parameters
    ----------
    kind : callable
        Makes the node.
    arguments : list of str, optional
        Command line with ROS arguments; ``sys.argv`` if not given.

    Returns
    -------
    int
        Exit status: 0, or 2 if the node refused to start.

    """
    stopping = False

    def stop(_signal: int, _frame: FrameType | None) -> None:
        nonlocal stopping
        stopping = True

    if os.environ.get(END_WITH_PARENT):
        # Linux sends the signal when the process that started this one ends, however it ends.
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    try:
        # Not rclpy's handlers: they end the context before the node can leave the world safe.
        rclpy.init(args=arguments, signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    except RuntimeError as error:
        # rcl could not read the arguments or the parameter file.
        sys.stderr.write(f'error: {" ".join(str(error).split())}\n')
        return 2
    previous = {name: signal.signal(name, stop) for name in (signal.SIGINT, signal.SIGTERM)}
    try:
        try:
            node = kind()
        except (ParameterException, NeedleError, RuntimeError) as error:
            # The last is rcl's: a node that its security refuses.
            sys.stderr.write(f'error: {" ".join(str(error).split())}\n')
            return 2
        executor: Executor = EventsExecutor()
        executor.add_node(node)
        status = 0
        if node.get_parameter('autostart').value and not node.start():
            # Give the reason on /diagnostics a moment to leave, then end.
            node.publish_diagnostics()
            status = 2
        # A look through all that was imported takes 0.2 s, and would come some time later.
        gc.freeze()
        while not stopping and status == 0:
            # Unlike spin_once it does not come back to Python at each event.
            executor.spin_until_future_complete(Future(), timeout_sec=0.1)
        node.stop()
        # What was published last (a zero force, a latched result) is still on its way.
        deadline = time.monotonic() + 0.1
        while time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.02)
        executor.shutdown()
        node.destroy_node()
        return status
    finally:
        rclpy.utilities.try_shutdown()
        for name, handler in previous.items():
            signal.signal(name, handler)
