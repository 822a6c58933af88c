# SPDX-License-Identifier: Apache-2.0
"""Record, check and draw a steered insertion, and the same insertion with a guide at rest."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Final

from geometry_msgs.msg import PoseWithCovarianceStamped
from matplotlib.figure import Figure
from needle_dynamics import FloatArray
from needle_identification.bags.bag import read_topic
from needle_insertion.graph.lockstep import RunSample, WARM_UP
from needle_insertion.graph.messages import State
from needle_insertion.graph.ros_graph import Graph, GraphError
from needle_insertion.progress import Show
from needle_insertion.report.insertion import draw_needle, evenly
from needle_insertion.report.page import Animation
from needle_insertion.watch.recorded import ShownRecording
from needle_ros.base_node import COMMAND
from needle_ros.quantities import NORMAL
from needle_ros.status import SteeringPhase, SteeringStatus
from needle_ros.timing import NANOSECONDS, nanoseconds
import numpy as np
from reproduction.content import Check
from reproduction.insertions import bending
from reproduction.insertions.bending import read_needles, replay_check
from reproduction.insertions.insertion import RATE, SETTLING
from reproduction.insertions.simulated_run import SimulatedRun

#: Target of the tip, x, y, z [m], and insertion depth at the start [m].
TARGET: Final = (4e-3, 0.1, -2e-3)
START: Final = 5e-3

SPEED: Final = 0.02  #: Insertion speed [m/s].

#: Plant: tissue softer than the nominal model, bevel, random path deviation, EM tracker.
PLANT: Final[dict[str, object]] = {
    **bending.PLANT,
    'rate': RATE,
    'depth': START,
    'model.tissue_stiffness': 45e3,
    'steering.bevel_load': [0.15],
    'steering.path_noise': 1e-4,
}

#: Node `steering`: half the default measurement time of the tip, for a short demo.
STEERING: Final[dict[str, object]] = {
    'needle': bending.PRESET,
    'speed': SPEED,
    'guide_speed': 0.02,
    'settle_time': 0.05,
    'measurement_time': 0.25,
    'prior.noise': 6e-5,
}

#: Node `controller`.
CONTROLLER: Final[dict[str, object]] = {
    'needle': bending.PRESET,
    'rate': RATE,
    'deflection_feedback': 'none',
    'reference.speed': SPEED,
    'reference.acceleration': 0.5,
}

#: Largest miss of the steered needle [m]; without steering the miss is larger.
LARGEST_MISS: Final = 1e-3

#: Largest squared Mahalanobis distance of the tip from its estimate: quantile 0.999 of the
#: chi-squared distribution with two degrees of freedom.
_LARGEST: Final = 13.8

_FRAMES: Final = 80  #: Number of frames in the animation.

#: Timeout of the insertion, and of the answer to a target, in simulated time [s].
_LONGEST, _ANSWER = 180.0, 2.0


def record_aimed(
    bag: Path, logs: Path, show: Show, *, steered: bool, lockstep: bool = True
) -> None:
    """Insert a needle to the target with real nodes and record everything; steer it or not."""
    nodes: dict[str, Mapping[str, object]] = {'steering': STEERING} if steered else {}
    nodes['controller'] = {**CONTROLLER, 'steered': steered}
    nodes['plant'] = PLANT
    end = inf if steered else WARM_UP + (TARGET[1] - START) / SPEED + SETTLING
    with Graph(logs) as graph:
        run = SimulatedRun(graph, show, lockstep=lockstep)
        expected = graph.latest(run.node, PoseWithCovarianceStamped, 'tip_expected', COMMAND)

        def proceeds(sample: RunSample) -> bool:
            nonlocal end
            if end == inf and _is_done(run.states.get('steering'), sample.time):
                # Stamp of the last tip measurement; time since the first sample.
                last = nanoseconds(expected.message.header.stamp)
                end = sample.time - (sample.stamp - last) / NANOSECONDS + SETTLING
            return sample.time < end

        run.insert(bag, nodes, START, TARGET, proceeds)


def _is_done(state: State | None, time: float) -> bool:
    """Return whether `steering` has reached the target depth; raise `GraphError` on its errors."""
    phase, rejection = SteeringPhase.INACTIVE, ''
    status = None if state is None else state.report.status
    if isinstance(status, SteeringStatus):
        phase, rejection = status.phase, status.last_rejection
        if phase is SteeringPhase.STOPPED:
            raise GraphError(f'steering stopped: {status.fault}')
    if time > _LONGEST:
        raise GraphError(
            f'steering is not at the target depth after {_LONGEST:g} s: {phase.value}'
        )
    if phase is SteeringPhase.IDLE and time > WARM_UP + _ANSWER:
        raise GraphError(f'steering: {rejection}')
    return phase is SteeringPhase.DONE


@dataclass(frozen=True, eq=False)
class Aimed:
    """Final tip position of an insertion, and its estimate."""

    #: True and expected tip position, x and z, shape (2,) [m].
    tip: FloatArray
    expected: FloatArray
    covariance: FloatArray  #: Covariance of the expected position, shape (2, 2) [m^2].

    @property
    def miss(self) -> float:
        return float(np.hypot(*(self.tip - np.array(TARGET)[[0, 2]])))

    @property
    def interval_text(self) -> str:
        """Text of the expected tip position with its 95 % interval."""
        half = NORMAL * np.sqrt(np.diag(self.covariance))
        return ', '.join(
            f'{name} = {1e3 * at:.2f} ± {1e3 * wide:.2f} mm'
            for name, at, wide in zip('xz', self.expected, half, strict=True)
        )


def _tip(bag: Path) -> FloatArray:
    """Return the final tip position, x and z [m]."""
    *_, (_, last) = read_topic(bag, '/ground_truth')
    at = dict(zip(last.name, last.position, strict=True))
    return np.array([at['tip_x'], at['tip_z']])


def read_aimed(bag: Path) -> Aimed:
    """Read the final tip position and its estimate from the bag of a steered insertion."""
    *_, (_, last) = read_topic(bag, '/tip_expected')
    pose = last.pose
    at = np.array([pose.pose.position.x, pose.pose.position.z])
    whole = np.array(pose.covariance).reshape(6, 6)
    return Aimed(_tip(bag), at, whole[np.ix_((0, 2), (0, 2))])


def aiming_checks(bag: Path, other: Path) -> list[Check]:
    """Check both misses, the expected tip, and the replay; `other` is with a guide at rest."""
    found = read_aimed(bag)
    off = found.tip - found.expected
    contained = float(off @ np.linalg.solve(found.covariance, off)) <= _LARGEST
    alone = float(np.hypot(*(_tip(other) - np.array(TARGET)[[0, 2]])))
    x, z = 1e3 * found.tip
    return [
        Check(
            'distance of the tip from its target, steered',
            f'< {1e3 * LARGEST_MISS:g} mm',
            f'{1e3 * found.miss:.2f} mm',
            found.miss < LARGEST_MISS,
        ),
        Check(
            'distance of the tip from its target, guide at rest',
            f'> {1e3 * LARGEST_MISS:g} mm',
            f'{1e3 * alone:.2f} mm',
            alone > LARGEST_MISS,
        ),
        Check(
            'expected tip, steered',
            f'x = {x:.2f} mm, z = {z:.2f} mm',
            found.interval_text,
            contained,
        ),
        replay_check(bag, 'steered'),
    ]


def draw_aiming(bag: Path, other: Path) -> Figure:
    """Draw the steered needle and its target in both planes, and the needle of a guide at rest."""
    needles, path = read_needles(bag)
    (*_, last), _ = read_needles(other)
    return draw_needle(evenly(needles, bending.DRAWN), path, np.array(TARGET), last)


def animate_aiming(bag: Path) -> Animation:
    recording = ShownRecording(bag)
    times = np.linspace(0.0, recording.duration, _FRAMES).tolist()
    frames = [recording.view(time).frame(time) for time in times]
    return Animation(
        'The steered needle during the insertion, to scale: the needle rests at each measurement '
        'of its tip (ring), then the guide moves and the insertion continues. The bar at the '
        'target (cross) is the expected tip position at the target depth, with a 95 % interval.',
        recording.view(recording.duration).scene,
        [frame for frame in frames if frame['needle']],
    )
