"""The friction experiment of section 3.2.2.2 on the robot stand-in, recorded bag by bag."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import time

from needle_dynamics import ForceSensorParameters
from needle_dynamics.base_node import COMMAND
from needle_insertion.graph import Graph
from rclpy.duration import Duration
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

#: Inserted length at which the tip has passed the tissue, so that nothing is cut [m].
START_DEPTH = 0.1

#: Speeds of the strokes [m/s]: manual insertion is in this range.
SPEEDS = (0.002, 0.005, 0.010, 0.015, 0.020)

#: Time of one stroke and of the rest after it [s].
STROKE_TIME = 1.0
REST_TIME = 0.2

#: Sample rates at which the strokes are resolved [Hz].
RATES = (50.0, 5000.0)

#: Topics that identification needs.
TOPICS = ('/base_wrench', '/joint_states', '/joint_trajectory', '/plant/configuration')


def strokes() -> tuple[list[float], list[float]]:
    """
    Return the protocol: at each speed one stroke in and one back, with rests.

    Returns
    -------
    times, depths : list of float
        Points of the base trajectory [s], [m].

    """
    times, depths = [REST_TIME], [START_DEPTH]
    for speed in SPEEDS:
        for depth in (START_DEPTH + speed * STROKE_TIME, START_DEPTH):
            times += [times[-1] + STROKE_TIME, times[-1] + STROKE_TIME + REST_TIME]
            depths += [depth, depth]
    return times, depths


def record_friction_run(
    bag: Path,
    logs: Path,
    *,
    seed: int,
    rate: float = 1000.0,
    progress: Callable[[float], None] = lambda _fraction: None,
) -> None:
    """
    Run the protocol once on real nodes and record it.

    Parameters
    ----------
    bag : Path
        Folder of the bag to write; must not exist.
    logs : Path
        Folder for what the nodes print.
    seed : int
        Seed of the force sensor's noise.
    rate : float
        Samples per second [Hz].
    progress : callable
        Called with the fraction done.

    Raises
    ------
    GraphError
        If a node fails.

    """
    times, depths = strokes()
    with Graph(logs) as graph:
        recorder = graph.start('recorder', {'path': str(bag), 'topics': list(TOPICS)})
        plant = graph.start(
            'plant',
            {
                'autostart': False,
                'mode': 'robot',
                'depth': START_DEPTH,
                'rate': rate,
                'seed': seed,
                # A slow recording needs a filter that fits it.
                'sensor.cutoff': min(ForceSensorParameters().cutoff, 0.25 * rate),
            },
        )
        node = graph.node('friction_experiment')
        trajectory = node.create_publisher(JointTrajectory, 'joint_trajectory', COMMAND)
        # The plant begins when the recorder listens: the bag holds every sample.
        graph.spin_until(
            lambda: (
                trajectory.get_subscription_count() == 2
                and all(node.count_subscribers(topic) for topic in TOPICS)
            ),
            'the recorder',
        )
        graph.activate(node, 'plant')
        message = JointTrajectory(joint_names=['insertion'])
        message.header.stamp = node.get_clock().now().to_msg()
        message.points = [
            JointTrajectoryPoint(positions=[depth], time_from_start=Duration(seconds=at).to_msg())
            for at, depth in zip(times, depths, strict=True)
        ]
        trajectory.publish(message)
        start = time.monotonic()

        def done() -> bool:
            elapsed = time.monotonic() - start
            progress(min(elapsed / times[-1], 1.0))
            return elapsed > times[-1] + REST_TIME

        graph.spin_until(done, 'the end of the strokes', timeout=times[-1] + 30.0)
        recorder.interrupt()
        plant.interrupt()
