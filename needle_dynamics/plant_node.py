# SPDX-License-Identifier: Apache-2.0
"""Node `plant`: simulated needle, optionally moved by a simulated robot, or simulated indenter."""

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from functools import partial
import sys
from time import monotonic_ns
from typing import Any

from needle_dynamics.model_node import ModelNode
from needle_dynamics.needles import usable_needle
from needle_dynamics.plant_inputs_node import PlantCommanders, PlantTrajectories
from needle_dynamics.plant_outputs_node import PlantDisplay, SamplePublishers, SampleReports
from needle_dynamics.simulated.assembly import build_sample_clock, defaults_of, MODES, SETTINGS
from needle_dynamics.simulated.faults import FaultParameters, FAULTS, FAULTY, SensorFault
from needle_dynamics.simulated.run import Event, PARAMETERS, PlantRun, RESET, TARE
from needle_ros import contract
from needle_ros.base_node import steady_timer
from needle_ros.errors import JobError, NeedleError, ParameterError, printable
from needle_ros.event_log import Severity
from needle_ros.publishers_node import offer_lease
from needle_ros.run_node import run
from needle_ros.settings import LARGEST_SEED
from needle_ros.status import Diagnosis, PlantPhase, PlantStatus
from needle_ros.system_state import Authority, Mode, STOPPED
from needle_ros.system_state_node import SystemStateTopics
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import Reading
from rcl_interfaces.msg import IntegerRange, ParameterDescriptor
from std_srvs.srv import SetBool, Trigger

#: Period of the graph checks [s]; number of checks after which an unanswered sample is repeated,
#: and after which the missing answer is reported.
_CHECK = 0.1
_REPEAT, _LONG = 5, 20

_TOO_MANY = 3.0  #: Commands per sample above which a warning is reported.

_NO_FAULT = 'none'


def _exhausted(plant_run: PlantRun) -> str:
    limit = f'{plant_run.constants.own.power_limit:g} J within a second (power_limit)'
    return f'commands supplied more than {limit}; no force is applied until it is half of this'


class PlantNode(ModelNode):
    """
    Simulated plant: the needle or the end-effector, with sensors.

    Lengths in m, forces in N, torques in N m, positive into the tissue. In mode `simulation`
    the needle moves under ``wrench_command`` (force.y, torque.x); in mode `robot` the base
    follows ``joint_trajectory`` (joint `insertion`: positions, or efforts for a push). Both
    publish ``joint_states``, ``base_wrench``, ``tip_deflection`` and ``ground_truth``, and for
    visualization ``needle_shape`` and ``needle_poses``. With ``steered`` the needle bends and cuts
    its path, and its guide and roll follow ``joint_trajectory`` in both modes. In mode `indenter`
    the end-effector presses the tissue according to ``joint_trajectory`` (efforts of the joints
    `x` and `z`) and publishes ``base_wrench`` and ``end_effector_pose``. A trajectory starts at
    its stamp, see `PlantTrajectories`. ``joint_commands`` are sent by a driver of
    ros2_control: efforts in mode `simulation`, positions in mode `robot`. Only one node may
    publish commands, on one of the two topics.

    Samples are taken at exact multiples of the period of simulated time, see `SampleClock`; with
    ``publish_clock`` or ``lockstep`` this time is /clock. `Commands` selects the command that acts
    from one sample to the next. A command carries the stamp of the sample to which it responds;
    with ``lockstep`` the next sample waits for this command, and for all nodes that report
    processed samples, such as `steering`. ``~/pause_time`` stops time, ``~/step`` takes one
    sample, ``~/reset`` restores the initial state of needle and noise while time continues.
    ``~/events`` records every input other than commands, so that the run can be recomputed.
    While the system is stopped, no command or trajectory acts, see `needle_ros.system_state`.
    """

    LIVE = frozenset(
        {
            'model.coulomb_friction',
            'model.viscous_friction',
            'fault.kind',
            'fault.topic',
            *(f'fault.{item.name}' for item in fields(FaultParameters)),
        }
    )

    KERNELS = (
        'needle_dynamics.compiled.axis',
        'needle_dynamics.compiled.cut',
        'needle_dynamics.compiled.cutting_needle',
        'needle_dynamics.compiled.force_sensor',
        'needle_dynamics.compiled.friction',
        'needle_dynamics.compiled.integrals',
        'needle_dynamics.compiled.normal_modes',
        'needle_dynamics.compiled.step:advance_boxed',
    )

    def __init__(self, **node_options: Any) -> None:
        super().__init__('plant', **node_options)
        self.declare_text('mode', MODES[0], f'one of {", ".join(MODES)}', MODES)
        self.declare_text('publish_clock', False, 'publish the simulated time on /clock')
        self.declare_text(
            'lockstep',
            False,
            'each sample waits for the command in response to the previous sample, and for all '
            'nodes that process samples',
        )
        self.declare_text('paused', False, 'start with time paused')
        self.declare_text(
            'publish_tf', False, f'publish {contract.TIP} in {contract.BASE} on {contract.TF.name}'
        )
        self.declare_text(
            'frame_prefix', '', f'prefix of the frames on {contract.TF.name} and displays'
        )
        self.declare_parameter(
            'seed',
            1,
            ParameterDescriptor(
                description='seed of the sensor noise: the same seed gives the same noise',
                integer_range=[IntegerRange(from_value=0, to_value=LARGEST_SEED)],
            ),
        )
        self.declare_text(
            'steered', False, 'the needle bends, cuts its own path, and has a movable guide'
        )
        self.declare_model()
        needle = usable_needle(self.text('needle'))
        for prefix in SETTINGS:
            if prefix != 'model.':
                self.declare_settings(prefix, defaults_of(prefix, needle))
        self.declare_text(
            'fault.kind',
            _NO_FAULT,
            f'{_NO_FAULT}, or one of {", ".join(FAULTS)}',
            (_NO_FAULT, *FAULTS),
        )
        self.declare_text('fault.topic', 'joint_states', f'one of {", ".join(FAULTY)}', FAULTY)
        self.declare_settings('fault.', FaultParameters())

        self._run: PlantRun | None = None
        #: Number of samples taken before the latest configuration.
        self._number = 0
        self._halted: str | None = None
        #: Number of samples computed later than due.
        self._late = 0

        self._authority, self._mode = Authority(), Mode.RUNNING
        self._retracted = 0  #: Time of the last retraction [ns].
        self._system = SystemStateTopics(self, self._authority, self._on_request, self._obey)

    # Transitions.

    def configure(self) -> None:
        """Build the plant from the parameters."""
        plant_run = PlantRun(self.values(), self._number)
        constants = plant_run.constants
        own, lockstep = constants.own, bool(self.get_parameter('lockstep').value)
        publishes = lockstep or bool(self.get_parameter('publish_clock').value)
        self._time = build_sample_clock(
            constants,
            lockstep=lockstep,
            publish_clock=publishes,
            use_sim_time=bool(self.get_parameter('use_sim_time').value),
        )
        # Load or compile functions before the first sample.
        constants.make().take(0.0, 0.0)
        offer_lease(self, contract.MEASURER)
        self._samples = SamplePublishers(self, plant_run)
        self._samples.fault, self._samples.faulty = self._fault({})
        self._display = PlantDisplay(self)
        self._display.use_frames(self.text('frame_prefix'))
        self._commanders = PlantCommanders(
            self, self._on_command, self._on_joint_commands, self._check_commanders
        )
        if self.get_parameter('publish_tf').value:
            self._display.offer_transform(constants.mode)
        # `cleanup` destroys its action: nothing after it may fail.
        self._trajectories = PlantTrajectories(
            self, plant_run, lambda: self._time.simulated(self.now()), self._end_retraction
        )
        self._run = plant_run
        if publishes:
            self._samples.offer_clock()
        # With simulated time, the plant waits for recorders.
        recorded = publishes or own.real_time_factor != 1.0
        self._reports = SampleReports(
            self, self._on_timer, self._time, processed=lockstep, recorded=recorded
        )
        for name, kind, act in (
            ('tare', Trigger, self._tare),
            ('pause_time', SetBool, self._pause),
            ('step', Trigger, self._step),
            ('reset', Trigger, self._reset),
        ):
            self.create_service(kind, f'~/{name}', partial(self._answer, name, act))
        self._mode = Mode.RUNNING
        self._obey()

    def cleanup(self) -> None:
        if self._run is not None:
            self._number = self._run.number
            self._trajectories.destroy()
        self._run = None

    def change(self, changes: Mapping[str, Any]) -> None:
        """Apply changed friction or fault parameters; the state is kept."""
        # Each is checked before any acts.
        fault = self._fault(changes) if any(one.startswith('fault.') for one in changes) else None
        if self._run is not None:
            self._run.perform(Event(PARAMETERS, changes))
        if fault is not None:
            self._samples.fault, self._samples.faulty = fault

    def _fault(self, changes: Mapping[str, Any]) -> tuple[SensorFault | None, str]:
        """Return the fault of the parameters, and the topic that has it."""
        kind = self.text('fault.kind', (_NO_FAULT, *FAULTS), changes)
        topic = self.text('fault.topic', tuple(FAULTY), changes)
        parameters = self.settings('fault.', FaultParameters, changes)
        if kind == _NO_FAULT:
            return None, topic
        rate, seed = self.get_parameter('rate').value, self.get_parameter('seed').value
        return SensorFault(kind, parameters, float(rate), seed), topic

    def activate(self) -> None:
        if self._run is None:
            return
        self._halted = None
        self._late = 0
        self._samples.begin()
        self._run.begin()
        self._trajectories.begin()
        self._check_commanders()
        own = self._run.constants.own
        self._display.begin(own.rate * max(1.0, own.real_time_factor))
        self._time.begin(self.now(), paused=bool(self.get_parameter('paused').value))
        self._active_timers = (
            self.create_timer(self._time.tick, self._on_timer),
            steady_timer(self, _CHECK, self._on_check),
        )

    def about(self) -> str:
        """Describe mode, constants, rate and topics."""
        values = self.values()
        takes = [contract.JOINT_TRAJECTORY.name] if self._trajectories.received else []
        if values['mode'] == 'simulation':
            takes.append(contract.WRENCH_COMMAND.name)
        if values['mode'] != 'indenter':
            takes.append(contract.JOINT_COMMANDS.name)
        steered = ', steered' if values['steered'] else ''
        return (
            f'mode {values["mode"]}{steered}, needle {values["needle"]}, '
            f'{values["rate"]:g} Hz; takes {" and ".join(takes)}, publishes '
            f'{", ".join(self._samples.topics)}'
        )

    def deactivate(self) -> None:
        self._trajectories.end('the plant is not active')
        for timer in self._active_timers:
            self.destroy_timer(timer)

    # Commands.

    def _on_command(self, reading: Reading) -> None:
        def offer(plant_run: PlantRun, now: int) -> tuple[bool, str]:
            _, force, _, torque, _, _ = reading.values[0]
            return plant_run.commands.offer(reading.stamp, reading.frame, force, torque, now)

        self._take_command(offer)

    def _on_joint_commands(self, reading: Reading) -> None:
        self._take_command(lambda plant_run, now: plant_run.command_joints(reading, now))
        if self._run is not None and self._run.commanded:
            self._trajectories.displace('joint_commands are followed', self._run.commanded)

    def _take_command(self, offer: Callable[[PlantRun, int], tuple[bool, str]]) -> None:
        plant_run = self._run
        if plant_run is None or not self.is_active:
            return
        self._commanders.rate.add(monotonic_ns())
        if self._commanders.changed:
            # The match event may be pending: no command of a second node may act.
            self._check_commanders()
        counts, refusal = offer(plant_run, self._time.simulated(self.now()))
        if refusal:
            self.get_logger().error(printable(refusal), throttle_duration_sec=1.0)
        if counts and self._time.awaited is not None:
            self._time.answered(plant_run.commands.newest.stamp)
            self._on_timer()

    def _on_request(self, word: str) -> tuple[bool, str]:
        result = self._authority.request(word)
        self._obey()
        return result

    def _obey(self) -> None:
        """End every force and motion of a stop, withdraw the needle, or hold it in a pause."""
        mode, before, reason = self._authority.mode, self._mode, self._authority.reason
        new, self._retracted = self._authority.compare(before, self._retracted)
        self._mode = mode
        if self._run is None or not new:
            return
        self._trajectories.stopped = f'{STOPPED}{reason}' if reason else ''
        if Mode.STOPPED in (mode, before):
            self._trajectories.end(self._trajectories.stopped or 'sent during a stop')
        if mode is Mode.STOPPED:
            self.get_logger().error(f'stopped: {reason}; no force or motion until ~/clear_stop')
            self._run.halt()
        elif mode is Mode.RETRACTING:
            self._trajectories.end('the needle is retracted')
            self._run.withdraw()
        elif mode is Mode.PAUSED:
            self._trajectories.executions.pause(withdraws=before is Mode.RETRACTING)
        if before is Mode.PAUSED:
            self._trajectories.executions.resume()
        self._run.commands.stopped = mode is Mode.STOPPED
        self._run.mode = mode
        self.publish_diagnostics()

    def _end_retraction(self) -> None:
        self._authority.run()
        self._obey()

    # Services.

    def _answer(
        self, name: str, act: Callable[[PlantRun, Any], str], request: Any, response: Any
    ) -> Any:
        try:
            if self._run is None or not self.is_active:
                raise JobError('the plant is not active')
            response.message = act(self._run, request)
            response.success = True
        except (JobError, ParameterError) as error:
            response.message = f'{name} refused: {error}'
        self.publish_diagnostics()
        return response

    def _tare(self, plant_run: PlantRun, _request: Trigger.Request) -> str:
        plant_run.perform(Event(TARE))
        return 'the force sensor is zeroed'

    def _pause(self, _run: PlantRun, request: SetBool.Request) -> str:
        if request.data:
            self._time.pause()
            return f'paused at {self._time.stamp / NANOSECONDS:.6f} s'
        self._time.resume(self.now())
        return 'time resumed'

    def _step(self, _run: PlantRun, _request: Trigger.Request) -> str:
        self._sample(self._time.step(self.now()))
        return f'stepped to {self._time.stamp / NANOSECONDS:.6f} s'

    def _reset(self, plant_run: PlantRun, _request: Trigger.Request) -> str:
        # The joints of a goal hold where they are measured: before the reset.
        self._trajectories.end('the plant was reset')
        plant_run.perform(Event(RESET))
        self._trajectories.begin()
        self._halted = None
        self._samples.fault, self._samples.faulty = self._fault({})
        return 'needle and noise reset; time continues'

    # Samples.

    def _on_timer(self) -> None:
        if self._run is None:
            return
        due = self._time.due(self.now())
        self._late += max(0, due - 1)
        end = monotonic_ns() + 0.25 * self._run.constants.own.backlog * NANOSECONDS
        for _ in range(due):
            self._sample(self._time.take())
            if monotonic_ns() > end:
                # Commands are waiting: they must not become too old on an overloaded machine.
                break

    def _on_check(self) -> None:
        """Check for command publishers, and repeat a sample that is not answered."""
        if self._run is None:
            return
        self._check_commanders()
        self._trajectories.publish_answers()
        self._reports.check()
        checks = self._reports.checks
        if checks and checks % _REPEAT == 0 and not self._time.paused:
            self._samples.repeat()
        self.report_change()

    def _check_commanders(self, new: int | None = None) -> None:
        """Count the command publishers; no force acts while there are several."""
        if self._run is None:
            return
        several = self._commanders.update(new)
        # A publisher may have appeared and disappeared while this process was blocked.
        if several:
            self._run.commands.ignore(self._time.simulated(self.now()))
        count = self._commanders.count()
        if self._run.commands.count_commanders(count):
            if self._run.commands.duplicates:
                self.get_logger().error(
                    f'{count} nodes command; no force is applied', throttle_duration_sec=1.0
                )
            self.report_change()

    def _sample(self, stamp: int) -> None:
        plant_run = self._run
        self._samples.publish_clock(stamp)
        if plant_run is None or self._halted is not None:
            return
        was_exhausted = plant_run.commands.exhausted
        try:
            measured = plant_run.take(stamp)
        except NeedleError as error:
            self._halted = str(error)
            self.get_logger().error(f'{error}; the plant has stopped')
            self._trajectories.halt(f'{error}; the plant has stopped')
            self.report_change()
            return
        if plant_run.commands.exhausted and not was_exhausted:
            self.get_logger().error(_exhausted(plant_run), throttle_duration_sec=1.0)
        events = plant_run.events()
        if events:
            self._samples.publish_events(events, stamp, plant_run.number)
        self._display.publish(plant_run.plant, stamp)
        self._samples.publish(stamp, measured)
        self._trajectories.sample(stamp)

    @property
    def _phase(self) -> PlantPhase:
        if not self.is_active:
            return PlantPhase.INACTIVE
        if self._halted:
            return PlantPhase.HALTED
        return PlantPhase.PAUSED if self._time.paused else PlantPhase.RUNNING

    def _status(self, plant_run: PlantRun) -> PlantStatus:
        clock, given, now = self._time, plant_run.commands, monotonic_ns()
        late, samples = self._reports.checks >= _LONG, self._samples
        return replace(
            plant_run.plant.report,
            phase=self._phase,
            system=self._authority.mode,
            halt=self._halted or '',
            time=clock.stamp / NANOSECONDS,
            real_time_factor=samples.rate.rate(now) / plant_run.constants.own.rate,
            command_rate=self._commanders.rate.rate(now),
            commanders=given.duplicates + 1 if given.duplicates else 0,
            exhausted=given.exhausted,
            computed_later=self._late,
            skipped=clock.lost,
            waited=clock.waited / NANOSECONDS,
            awaited=clock.missing if late else '',
            rejected=given.refused + self._trajectories.rejected,
            stale=given.stale,
            superseded=given.overtaken,
            saturated=samples.saturated,
            sensor_fault='' if samples.fault is None else self.text('fault.kind'),
            faulty_topic='' if samples.fault is None else samples.faulty,
            other_clock=samples.other_clock,
            lockstep_nodes=clock.participants + len(clock.recorded),
            requests=self._trajectories.requests.status(),
        )

    def diagnose(self) -> Diagnosis[PlantStatus]:
        """Report needle state, timing and errors."""
        if self._run is None:
            return Diagnosis(Severity.INFO, self.state, PlantStatus())
        status = self._status(self._run)
        rate, commands = self._run.constants.own.rate, status.command_rate
        samples = status.real_time_factor * rate
        if status.phase is PlantPhase.INACTIVE:
            return Diagnosis(Severity.INFO, self.state, status)
        if self._halted:
            return Diagnosis(Severity.ERROR, self._halted, status)
        if status.commanders:
            return Diagnosis(Severity.ERROR, f'{status.commanders} nodes command', status)
        if status.exhausted:
            return Diagnosis(Severity.ERROR, _exhausted(self._run), status)
        if other := status.other_clock:
            line = f'{other} publishes {contract.CLOCK.name}, too: remap it in each namespace'
            return Diagnosis(Severity.ERROR, f'{line}, -r /clock:=clock', status)
        warnings = []
        if status.phase is PlantPhase.PAUSED:
            warnings.append(f'paused at {status.time:.6f} s')
        if status.awaited:
            warnings.append(f'{status.awaited} the sample of {status.time:.6f} s')
        if status.skipped:
            warnings.append(f'{status.skipped} samples skipped after stalls')
        if commands > _TOO_MANY * max(samples, rate):
            warnings.append(f'{commands:.0f} commands per second for {samples:.0f} samples')
        if status.sensor_fault:
            warnings.append(f'{status.faulty_topic} has the fault {status.sensor_fault}')
        severity = Severity.WARNING if warnings else Severity.INFO
        return Diagnosis(severity, '; '.join(warnings) or self.state, status)


if __name__ == '__main__':
    sys.exit(run(PlantNode))
