# SPDX-License-Identifier: Apache-2.0
"""Plant and controller in lockstep over DDS: reproducible runs, and agreement with theory."""

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import groupby
from math import inf
import os
from pathlib import Path
import subprocess
import sys
from typing import Any

from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped
from needle_controller import (
    ContinuousInverseDynamics,
    ExecutiveSettings,
    SteeringModel,
    SteeringPrior,
)
from needle_controller.steering.law import build_law, DEFAULT_LAW
from needle_controller.steering.settings import SteeringLimits, step_depths
from needle_controller.steering.simulation import sample_truth, simulate_steering
from needle_dynamics import FloatArray, NeedleModel, NeedleParameters, NEEDLES
from needle_identification import Bag
from needle_identification.bags.bag import read_topic
from needle_identification.bags.messages import deserialize, encode
from needle_identification.recorder_node import is_hidden
from needle_insertion.graph.lockstep import RunSample
from needle_insertion.graph.ros_graph import Graph
from needle_insertion.replay.rerun import verify
from needle_ros.base_node import COMMAND, SENSOR
from needle_ros.status import ControllerStatus, read_reports, SteeringPhase, SteeringStatus
from needle_ros.timing import seconds
import numpy as np
import pytest
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from reproduction.insertions.simulated_run import SimulatedRun
from rosgraph_msgs.msg import Clock
from scipy.integrate import solve_ivp
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool
from support.closed_loop import closed_loop
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

START, TARGET, DURATION, RATE = 0.02, 0.12, 10.0, 1000.0

#: Critically damped at 1 rad/s: the error decreases to 5e-4 of its start within 10 s.
KP, KV = 1.0, 2.0

#: Full friction compensation as in the source: after a stop near the end the law would request a
#: velocity of 5e-8 m/s in the next period.
BREAKAWAY = 1e-8

#: QoS of a slow subscriber.
EVERY = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.BEST_EFFORT)

#: Insertion depth at the start of a steered insertion [m].
DEPTH = 5e-3

#: Streams of a run; /diagnostics depends on the machine.
DATA = {
    '/joint_states', '/base_wrench', '/tip_deflection', '/ground_truth', '/wrench_command',
    '/reference', '/tracking_error', '/needle_shape', '/needle_poses', '/clock',
}  # fmt: skip


def drive(
    logs: Path,
    target: float,
    plant: dict[str, Any],
    controller: dict[str, Any],
    until: float,
    bag: Path | None = None,
    course: JointTrajectory | None = None,
) -> list[JointState]:
    """
    Drive the needle to a target in lockstep; return the messages of `tracking_error`.

    Time starts when all nodes are discovered and the controller has its target, and the run ends
    after a simulated duration [s].
    """
    heard = ['joint_states', 'base_wrench', 'tip_deflection', 'wrench_command', 'tracking_error']
    errors: list[JointState] = []
    with Graph(logs) as graph:
        probe = graph.node('probe')
        health: dict[str, ControllerStatus] = {}

        def take(message: DiagnosticArray) -> None:
            for report in read_reports(message):
                if isinstance(report.status, ControllerStatus):
                    health[report.node] = report.status

        probe.create_subscription(DiagnosticArray, '/diagnostics', take, 10)
        probe.create_subscription(JointState, 'tracking_error', errors.append, EVERY)
        clock = graph.latest(probe, Clock, '/clock', SENSOR)
        aim = probe.create_publisher(PointStamped, 'target', COMMAND)
        move = probe.create_publisher(JointTrajectory, 'joint_trajectory', COMMAND)
        pause = probe.create_client(SetBool, 'plant/pause_time')
        graph.start('plant', {'lockstep': True, 'paused': True, **plant})
        graph.start('controller', {'use_sim_time': True, **controller})
        if bag is not None:
            recorder = graph.start('recorder', {'path': str(bag)})
        # Each of these except the tracking error has one subscriber in the loop.
        graph.spin_until(
            lambda: all(map(probe.count_subscribers, heard)) and probe.count_publishers('/clock'),
            'the nodes',
            timeout=120.0,
        )
        if bag is not None:
            graph.spin_until(lambda: records_all(probe), 'the recorder')
        graph.wait_active(probe, 'controller')
        message = PointStamped()
        message.point.y = target
        # Once: a repetition may be executed in motion.
        aim.publish(message)
        graph.spin_until(
            lambda: health.get('/controller', ControllerStatus()).target == target, 'the target'
        )
        if course is not None:
            # For the plant, and for the controller, which ignores it.
            graph.spin_until(lambda: move.get_subscription_count() >= 2, 'the subscribers')
            move.publish(course)
        graph.wait_for(probe, 'plant')
        answer = pause.call_async(SetBool.Request(data=False))
        graph.spin_until(answer.done, 'the beginning')
        graph.spin_until(
            lambda: clock.message and seconds(clock.message.clock) > until,
            'the end',
            timeout=120.0,
        )
        if bag is not None:
            recorder.interrupt()
    return errors


def records_all(probe: Node) -> bool:
    """
    Return whether the recorder has subscribed to all published topics.

    With Fast DDS 2.14 a subscription may take 0.3 s; earlier messages may be lost.
    """
    published = [
        name
        for name, _ in probe.get_topic_names_and_types()
        if probe.count_publishers(name) and not is_hidden(name)
    ]
    return set(published) >= DATA and all(
        'recorder' in [one.node_name for one in probe.get_subscriptions_info_by_topic(name)]
        for name in published
    )


def contents(bag: Path, until: float) -> dict[str, list[bytes]]:
    """
    Return the messages of each topic of a bag up to a stamp [s].

    They are serialized again, because the padding on the wire contains uninitialized memory.
    """
    found = defaultdict(list)
    for batch in Bag(bag).batches(lambda topic: topic.name in DATA):
        for _, data in batch.messages():
            message = deserialize(batch.topic, data)
            stamp = message.clock if batch.topic.name == '/clock' else message.header.stamp
            if seconds(stamp) <= until:
                found[batch.topic.name].append(encode(message))
    # During discovery a sample may have to be repeated.
    return {name: [data for data, _ in groupby(all_)] for name, all_ in found.items()}


def exact(times: FloatArray) -> FloatArray:
    """Solve e_ddot + kv e_dot + kp e = 0 from rest: the closed loop of the law."""
    return (TARGET - START) * (1.0 + times) * np.exp(-times)


@pytest.mark.parametrize('preset', ['paper_si', 'paper_mm'])
def test_continuous_loop_satisfies_its_error_equation(preset: str) -> None:
    """The law of the source, solved as an ODE with the full needle model."""
    model = NeedleModel(NeedleParameters.preset(preset))
    law = ContinuousInverseDynamics(
        model=model, kp=[KP, KP], kv=[KV, KV], breakaway_speed=BREAKAWAY
    )
    goal = np.zeros((3, model.coordinates))
    goal[0, 0] = model.parameters.length - TARGET
    times = np.linspace(0.0, DURATION, 101)
    run = solve_ivp(
        closed_loop(law, model, goal),
        (0.0, DURATION),
        model.state_at(START),
        method='LSODA',
        t_eval=times,
        rtol=1e-8,
        atol=1e-10,
    )
    error = TARGET - (model.parameters.length - run.y[0])
    # Tolerance of the solver relative to the final error: 1e-8 m of 5e-5 m.
    assert np.abs(error / exact(times) - 1.0).max() < 1e-3


@pytest.mark.parametrize('preset', ['paper_si', 'paper_mm'])
def test_tracking_at_1_khz_agrees_with_the_continuous_loop(tmp_path: Path, preset: str) -> None:
    """
    After a step of 10 cm the depth error is within 10 % of the continuous error at all times.

    Time counts from the first measurement: the delay of one period is part of the deviation. The
    needle is straight and the tissue equals the prior: sensor noise would otherwise cause a load
    of 1 uN, which is 0.5 mm / s^2 of the moving 2 g.
    """
    common = {'needle': preset, 'rate': RATE}
    gains = {
        f'inverse_dynamics.{axis}.{name}': value
        for axis in ('insertion', 'rotation')
        for name, value in {'kp': KP, 'kv': KV, 'breakaway_speed': BREAKAWAY}.items()
    }
    straight = {
        'observer.irregularity': 0.0,
        'observer.initial_deflection': 1e-6,
        'observer.tip_noise': 1e-5,
        # Only the needle moves.
        'uncertainty.carriage': 0.0,
    }
    errors = drive(
        tmp_path / 'logs',
        TARGET,
        {**common, 'depth': START, 'real_time_factor': 0.0},
        {
            **common,
            **gains,
            **straight,
            'law': 'inverse_dynamics',
            'reference.kind': 'step',
            'safety.tracking_error': TARGET,
        },
        DURATION + 0.01,
    )
    stamps = np.array([seconds(message.header.stamp) for message in errors])
    error = np.array([message.position[0] for message in errors])
    time = stamps - 1.0 / RATE
    within = time <= DURATION
    # The probe is not part of the loop and misses messages on a busy machine. The time constant of
    # the closed loop is 1 s, so that half of the 1000 samples per second show every phase.
    assert within.sum() > 0.5 * RATE * DURATION
    deviation = np.abs(error[within] / exact(time[within]) - 1.0)
    assert deviation.max() < 0.1, f'at {time[deviation.argmax()]:.3f} s'


def test_runs_with_the_same_seed_are_identical(tmp_path: Path) -> None:
    """Every message of plant and controller has the same content in both bags."""
    bags = [tmp_path / name for name in ('one', 'two')]
    for bag in bags:
        drive(
            tmp_path / f'{bag.name}_logs',
            0.025,
            {'rate': RATE, 'depth': START, 'tip_deflection': 5e-4, 'real_time_factor': 0.0},
            {'rate': RATE},
            1.5,
            bag,
        )
    one, two = (contents(bag, 1.4) for bag in bags)
    assert set(one) == DATA
    counts = {name: len(messages) for name, messages in one.items()}
    assert counts['/joint_states'] == counts['/wrench_command'] == 1400
    assert one == two


def test_steered_run_is_reproduced_by_replay(tmp_path: Path) -> None:
    """
    The guide moves and the needle rotates during the insertion; all inputs are recorded.

    The model of the controller contains neither cutting force nor guide; the needle still reaches
    its target.
    """
    point = JointTrajectoryPoint(positions=[2e-3, -0.02, 1.5], time_from_start=Duration(sec=2))
    course = JointTrajectory(joint_names=['guide_x', 'guide_tilt_z', 'roll'], points=[point])
    bag, common = tmp_path / 'bag', {'needle': 'bending_35mm', 'rate': RATE}
    drive(
        tmp_path / 'logs',
        0.05,
        {
            **common,
            'steered': True,
            'depth': START,
            'real_time_factor': 0.0,
            'steering.bevel_load': [0.3],
            'steering.cutting_force': [1.0],
            'steering.path_noise': 1e-3,
            'tip.noise': 1.8e-4,
            'tip.rate': 40.0,
            'tip.delay': 0.02,
        },
        common,
        6.0,
        bag,
        course,
    )
    (run,) = verify(bag)
    assert run.verdict == 'identical', run.first
    assert len(run.recorded.numbers) > 6000 - 10
    rows = run.recorded.rows
    assert len(rows['/tip_deflection'].values) > 6 * 40 - 10
    depth, x, _, _, tilt, roll = rows['/joint_states'].values[-1, :6]
    # The law leaves an error of 0.05 mm for an unmodeled force.
    assert abs(depth - 0.05) < 5e-5
    np.testing.assert_allclose([x, tilt, roll], [2e-3, -0.02, 1.5], rtol=1e-4)
    _, tip_x, tip_z, tip_roll = rows['/ground_truth'].values[-1, :4]
    assert abs(tip_x) > 2e-4
    assert abs(tip_z) > 2e-4
    assert tip_roll == roll
    assert 'refused' not in (tmp_path / 'logs' / 'controller.log').read_text()


@contextmanager
def busy(number: int) -> Iterator[None]:
    """Run busy processes."""
    # They end on their own, too.
    work = 'from time import monotonic as now; end = now() + 300\nwhile now() < end: pass'
    processes = [subprocess.Popen([sys.executable, '-c', work]) for _ in range(number)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def steer(
    folder: Path,
    target: tuple[float, float, float] = (1e-3, 0.015, 0.0),
    steering: dict[str, Any] | None = None,
    plant: dict[str, Any] | None = None,
) -> Path:
    """Steer a needle by nodes, by default in two steps; return the bag."""
    bag, common = folder / 'bag', {'needle': 'bending_35mm'}
    end = inf
    with Graph(folder / 'logs') as graph:
        run = SimulatedRun(graph, lambda *_: None)

        def proceeds(sample: RunSample) -> bool:
            nonlocal end
            # On a busy machine the first samples may arrive before the first status.
            if 'steering' not in run.states:
                return sample.time < 1.0
            status = run.states['steering'].report.status
            assert isinstance(status, SteeringStatus)
            if end == inf and status.phase is SteeringPhase.DONE:
                end = sample.time + 0.5
            assert status.phase is not SteeringPhase.STOPPED, status.fault
            assert sample.time < 60.0
            return sample.time < end

        nodes: dict[str, dict[str, Any]] = {
            'steering': {**common, 'speed': 0.02, 'measurement_time': 0.2, **(steering or {})},
            'controller': {
                **common, 'rate': RATE, 'steered': True, 'deflection_feedback': 'none',
                'reference.speed': 0.02, 'reference.acceleration': 0.5,
            },
            'plant': {
                **common, 'rate': RATE, 'steered': True, 'depth': DEPTH, 'tip.rate': 40.0,
                'tip.noise': 1.8e-4, 'tip.delay': 0.02, 'steering.cutting_force': [1.0],
                **(plant or {}),
            },
        }  # fmt: skip
        run.insert(bag, nodes, DEPTH, target, proceeds)
    return bag


def test_steered_run_is_identical_on_a_busy_machine(tmp_path: Path) -> None:
    """Three nodes and a user depend on simulated time only, without message loss."""
    quiet = steer(tmp_path / 'quiet')
    with busy(os.cpu_count() or 1):
        loaded = steer(tmp_path / 'busy')
    one, two = (contents(bag, 2.5) for bag in (quiet, loaded))
    assert set(one) == DATA
    assert len(one['/joint_states']) == round(2.5 * RATE)
    assert one == two


def test_nodes_end_at_the_tip_of_the_simulated_loop(tmp_path: Path) -> None:
    """
    The nodes steer a needle as `simulate_steering` does, which `needle steer` and studies use.

    Path and sensor have almost no noise: the two draw it in their own order. The guide of the
    plant has no tilt.
    """
    target, prior, path_noise, seed = (2e-3, 0.06, -1e-3), SteeringPrior(), 1e-12, 3
    needle, steering, _ = NEEDLES['bending_35mm']
    drawn = sample_truth(needle, steering, prior, np.random.default_rng(seed), seed)
    bevel = float(np.hypot(*drawn.bevel))
    truth = replace(
        drawn,
        steering=replace(drawn.steering, path_noise=path_noise),
        tilt=(0.0, 0.0),
        frame=np.zeros(2),
        bevel=np.array([0.0, bevel]),
    )
    depths = DEPTH + step_depths(target[1] - DEPTH, SteeringLimits().step_length)
    tips = []
    for law in (DEFAULT_LAW, 'open_loop'):
        plant = truth.plant(depths)
        plant.needle.move(depth=DEPTH)
        model = SteeringModel(needle, steering, depths, prior)
        built = build_law(law, model, np.array(target)[[0, 2]], ExecutiveSettings().limits(0.005))
        simulate_steering(built, plant, lambda tip: tip)
        tips.append(plant.tip)
    bag = steer(
        tmp_path,
        target,
        None,
        {
            'model.tissue_stiffness': truth.needle.tissue_stiffness,
            'steering.skin_stiffness': truth.steering.skin_stiffness,
            'steering.bevel_load': [bevel],
            'steering.path_noise': path_noise,
            'tip.noise': 1e-8,
        },
    )
    _, message = read_topic(bag, '/ground_truth')[-1]
    tip = message.position[1:3]
    assert np.hypot(*(tips[1] - tips[0])) > 5e-4
    # The depth at rest is exact within 0.05 mm, and the path has a slope of at most 0.1.
    np.testing.assert_allclose(tip, tips[0], rtol=0.0, atol=5e-6)
