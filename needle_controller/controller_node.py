# SPDX-License-Identifier: Apache-2.0
"""Node `controller`: compute needle forces from encoder measurements and a target."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from math import nan
import sys
from time import sleep
from typing import Any

from geometry_msgs.msg import PointStamped
from needle_controller.commissioning import CommissioningSettings
from needle_controller.controller import Controller, ControllerSettings
from needle_controller.force_command import ForceCommand
from needle_controller.gains import DEFAULT_GAINS, Gains, LAWS
from needle_controller.hardware import HardwareSettings
from needle_controller.hardware_node import await_topics, CONTRACT, Driver
from needle_controller.observer.settings import ObserverSettings
from needle_controller.reference.generator import REFERENCES
from needle_controller.reference.setpoint import ReferenceLimits
from needle_controller.safety.safety import SafetyLimits
from needle_controller.stability import Uncertainty
from needle_controller.supervisor import Supervisor
from needle_dynamics import NeedleParameters
from needle_dynamics.model_node import ModelNode
from needle_ros import contract
from needle_ros.base_node import NEWEST, steady_timer
from needle_ros.errors import NeedleError, ParameterError
from needle_ros.event_log import Severity
from needle_ros.life_cycle_node import PreparationProgress
from needle_ros.publishers_node import offer_lease, Publishers
from needle_ros.run_node import run
from needle_ros.settings import CheckedSettings, constant
from needle_ros.status import ControllerStatus, Diagnosis
from needle_ros.system_state import RETRACT_DEPTH
from needle_ros.system_state_node import SystemStateTopics
from needle_ros.timing import nanoseconds
from needle_ros.trajectories import FollowedJoint, JointPath, JointReference
from needle_ros.trajectory_action_node import TrajectoryAction
from needle_ros.wire import Reading
from trajectory_msgs.msg import JointTrajectory

_RETRACT = 'retract_depth'

#: Number of repetitions of the last command at deactivation, because the driver may have no
#: timeout, and time between them [s].
_AGAIN, _PAUSE = 5, 0.02

#: Time before an input that the driver does not publish is reported [s]; DDS announces a node
#: again after 3 s.
_PATIENCE = 5.0
_GUIDE = {joint.name for joint in contract.STEERING_JOINTS}  #: Joints that no axis law controls.
FEEDBACKS = ('observer', 'ground_truth', 'none')  #: Sources of the load of the bent needle.


@dataclass(frozen=True, slots=True, kw_only=True)
class _Withdrawal(CheckedSettings):
    retract_depth: float = constant(RETRACT_DEPTH, 'm', 'insertion depth of ~/retract')


class ControllerNode(ModelNode):
    """
    Answer each ``joint_states`` with a ``wrench_command`` (force.y [N], torque.x [N m]).

    ``target`` (point.y [m]) is the target insertion depth, ``joint_trajectory`` (joint
    `insertion`: positions, and velocities or none) a path to follow. With ``steered`` only paths
    are followed, and targets are executed by the node `steering`. The command is zero before the
    first target or path, while measurements are stale, jump or are not finite, and while another
    node publishes commands. It is also zero from ``~/stop`` of any node or a measurement beyond a
    limit until ``~/clear_stop``. It has the stamp of the measurement that it answers, otherwise
    the present time. ``~/pause`` brakes the reference and holds it, ``~/retract`` moves to
    ``retract_depth``: they hold for the whole system, see `needle_ros.system_state`.
    ``reference`` and ``tracking_error`` are the reference and its error.

    An observer estimates the load of the bent needle from ``tip_deflection`` and ``base_wrench``,
    if these are published. Both are checked against the limits in any case.

    The node passes messages to a `Supervisor`, which decides, and publishes its commands. Each
    target and trajectory is acknowledged in the status, see `needle_ros.requests`.
    """

    LIVE = frozenset(
        {
            'law',
            'model.coulomb_friction',
            'model.viscous_friction',
            _RETRACT,
            *(
                f'{law}.{axis}.{item.name}'
                for law, axes in DEFAULT_GAINS.items()
                for axis, gains in axes.items()
                for item in fields(gains)
            ),
        }
    )

    KERNELS = (
        'needle_controller.compiled.laws',
        'needle_controller.compiled.filter',
        'needle_controller.compiled.loop:ring',
        'needle_controller.compiled.quintic',
        'needle_dynamics.compiled.friction',
        'needle_dynamics.compiled.integrals',
        'needle_dynamics.compiled.normal_modes',
    )

    def __init__(self, **node_options: Any) -> None:
        super().__init__('controller', **node_options)
        self.declare_text('law', LAWS[0], valid=LAWS)
        self.declare_text('reference.kind', 'trapezoid', valid=REFERENCES)
        feedbacks = f'one of {", ".join(FEEDBACKS)} (ground_truth: simulation only)'
        self.declare_text('deflection_feedback', FEEDBACKS[0], feedbacks, FEEDBACKS)
        self.declare_text(
            'steered',
            False,
            'targets are executed by the node steering: only trajectories are followed',
        )
        self.declare_settings('', _Withdrawal())
        self.declare_settings('', ControllerSettings())
        self.declare_settings('reference.', ReferenceLimits())
        self.declare_settings('safety.', SafetyLimits())
        self.declare_settings('uncertainty.', Uncertainty())
        self.declare_settings('observer.', ObserverSettings())
        self.declare_settings('hardware.', HardwareSettings())
        self.declare_settings('hardware.commissioning.', CommissioningSettings())
        for law, axes in DEFAULT_GAINS.items():
            for axis, gains in axes.items():
                self.declare_settings(f'{law}.{axis}.', gains)
        self.declare_model()

        self._supervisor = supervisor = Supervisor()
        #: Adapter of a robot with its own topics.
        self._driver: Driver | None = None
        self._command: Callable[[Any], None] | None = None
        self._action: TrajectoryAction | None = None
        self._checks, self._missing = 0, dict[str, str]()
        self._write_wrench = contract.WRENCH_COMMAND.template().serialize
        self._write_aim = contract.REFERENCE.template().serialize
        self._system = SystemStateTopics(
            self,
            supervisor.authority,
            self._on_request,
            lambda: self._act(supervisor.obey(self.now())),
        )

    def preparation(self) -> Iterator[PreparationProgress]:
        """Load or compile functions, and find the topics of a robot."""
        yield from super().preparation()
        # `configure` raises the error of an invalid parameter.
        with suppress(NeedleError):
            yield from await_topics(self, self.settings('hardware.', HardwareSettings))

    def _connect(self) -> None:
        self._topics = topics = self._driver.topics if self._driver is not None else CONTRACT
        offer_lease(self, topics.commander)
        commanders = Publishers(self, topics.commander, self._check_inputs)
        measurers = Publishers(self, topics.measurer, self._check_inputs)
        #: Counters of the publishers of commands and measurements, by name in the contract.
        self._sources = {
            contract.WRENCH_COMMAND.name: (topics.command, commanders),
            contract.JOINT_STATES.name: (topics.state, measurers),
            contract.BASE_WRENCH.name: (topics.wrench, measurers),
            contract.TIP_DEFLECTION.name: (contract.TIP_DEFLECTION, measurers),
        }
        # The driver of a robot takes ROS messages.
        command, robot = topics.command, self._driver is not None
        self._command = self.publisher(command).publish if robot else self.writer(command)
        take_state = self._passing(self._supervisor.encoders, self._supervisor.finish)
        take_wrench = self._passing(self._supervisor.wrench)
        if self._driver is not None:
            self._driver.listen(take_state, take_wrench, self._check_inputs)
        else:
            self.listen(topics.state, take_state, self._check_inputs, NEWEST)
            self.listen(topics.wrench, take_wrench, self._check_inputs, NEWEST)
        take_tip = self._passing(self._supervisor.tip)
        self.listen(contract.TIP_DEFLECTION, take_tip, self._check_inputs, NEWEST)
        self._reference = self.writer(contract.REFERENCE)
        self._tracking_error = self.writer(contract.TRACKING_ERROR)
        self.subscribe(contract.TARGET, self._on_target)
        self.subscribe(contract.JOINT_TRAJECTORY, self._on_trajectory)
        self._action = TrajectoryAction(
            self,
            self._supervisor.requests,
            (contract.INSERTION,),
            self._follow,
            lambda _joints: self._supervisor.hold(),
            lambda _joints, reason: self._supervisor.discard(reason),
            self.now,
        )

    # Transitions.

    def configure(self) -> None:
        """Create the controller from the parameters; reject unstable gains."""
        hardware = self.settings('hardware.', HardwareSettings)
        self._driver = Driver(self, hardware) if hardware != HardwareSettings() else None
        feedback = self.text('deflection_feedback', FEEDBACKS)
        controller = Controller(
            self.model_parameters(),
            self.text('law', LAWS),
            gains=self._gains(),
            settings=self.settings('', ControllerSettings),
            reference=self.text('reference.kind', tuple(REFERENCES)),
            limits=self.settings('reference.', ReferenceLimits),
            uncertainty=self.settings('uncertainty.', Uncertainty),
        )
        self._supervisor.retract_depth = self._retract_depth({})
        self._supervisor.receive(targets=not self.get_parameter('steered').value)
        limits, observed = self.settings('safety.', SafetyLimits), None
        if feedback == 'observer':
            observed = self.settings('observer.', ObserverSettings)
        robot = None
        if self._driver is not None:
            facts = self.settings('hardware.commissioning.', CommissioningSettings)
            self._driver.configure(controller, facts, limits)
            robot = self._driver.robot
        simulated = bool(self.get_parameter('use_sim_time').value)
        self._supervisor.configure(controller, limits, observed, robot, simulated=simulated)
        self._connect()
        if feedback == 'ground_truth':
            self.listen(contract.GROUND_TRUTH, self._passing(self._supervisor.truth))

    def _gains(self, changes: Mapping[str, Any] | None = None) -> dict[str, dict[str, Gains]]:
        gains: dict[str, dict[str, Gains]] = {}
        for law, axes in DEFAULT_GAINS.items():
            kind: Any = type(axes['insertion'])
            gains[law] = {axis: self.settings(f'{law}.{axis}.', kind, changes) for axis in axes}
        return gains

    def _retract_depth(self, changes: Mapping[str, Any]) -> float:
        value = self.settings('', _Withdrawal, changes).retract_depth
        low, high = self.settings('', ControllerSettings).depths(self.model_parameters())
        if _RETRACT not in changes and value == RETRACT_DEPTH:
            # The default is limited to the range of the needle.
            return min(max(RETRACT_DEPTH, low), high)
        if not low <= value <= high:
            raise ParameterError(f'{_RETRACT} must be in [{low:g}, {high:g}] m, got {value!r}')
        return value

    def check_before(self, changes: Mapping[str, Any]) -> Callable[[], object] | None:
        """Check the stability in a thread: unstable gains take up to seconds."""
        controller = self._supervisor.controller
        if controller is None:
            return None
        parameters, law, gains = self._wanted(changes)
        return lambda: controller.check_change(parameters, law=law, gains=gains)

    def _wanted(
        self, changes: Mapping[str, Any]
    ) -> tuple[NeedleParameters, str, dict[str, dict[str, Gains]]]:
        law = self.text('law', LAWS, changes)
        return self.model_parameters(changes), law, self._gains(changes)

    def change(self, changes: Mapping[str, Any]) -> None:
        """Continue with other gains, friction or law; reject unstable gains."""
        try:
            parameters, law, gains = self._wanted(changes)
            depth = self._retract_depth(changes)
            self._supervisor.change(parameters, law, gains)
        except ParameterError as error:
            self._supervisor.events.reject(f'parameters: {error}')
            self.publish_events(self._supervisor.events)
            raise
        self._supervisor.retract_depth = depth
        if self._driver is not None:
            self._driver.robot.set_model(parameters)

    def cleanup(self) -> None:
        if self._action is not None:
            self._action.destroy()
        self._action = None
        self._supervisor.cleanup()
        self._driver = self._command = None

    def activate(self) -> None:
        """Start to answer measurements and to check for missing inputs."""
        self._supervisor.activate(self.now(), self._who_publishes())
        self._checks, self._missing = 0, {}
        self._watchdog = steady_timer(
            self, self._supervisor.safety.watch_period, self._check_inputs
        )

    def about(self) -> str:
        values = self.values()
        target = '' if values['steered'] else f'{contract.TARGET.name}, '
        hardware = ''
        if self._driver is not None:
            robot = self._driver.robot.settings
            hardware = f' ({robot.command} of {", ".join(robot.joints)})'
        return (
            f'law {values["law"]}, needle {values["needle"]}, {values["rate"]:g} Hz, delay '
            f'{values["delay"]:g}; takes {target}{contract.JOINT_TRAJECTORY.name} and '
            f'{self._topics.state.name}, publishes {self._topics.command.name}{hardware}'
        )

    def deactivate(self) -> None:
        """Command zero force, and discard the motion and its target."""
        now = self.now()
        answer = self._supervisor.deactivate(now)
        self._act(answer, now)
        for _ in range(_AGAIN if self._driver is not None else 0):
            sleep(_PAUSE)
            self._act(answer, now)
        self.destroy_timer(self._watchdog)

    # Inputs.

    def _passing(
        self,
        take: Callable[[Reading, int], ForceCommand | None],
        then: Callable[[], None] | None = None,
    ) -> Callable[[Reading], None]:

        def on_reading(reading: Reading) -> None:
            # Events without a command wait for the next command, or for `_check_inputs`.
            now = self.now()
            if (answer := take(reading, now)) is not None:
                self._act(answer, now)
            if then is not None:
                then()

        return on_reading

    def _on_request(self, word: str) -> tuple[bool, str]:
        success, line, answer = self._supervisor.request(word, self.now())
        self._act(answer)
        return success, line

    def _on_target(self, message: PointStamped) -> None:
        if self.get_parameter('steered').value:
            return
        header, point = message.header, message.point
        self._act(
            self._supervisor.target(
                nanoseconds(header.stamp), header.frame_id, point.y, point.z, self.now()
            )
        )

    def _on_trajectory(self, message: JointTrajectory) -> None:
        if message.joint_names and {*message.joint_names} <= _GUIDE:
            # The plant moves the guide of a steered needle.
            return
        header, path = message.header, JointPath.from_message(message)
        self._follow(nanoseconds(header.stamp), path, header.frame_id)

    def _follow(self, stamp: int, path: JointPath, frame: str = '') -> None:
        self._act(self._supervisor.trajectory(stamp, frame, path, self.now()))

    def _who_publishes(self) -> dict[str, int]:
        """Count the publishers of commands and measurements; active or not."""
        return {name: sources.count(topic) for name, (topic, sources) in self._sources.items()}

    def _check_inputs(self, _came: int = 0) -> None:
        """Check for missing inputs and for duplicate publishers."""
        if self.is_active:
            self._act(self._supervisor.watch(self.now(), self._who_publishes()))
            if self._driver is not None:
                self._check_driver(self._driver)

    def _check_driver(self, driver: Driver) -> None:
        """Log why an input was never received, each reason once, after discovery."""
        self._checks += 1
        supervisor, before = self._supervisor, self._missing
        if self._checks % round(_PATIENCE / supervisor.safety.watch_period):
            return
        streams = supervisor.safety.streams
        names = [name for name in driver.robot.settings.expected if not streams[name].counts]
        if supervisor.waits:
            names.append(contract.JOINT_STATES.name)
        self._missing = {name: driver.missing(name) for name in names}
        for name, line in self._missing.items():
            streams[name].refused = line
            if line != before.get(name):
                supervisor.events.add(Severity.WARNING, line)
        self.publish_events(supervisor.events)

    # Outputs.

    def _act(self, answer: ForceCommand | None, now: int | None = None) -> None:
        if answer is not None and self._command is not None:
            stamp, force, torque, reference, error = answer
            driver, supervisor = self._driver, self._supervisor
            if driver is None:
                message = self._write_wrench(stamp, 0.0, force, 0.0, torque, 0.0, 0.0)
            else:
                stopped = supervisor.safety.stop is not None
                depth = supervisor.depth(self.now() if now is None else now)
                message = driver.message(answer, depth, supervisor.bending.load, stopped=stopped)
            if message is not None:
                self._command(message)
            if reference:
                self._reference(self._write_aim(stamp, *reference))
                self._tracking_error(self._write_aim(stamp, *error))
                self._update_goals(answer)
        self._system.publish()
        self.publish_events(self._supervisor.events)
        if self._supervisor.requests.due():
            self.publish_diagnostics()

    def _update_goals(self, answer: ForceCommand) -> None:
        """Check the goals at a measurement, against the reference that its command follows."""
        controller = self._supervisor.controller
        if controller is None or self._action is None or not self._action.moves:
            return
        (position, velocity), (position_error, velocity_error) = answer.reference, answer.error
        reference = JointReference(position, velocity, nan, controller.guide.arrived)
        actual = position - position_error, velocity - velocity_error, answer.force
        joint = contract.INSERTION
        paused = (joint,) if controller.guide.paused else ()
        self._action.update(answer.stamp, {joint: FollowedJoint(reference, actual)}, paused)

    def diagnose(self) -> Diagnosis[ControllerStatus]:
        severity, held, status = self._supervisor.diagnose(self.now())
        if self._driver is not None:
            status = self._driver.with_robot(status)
            missing = self._missing.get(contract.JOINT_STATES.name)
            if held is not None and self._supervisor.waits and missing:
                held = f'{held}: {missing}'
        return Diagnosis(severity, held or self.state, status)


if __name__ == '__main__':
    sys.exit(run(ControllerNode))
