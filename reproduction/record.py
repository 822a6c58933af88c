# SPDX-License-Identifier: Apache-2.0
"""Record the runs of a campaign with real nodes, one bag each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
import shutil
from typing import Any

from geometry_msgs.msg import WrenchStamped
from needle_dynamics import ParameterError
from needle_identification import RecordingError
from needle_identification.bags.bag import message_counts, read_topic
from needle_insertion.graph.ros_graph import ACTIVATE, CLEANUP, CONFIGURE, DEACTIVATE, Graph
from needle_insertion.progress import ProgressLine
from needle_ros.base_node import COMMAND, SENSOR
from needle_ros.errors import JobError
from needle_ros.parameter_file import parameters_by_node
from needle_ros.timing import seconds
import numpy as np
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from reproduction.campaign import Campaign
from reproduction.protocol import ExperimentProtocol, SPEED
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

#: Timeout of a sample on a busy machine, and period of the checks for the end [s].
_STALL, _CHECK = 60.0, 0.05


class ExperimentError(JobError):
    """A run could not be recorded completely."""


def record(campaign: Campaign, folder: Path, speed: float = SPEED) -> list[Path]:
    """
    Record the missing runs of a campaign, and return all its bags in order.

    `speed` is a multiple of real time. Raises `ParameterError`, before any recording, if the
    folder holds other data under the name of a bag; `GraphError` or `ExperimentError` if a node
    fails or samples are lost even in real time. Completed bags and other files are kept.
    """
    runs, protocol = campaign.runs, campaign.protocol
    missing = [
        name
        for name, parameters in runs.items()
        if not _is_finished(folder / name, protocol, parameters)
    ]
    done, words = len(runs) - len(missing), f'{protocol.name} runs'
    if missing:
        with ProgressLine(words, brief=True) as show, rig(folder, protocol, show.note) as stand:
            for number, name in enumerate(missing, done + 1):
                stand.record(
                    folder / name, runs[name], speed, partial(show, f'{number} of {len(runs)}')
                )
    return [folder / name for name in runs]


@contextmanager
def rig(
    folder: Path, protocol: ExperimentProtocol, note: Callable[[str], object]
) -> Iterator[Rig]:
    """Start a plant and a recorder for runs of a protocol; drafts are in a hidden folder."""
    drafts = folder / f'.{protocol.name}.unfinished'
    # Left by an earlier call that was killed.
    shutil.rmtree(drafts, ignore_errors=True)
    drafts.mkdir(parents=True)
    try:
        with Graph(drafts / 'logs') as graph:
            yield Rig(graph, drafts / 'run', protocol, note)
    finally:
        shutil.rmtree(drafts, ignore_errors=True)


class Rig:
    """
    The simulated robot and a recorder, which record one run after the other.

    `draft` is the folder of the first bag during recording; the name of bag k ends in ``_k``.
    """

    def __init__(
        self,
        graph: Graph,
        draft: Path,
        protocol: ExperimentProtocol,
        note: Callable[[str], object],
    ) -> None:
        self._graph, self._draft, self._protocol, self._note = graph, draft, protocol, note
        self._recordings = 0
        topics = list(protocol.topics)
        graph.start('recorder', {'autostart': False, 'path': str(draft), 'topics': topics})
        graph.start('plant', {'autostart': False})
        self._node = node = graph.node('experiment')
        self._trajectory = node.create_publisher(JointTrajectory, 'joint_trajectory', COMMAND)
        self._wrench = graph.latest(node, WrenchStamped, 'base_wrench', SENSOR)
        self._plant = AsyncParameterClient(node, 'plant')
        graph.wait_for(node, 'plant')
        graph.change(node, 'recorder', CONFIGURE)

    def record(
        self,
        bag: Path,
        parameters: Mapping[str, Any],
        speed: float,
        progress: Callable[[float], None] = lambda _fraction: None,
    ) -> None:
        """
        Run the protocol once, and move the complete bag to a folder that must not exist.

        `speed` is a multiple of real time. If samples are lost, the run is repeated at half the
        speed, and so on down to real time: a bag lacks no sample, and is the same on any machine.
        `ExperimentError` if samples are lost in real time, too.
        """
        factor = speed
        while True:
            draft = self._run({**parameters, 'real_time_factor': factor}, progress)
            lost = _lost(draft, self._protocol, parameters['rate'])
            if not lost:
                _move(draft, bag)
                return
            said = f'{bag}: {lost} at {factor:g} times real time'
            if factor <= 1.0:
                raise ExperimentError(f'{said}; choose a lower --rate')
            self._note(said)
            factor = max(1.0, factor / 2.0)

    def _run(self, parameters: Mapping[str, Any], progress: Callable[[float], None]) -> Path:
        graph, node, protocol = self._graph, self._node, self._protocol
        if self._recordings:
            graph.change(node, 'plant', CLEANUP)
        answer = self._plant.set_parameters(
            [Parameter(name, value=value) for name, value in parameters.items()]
        )
        graph.spin_until(answer.done, 'the answer of plant')
        for result in answer.result().results:
            if not result.successful:
                raise ExperimentError(f'plant rejected its parameters: {result.reason}')
        graph.change(node, 'plant', CONFIGURE)
        # The plant is the only subscriber: the recorder has ended its earlier subscriptions.
        graph.spin_until(lambda: self._trajectory.get_subscription_count() == 1, 'the plant')
        graph.change(node, 'recorder', ACTIVATE)
        self._recordings += 1
        # The plant starts after the recorder has subscribed and the trajectory has arrived: the
        # bag holds every sample. This process also subscribes to the wrench.
        graph.spin_until(
            lambda: (
                self._trajectory.get_subscription_count() == 2
                and node.count_subscribers('/base_wrench') == 2
                and all(node.count_subscribers(topic) for topic in protocol.topics)
            ),
            'the recorder',
        )
        # Without a stamp it starts with the activation.
        self._trajectory.publish(_trajectory(protocol))
        self._trajectory.wait_for_all_acked(Duration(seconds=10.0))
        self._wrench.message = None
        graph.change(node, 'plant', ACTIVATE)
        graph.spin_until(lambda: self._wrench.message, 'base_wrench')
        start = seconds(self._wrench.message.header.stamp)

        def done() -> bool:
            elapsed = seconds(self._wrench.message.header.stamp) - start
            progress(min(elapsed / protocol.duration, 1.0))
            return elapsed > protocol.duration

        # The end is determined by stamps: simulated time may fall behind on a busy machine.
        graph.spin_until(
            done,
            'the next sample',
            _STALL,
            sign=lambda: self._wrench.message.header.stamp,
            period=_CHECK,
        )
        graph.change(node, 'plant', DEACTIVATE)
        graph.change(node, 'recorder', DEACTIVATE)
        number = self._recordings
        name = self._draft.name if number == 1 else f'{self._draft.name}_{number}'
        return self._draft.with_name(name)


def _move(draft: Path, bag: Path) -> None:
    """Rename a bag, also in its metadata."""
    old, new = f'{draft.name}_0.mcap', f'{bag.name}_0.mcap'
    (draft / old).rename(draft / new)
    metadata = draft / 'metadata.yaml'
    metadata.write_text(metadata.read_text(encoding='utf-8').replace(old, new), encoding='utf-8')
    draft.rename(bag)


def _trajectory(protocol: ExperimentProtocol) -> JointTrajectory:
    points = [
        JointTrajectoryPoint(
            positions=point.positions,
            effort=point.effort,
            time_from_start=Duration(seconds=point.time).to_msg(),
        )
        for point in protocol.points
    ]
    return JointTrajectory(joint_names=protocol.joints, points=points)


def _lost(bag: Path, protocol: ExperimentProtocol, rate: float) -> str:
    """Return a description of the missing samples of a recorded run, '' if it is complete."""
    counts = message_counts(bag)
    for topic in protocol.topics:
        if not counts.get(topic):
            return f'{topic} has no messages'
    for topic in protocol.sampled:
        stamps = np.array([seconds(message.header.stamp) for _, message in read_topic(bag, topic)])
        span = float(stamps.max() - stamps.min())
        if span < protocol.duration - 1.5 / rate:
            return f'{topic} lasts {span:.2f} s of {protocol.duration:.2f} s'
        due = round(span * rate) + 1
        if len(stamps) != due:
            return f'{topic} has {len(stamps)} messages of {due}'
    return ''


def _is_finished(bag: Path, protocol: ExperimentProtocol, parameters: Mapping[str, Any]) -> bool:
    """Return whether a run is recorded; raise `ParameterError` if its name is taken."""
    if not bag.exists():
        return False
    try:
        ((_, message),) = read_topic(bag, '/plant/configuration')
        found = parameters_by_node(message.data)['plant']
        commanded = [_points(message) for _, message in read_topic(bag, '/joint_trajectory')]
    except (RecordingError, AttributeError, KeyError, TypeError, ValueError):
        raise ParameterError(
            f'{bag} exists and is not a run of this experiment; name another folder'
        ) from None
    for name, value in parameters.items():
        if found.get(name) != value:
            raise ParameterError(
                f'{bag} was recorded with {name} = {found.get(name)}, requested is {value}; name '
                'another folder'
            )
    if commanded != [_points(_trajectory(protocol))]:
        raise ParameterError(f'{bag} was recorded with another trajectory; name another folder')
    return True


def _points(trajectory: Any) -> list[tuple[Any, ...]]:
    return [
        (
            point.time_from_start.sec,
            point.time_from_start.nanosec,
            list(point.positions),
            list(point.effort),
        )
        for point in trajectory.points
    ]
