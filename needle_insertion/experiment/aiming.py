"""An insertion that is steered to a target beside the same one with a guide at rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Final

from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
from matplotlib.figure import Figure
from needle_controller.steering.outer_loop import Phase
from needle_dynamics import FloatArray
from needle_identification import read_topic
from needle_insertion.experiment.bending import read_needles
from needle_insertion.experiment.insertion import RATE, SETTLING, target_message, WARM_UP
from needle_insertion.experiment.node_process import GraphError
from needle_insertion.experiment.progress import Show
from needle_insertion.experiment.ros_graph import Graph
from needle_insertion.experiment.simulated_run import Sample, SimulatedRun
from needle_insertion.replay.rerun import verify
from needle_insertion.report.animation import Animation
from needle_insertion.report.insertion import draw_needle
from needle_insertion.report.text import Check
from needle_insertion.watch.recorded import Recording
from needle_ros.base_node import COMMAND
from needle_ros.timing import NANOSECONDS, nanoseconds
import numpy as np

#: Where the tip shall go, x, y, z [m], and inserted length at the start [m].
TARGET: Final = (4e-3, 0.1, -2e-3)
START: Final = 5e-3

#: Insertion speed [m/s].
SPEED: Final = 0.02

#: What is believed: needle and tissue.
PRESET: Final = {'model.preset': 'bending_35mm'}

#: The plant: softer tissue than believed, a bevel, a path that strays, an EM tracker.
PLANT: Final[dict[str, object]] = {
    **PRESET,
    'steered': True,
    'rate': RATE,
    'depth': START,
    'model.tissue_stiffness': 45e3,
    'steering.bevel_load': [0.15],
    'steering.cutting_force': [1.0],
    'steering.path_noise': 1e-4,
    'tip.rate': 40.0,
    'tip.noise': 1.8e-4,
    'tip.delay': 0.02,
}

#: The node that steers: half a look of the default, so that the demo is short.
STEERING: Final[dict[str, object]] = {
    **PRESET,
    'speed': SPEED,
    'guide_speed': 0.02,
    'settle_time': 0.05,
    'look_time': 0.25,
    'belief.noise': 6e-5,
}

#: The axis law.
CONTROLLER: Final[dict[str, object]] = {
    **PRESET,
    'rate': RATE,
    'deflection_feedback': 'none',
    'reference.speed': SPEED,
    'reference.acceleration': 0.5,
}

#: A steered needle ends within this of its target [m]; one that nobody steers does not.
LARGEST_MISS: Final = 1e-3

#: Largest squared distance of the tip from where it is said to be, in standard deviations: by
#: chance one in a thousand is farther.
_LARGEST: Final = 13.8

#: Needles that are drawn, and frames of the needle that moves.
_DRAWN: Final = 5
_FRAMES: Final = 80

#: Longest simulated time of the insertion, and of the answer to a target [s].
_LONGEST, _ANSWER = 180.0, 2.0

#: Half of an interval of 95 % over the standard deviation.
_NORMAL: Final = 1.96


def record_aimed(
    bag: Path, logs: Path, show: Show, *, steered: bool, lockstep: bool = True
) -> None:
    """
    Insert a needle to the target through real nodes, and record everything.

    Parameters
    ----------
    bag : Path
        Bag to write.
    logs : Path
        Folder for what the nodes print.
    show : callable
        Shows the progress.
    steered : bool
        Whether the node `steering` aims the tip; else the guide rests.
    lockstep : bool
        As for `SimulatedRun`.

    Raises
    ------
    GraphError
        If a node fails, stops, or the target is not reached in time.

    """
    with Graph(logs) as graph:
        run = SimulatedRun(graph, show, lockstep=lockstep)
        aim = run.publisher(PointStamped, 'target')
        expected = graph.latest(run.node, PoseWithCovarianceStamped, 'tip_expected', COMMAND)
        waiting = True
        end = inf if steered else WARM_UP + (TARGET[1] - START) / SPEED + SETTLING

        def act(sample: Sample) -> bool:
            nonlocal waiting, end
            if waiting and sample.time >= WARM_UP:
                waiting = False
                aim(target_message(sample.stamp, TARGET))
            if steered and end == inf and _is_done(run.values.get('steering', {}), sample.time):
                # The stamp of the last look; the time since the first sample.
                last = nanoseconds(expected.message.header.stamp)
                end = sample.time - (sample.stamp - last) / NANOSECONDS + SETTLING
            done = (sample.depth - START) / (TARGET[1] - START)
            show('inserting', min(max(done, 0.0), 1.0))
            return sample.time < end

        nodes: dict[str, Mapping[str, object]] = {'steering': STEERING} if steered else {}
        nodes['controller'] = {**CONTROLLER, 'steered': steered}
        nodes['plant'] = PLANT
        run.record(bag, nodes, act)


def _is_done(values: Mapping[str, str], time: float) -> bool:
    """Return whether the node `steering` reports the target depth, or raise what it reports."""
    phase = values.get('phase')
    if phase == Phase.STOPPED.value:
        raise GraphError(f'steering {values[""]}')
    if time > _LONGEST:
        raise GraphError(f'steering is not at the target depth after {_LONGEST:g} s: {phase}')
    if phase == Phase.IDLE.value and time > WARM_UP + _ANSWER:
        raise GraphError(f'steering: {values["last complaint"]}')
    return phase == Phase.DONE.value


@dataclass(frozen=True, eq=False)
class Aimed:
    """
    How an insertion ended.

    Attributes
    ----------
    tip : ndarray, shape (2,)
        Where the tip is, x and z [m].
    expected : ndarray, shape (2,)
        Where it is said to be [m].
    covariance : ndarray, shape (2, 2)
        Covariance of that [m^2].

    """

    tip: FloatArray
    expected: FloatArray
    covariance: FloatArray

    @property
    def miss(self) -> float:
        """Distance of the tip from the target [m]."""
        return float(np.hypot(*(self.tip - np.array(TARGET)[[0, 2]])))

    @property
    def said(self) -> str:
        """Where the tip is said to be, with an interval of 95 %."""
        half = _NORMAL * np.sqrt(np.diag(self.covariance))
        return ', '.join(
            f'{name} = {1e3 * at:.2f} ± {1e3 * wide:.2f} mm'
            for name, at, wide in zip('xz', self.expected, half, strict=True)
        )


def _tip(bag: Path) -> FloatArray:
    """Return where the tip was at the end, x and z [m]."""
    *_, (_, last) = read_topic(bag, '/ground_truth')
    at = dict(zip(last.name, last.position, strict=True))
    return np.array([at['tip_x'], at['tip_z']])


def read_aimed(bag: Path) -> Aimed:
    """
    Read how a steered insertion ended.

    Parameters
    ----------
    bag : Path
        The bag.

    Returns
    -------
    Aimed
        Tip, and what was said of it.

    Raises
    ------
    RecordingError
        If the bag is not readable or lacks a topic.

    """
    *_, (_, last) = read_topic(bag, '/tip_expected')
    pose = last.pose
    at = np.array([pose.pose.position.x, pose.pose.position.z])
    whole = np.array(pose.covariance).reshape(6, 6)
    return Aimed(_tip(bag), at, whole[np.ix_((0, 2), (0, 2))])


def aiming_checks(bag: Path, other: Path) -> list[Check]:
    """
    Check that the needle hits, that what is said of it holds, and that its run can be repeated.

    Parameters
    ----------
    bag, other : Path
        Bags of the steered insertion, and of that with a guide at rest.

    Returns
    -------
    list of Check
        One for each.

    Raises
    ------
    NeedleError
        If a bag cannot be used.

    """
    found = read_aimed(bag)
    off = found.tip - found.expected
    held = float(off @ np.linalg.solve(found.covariance, off)) <= _LARGEST
    alone = float(np.hypot(*(_tip(other) - np.array(TARGET)[[0, 2]])))
    (run,) = verify(bag)
    x, z = 1e3 * found.tip
    return [
        Check(
            'tip from its target, steered',
            f'< {1e3 * LARGEST_MISS:g} mm',
            f'{1e3 * found.miss:.2f} mm',
            found.miss < LARGEST_MISS,
        ),
        Check(
            'tip from its target, guide at rest',
            f'> {1e3 * LARGEST_MISS:g} mm',
            f'{1e3 * alone:.2f} mm',
            alone > LARGEST_MISS,
        ),
        Check(
            'what is said of the tip, steered', f'x = {x:.2f} mm, z = {z:.2f} mm', found.said, held
        ),
        Check(
            'computed again from its bag, steered',
            'identical or within tolerance',
            run.verdict,
            run.verdict != 'differs',
        ),
    ]


def draw_aiming(bag: Path, other: Path) -> Figure:
    """
    Draw the steered needle on its way, its target, and the needle of a guide at rest.

    Parameters
    ----------
    bag, other
        As for `aiming_checks`.

    Returns
    -------
    Figure
        Both planes, to scale.

    """
    needles, path = read_needles(bag)
    at = np.linspace(0, len(needles) - 1, _DRAWN).round().astype(int).tolist()
    return draw_needle(
        [needles[k] for k in at], path, np.array(TARGET), read_needles(other)[0][-1]
    )


def animate_aiming(bag: Path) -> Animation:
    """
    Return the steered needle on its way, to play on a page.

    Parameters
    ----------
    bag : Path
        Bag of the steered insertion.

    Returns
    -------
    Animation
        It has some 80 frames.

    """
    recording = Recording(bag)
    times = np.linspace(0.0, recording.duration, _FRAMES).tolist()
    frames = [recording.view(time).frame(time) for time in times]
    return Animation(
        'The steered needle on its way, to scale: it rests at each look at its tip (ring), then '
        'the guide moves and the needle goes in. The bar at the target (cross) is where the tip '
        'is expected there, with an interval of 95 %.',
        recording.view(recording.duration).scene,
        [frame for frame in frames if frame['needle']],
    )
