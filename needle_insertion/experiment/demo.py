"""The main job: insertion under control; friction and stiffness identified; one report."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
import shutil
import sys
from typing import Any

from geometry_msgs.msg import PointStamped
from matplotlib.figure import Figure
from needle_dynamics import FloatArray, NeedleError
from needle_identification import (
    FrictionEstimate,
    identify_friction,
    identify_stiffness,
    IndentationRecording,
    ParameterEstimate,
    read_friction_recording,
    read_indentation_recording,
    read_topic,
    Recording,
    StiffnessEstimate,
    summarize,
    summarize_stiffness,
    write_result,
)
from needle_insertion.commands.reproduce import count_held, fewest, friction_truth, stiffness_truth
from needle_insertion.experiment.campaign import Campaign
from needle_insertion.experiment.protocol import PROTOCOLS
from needle_insertion.experiment.record import rig
from needle_insertion.experiment.ros_graph import ACTIVATE, CONFIGURE, Graph
from needle_insertion.paper.tables import TABLE_1, TABLE_2
from needle_insertion.report.page import Check, check_table, Picture, write_page
from needle_ros.base_node import COMMAND, SENSOR
from needle_ros.timing import seconds
import numpy as np
from rclpy.duration import Duration
from sensor_msgs.msg import JointState
from tqdm import tqdm

#: The insertion of the demo [m], [m/s], [Hz].
START_DEPTH, TARGET_DEPTH, SPEED, RATE = 0.02, 0.12, 0.010, 1000.0

#: Deflection of the tip at the start [m], as in the simulations of the source.
START_DEFLECTION = 5e-4

#: Topics sampled at `RATE`, whose messages are counted.
COUNTED = ('joint_states', 'base_wrench', 'tip_deflection', 'ground_truth')

#: Times real time at which the experiments are recorded.
EXPERIMENT_SPEED = 25.0

#: A fresh estimate must be within this many 95 % intervals of the truth at every force: with new
#: noise one of the 22 would miss it once in some twenty runs, but the noise is always the same.
LARGEST_DISTANCE = 2.0

_MARKER = '.needle-demo'


class DemoError(NeedleError):
    """The demo cannot run here."""


@dataclass(frozen=True, eq=False)
class Insertion:
    """
    One recorded insertion.

    Attributes
    ----------
    law : str
        Name of the control law.
    depth, aim, tip, force : ndarray, shape (2, n)
        Times from the target [s], and inserted length [m], its reference [m], deflection
        of the tip [m] and commanded force [N] at these times.
    completeness : dict
        Messages in the bag over messages due, by topic of `COUNTED`.

    """

    law: str
    depth: FloatArray
    aim: FloatArray
    tip: FloatArray
    force: FloatArray
    completeness: dict[str, float]


def run(output: Path, bags: Path) -> int:
    """
    Run the demo.

    Parameters
    ----------
    output : Path
        Folder for bags, logs, pictures and report; what an earlier demo left there is replaced.
    bags : Path
        Folder of the shipped recordings.

    Returns
    -------
    int
        0 if every check passed, else 1.

    """
    shipped = {name: _shipped(bags, name) for name in PROTOCOLS}
    _clear(output)
    insertions = []
    for law in ('inverse_dynamics', 'pid'):
        with _progress(f'insertion, {law}') as show:
            record_insertion(law, output / law, output / 'logs' / law, show)
        insertions.append(read_insertion(law, output / law))
    for name, protocol in PROTOCOLS.items():
        # The same noise at each run: the verdict does not depend on luck.
        ((_, parameters),) = (
            Campaign(protocol=protocol, repeats=1, seed=1, fixed=True).runs().items()
        )
        with _progress(f'{name} experiment') as show, rig(output, protocol) as stand:
            stand.record(output / name, parameters, EXPERIMENT_SPEED, show)

    with tqdm(
        total=sum(map(len, shipped.values())) + 2, desc='identification', disable=None
    ) as bar:
        friction, stiffness = [], []
        for bag in (*shipped['friction'], output / 'friction'):
            recording = read_friction_recording(bag)
            friction.append((recording, identify_friction(recording)))
            bar.update()
        for bag in (*shipped['stiffness'], output / 'stiffness'):
            indentation = read_indentation_recording(bag)
            stiffness.append((indentation, identify_stiffness(indentation)))
            bar.update()
    write_result(
        output / 'result.yaml',
        summarize([estimate for _, estimate in friction[:-1]]),
        summarize_stiffness([estimate for _, estimate in stiffness[:-1]]),
    )

    checks = [check for insertion in insertions for check in insertion_checks(insertion)]
    for comparisons, kind, count in (
        (friction_comparisons, friction, len(shipped['friction'])),
        (stiffness_comparisons, stiffness, len(shipped['stiffness'])),
    ):
        checks += shipped_checks(
            f'{count} shipped bags', [comparisons(*pair) for pair in kind[:-1]]
        )
        checks += fresh_checks(comparisons(*kind[-1]))

    pictures = [
        Picture(
            'insertion',
            'Insertion under both controllers. Below, the tip rings down from '
            f'{START_DEFLECTION * 1e3:g} mm at 2 kHz, seen by a sensor that averages over 1 ms.',
            insertion_figure(insertions),
        ),
        Picture(
            'friction',
            'Friction, fresh recording: the force over time, and over speed with the fit of (15) '
            'to steady motion.',
            friction_figure(friction[-1][1]),
        ),
        Picture(
            'stiffness',
            'Stiffness, fresh recording: where each press moved the end-effector and the fitted '
            'matrix puts it, and the entries of the matrix by force, with 95 % intervals, beside '
            'the truth (lines).',
            stiffness_figure(*stiffness[-1]),
        ),
    ]
    write_page(
        output / 'report.html',
        'Needle insertion: demo',
        f'Nodes over DDS at {RATE:g} Hz: insertion from {START_DEPTH * 100:g} cm to '
        f'{TARGET_DEPTH * 100:g} cm at {SPEED * 1000:g} mm/s under each controller, recorded to '
        'MCAP; friction and tissue stiffness identified from the shipped recordings and from a '
        f'fresh one each, recorded at {EXPERIMENT_SPEED:g} times real time.',
        checks,
        pictures,
    )
    sys.stdout.write(f'{check_table(checks)}\n\nreport: {output / "report.html"}\n')
    return 0 if all(check.passed for check in checks) else 1


def _shipped(bags: Path, name: str) -> list[Path]:
    found = sorted(path for path in bags.glob(f'{name}_*') if path.is_dir())
    if not found:
        raise DemoError(
            f'{bags} holds no {name} recordings ({name}_*); run from a clone or give --bags'
        )
    return found


def _clear(output: Path) -> None:
    """Remove what an earlier demo left, and nothing else."""
    if output.exists():
        if not (output / _MARKER).is_file():
            raise DemoError(f'{output} exists and is not from a demo; name another folder')
        shutil.rmtree(output)
    output.mkdir(parents=True)
    (output / _MARKER).touch()


@contextmanager
def _progress(what: str) -> Iterator[Callable[[float], None]]:
    """Show a bar that takes the fraction done; silent when not on a terminal."""
    with tqdm(total=100, desc=what, disable=None, bar_format='{desc:28}{bar}{n:4.0f} %') as bar:
        yield lambda fraction: bar.update(100.0 * fraction - bar.n)


def record_insertion(law: str, bag: Path, logs: Path, progress: Callable[[float], None]) -> None:
    """
    Drive the simulated needle to the target under a law and record everything.

    Parameters
    ----------
    law : str
        Name of the control law.
    bag : Path
        Bag to write.
    logs : Path
        Folder for what the nodes print.
    progress : callable
        Called with the fraction done.

    Raises
    ------
    GraphError
        If a node fails or the target is not reached in time.

    """
    with Graph(logs) as graph:
        node = graph.node('demo')
        state = graph.latest(node, JointState, 'joint_states', SENSOR)
        aim = graph.latest(node, JointState, 'reference', SENSOR)
        target = node.create_publisher(PointStamped, 'target', COMMAND)
        recorder = graph.start('recorder', {'path': str(bag)})
        controller = graph.start(
            'controller', {'law': law, 'rate': RATE, 'reference.speed': SPEED}
        )
        start = {'depth': START_DEPTH, 'tip_deflection': START_DEFLECTION, 'rate': RATE}
        plant = graph.start('plant', {'autostart': False, **start})
        # The plant begins when the recorder listens to all: the bag holds every sample.
        listeners = {'target': 2, 'wrench_command': 2, 'reference': 2, 'joint_states': 3}
        graph.spin_until(
            lambda: all(
                node.count_subscribers(name) >= listeners.get(name, 1)
                for name in (*listeners, *COUNTED)
            ),
            'the nodes',
        )
        graph.change(node, 'plant', CONFIGURE, ACTIVATE)
        graph.spin_until(lambda: aim.message and state.message, 'plant and controller')
        message = PointStamped()
        message.header.frame_id = 'needle_entry'
        message.header.stamp = node.get_clock().now().to_msg()
        message.point.y = TARGET_DEPTH
        target.publish(message)

        def arrived() -> bool:
            done = (state.message.position[0] - START_DEPTH) / (TARGET_DEPTH - START_DEPTH)
            progress(min(max(done, 0.0), 1.0))
            return bool(aim.message and aim.message.position[0] == TARGET_DEPTH)

        duration = (TARGET_DEPTH - START_DEPTH) / SPEED
        graph.spin_until(arrived, 'the end of the insertion', timeout=duration + 30.0)
        # The loop settles within a second; the record shows that it stays there.
        end = node.get_clock().now() + Duration(seconds=1.5)
        graph.spin_until(lambda: node.get_clock().now() > end, 'the end of the recording')
        recorder.interrupt()
        controller.interrupt()
        plant.interrupt()


def read_insertion(law: str, bag: Path) -> Insertion:
    """
    Read what `record_insertion` recorded.

    Parameters
    ----------
    law : str
        Name of the control law.
    bag : Path
        The bag.

    Returns
    -------
    Insertion
        Arrays on times from the target.

    Raises
    ------
    RecordingError
        If the bag is not readable or lacks a topic.

    """

    def series(topic: str, value: Callable[[Any], float]) -> FloatArray:
        pairs = [(seconds(m.header.stamp), value(m)) for _, m in read_topic(bag, f'/{topic}')]
        return np.array(pairs).T

    curves = {
        'depth': series('joint_states', lambda m: m.position[0]),
        'aim': series('reference', lambda m: m.position[0]),
        'tip': series('tip_deflection', lambda m: m.point.z),
        'force': series('wrench_command', lambda m: m.wrench.force.y),
    }
    completeness = {}
    for topic in COUNTED:
        stamps = series(topic, lambda _m: 0.0)[0]
        completeness[topic] = len(stamps) / ((stamps[-1] - stamps[0]) * RATE + 1.0)
    target = series('target', lambda m: m.point.y)[0, 0]
    for curve in curves.values():
        curve[0] -= target
    return Insertion(law=law, completeness=completeness, **curves)


def insertion_checks(run: Insertion) -> list[Check]:
    """Return what an insertion must have done."""
    law = run.law.replace('_', ' ')
    end, over = run.depth[1, -1] - TARGET_DEPTH, run.depth[1].max() - TARGET_DEPTH
    aim = np.interp(run.depth[0], run.aim[0], run.aim[1])
    worst = np.abs(run.depth[1] - aim)[run.depth[0] > 0.0].max()
    topic, part = min(run.completeness.items(), key=lambda item: -abs(item[1] - 1.0))
    return [
        Check(
            f'depth at the end, {law}',
            f'{TARGET_DEPTH * 1e3:g} mm ± 0.5 mm',
            f'{run.depth[1, -1] * 1e3:.4f} mm',
            abs(end) < 5e-4,
        ),
        Check(f'overshoot, {law}', '< 1 mm', f'{max(over, 0.0) * 1e3:.4f} mm', over < 1e-3),
        Check(f'largest tracking error, {law}', '< 1 mm', f'{worst * 1e3:.4f} mm', worst < 1e-3),
        Check(
            f'messages in the bag, {law}',
            f'{RATE:g} Hz x duration ± 0.5 %',
            f'{part:.3%} (worst: {topic})',
            abs(part - 1.0) <= 0.005,
        ),
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """An estimate beside the true value of the stand-in that was recorded."""

    estimate: ParameterEstimate
    truth: float
    force: float | None = None


def friction_comparisons(recording: Recording, estimate: FrictionEstimate) -> list[Comparison]:
    """Return friction beside that of the recorded plant."""
    return [
        Comparison(
            estimate=estimate[name], truth=_known(recording, friction_truth(recording.truth, name))
        )
        for name in TABLE_1
    ]


def stiffness_comparisons(
    recording: IndentationRecording, estimate: StiffnessEstimate
) -> list[Comparison]:
    """Return the stiffness at each force beside that of the recorded stand-in."""
    return [
        Comparison(
            estimate=level[entry],
            truth=_known(recording, stiffness_truth(recording.truth, entry, level.force)),
            force=level.force,
        )
        for entry in TABLE_2
        for level in estimate.levels
    ]


def _known(recording: Recording | IndentationRecording, truth: float | None) -> float:
    if truth is None:
        raise DemoError(f'{recording.name} does not hold the configuration of its plant')
    return truth


def _by_symbol(comparisons: Sequence[Comparison]) -> Mapping[str, list[Comparison]]:
    groups: dict[str, list[Comparison]] = {}
    for one in comparisons:
        groups.setdefault(one.estimate.symbol, []).append(one)
    return groups


def shipped_checks(source: str, bags: Sequence[Sequence[Comparison]]) -> list[Check]:
    """Judge by how many of the 95 % intervals hold the true value of their own bag."""
    checks = []
    for symbol, group in _by_symbol([one for bag in bags for one in bag]).items():
        held, known = count_held([c.estimate for c in group], [c.truth for c in group])
        checks.append(
            Check(
                f'{symbol}, {source}',
                f'in 95 % of the intervals (>= {fewest(known)} of {known})',
                f'in {held} of {known}',
                held >= fewest(known),
            )
        )
    return checks


def fresh_checks(comparisons: Sequence[Comparison]) -> list[Check]:
    """Judge by the distance from the truth in 95 % intervals, at the worst force."""
    checks = []
    for symbol, group in _by_symbol(comparisons).items():
        worst = max(group, key=_distance)
        found, where = worst.estimate, '' if worst.force is None else f' at {worst.force:.2g} N'
        checks.append(
            Check(
                f'{symbol}{where}, fresh recording',
                f'{worst.truth:.5g} {found.unit} within {LARGEST_DISTANCE:g} x 95 %',
                f'{found.value:.5g} ± {_reach(found):.2g} (95 %)',
                _distance(worst) <= LARGEST_DISTANCE,
            )
        )
    return checks


def _reach(found: ParameterEstimate) -> float:
    return (found.interval[1] - found.interval[0]) / 2.0


def _distance(one: Comparison) -> float:
    """Return how many half intervals an estimate is from the truth."""
    if not one.estimate.determined:
        return float('inf')
    return abs(one.estimate.value - one.truth) / _reach(one.estimate)


def insertion_figure(runs: Sequence[Insertion]) -> Figure:
    """Draw depth, tracking error, force, and the tip deflection from the first sample."""
    figure = Figure(figsize=(9.0, 9.0), layout='constrained')
    axes = figure.subplots(4, 1)
    labels = ('inserted length [mm]', 'tracking error [mm]', 'force [N]', 'tip deflection [mm]')
    for axis, label in zip(axes, labels, strict=True):
        axis.set_ylabel(label)
        axis.set_xlabel('time from the target [s]')
        axis.grid(visible=True, alpha=0.3)
    axes[0].plot(runs[0].aim[0], runs[0].aim[1] * 1e3, 'k--', label='reference', zorder=3)
    for run in runs:
        name = run.law.replace('_', ' ')
        depth = np.interp(run.aim[0], *run.depth)
        axes[0].plot(run.depth[0], run.depth[1] * 1e3, label=name)
        axes[1].plot(run.aim[0], (run.aim[1] - depth) * 1e3)
        axes[2].plot(run.force[0], run.force[1])
        axes[3].plot((run.tip[0] - run.tip[0, 0]) * 1e3, run.tip[1] * 1e3)
    for axis in axes[:3]:
        axis.set_xlim(-0.2, runs[0].depth[0, -1])
    axes[3].set_xlim(0.0, 60.0)
    axes[3].set_xlabel('time from the start of the plant [ms]')
    axes[0].legend()
    return figure


def friction_figure(estimate: FrictionEstimate) -> Figure:
    """Draw the filtered force over time, and over speed with the fit."""
    fit = estimate.fit
    figure = Figure(figsize=(9.0, 6.5), layout='constrained')
    above, below = figure.subplots(2, 1)
    above.plot(fit.time - fit.time[0], fit.force, linewidth=0.8)
    above.set_xlabel('time [s]')
    below.plot(
        fit.speed[fit.used] * 1e3, fit.force[fit.used], '.', markersize=2.0, label='samples'
    )
    for sign, label in ((-1.0, 'fit of (15)'), (1.0, None)):
        side = np.flatnonzero(fit.used & (np.sign(fit.speed) == sign))
        order = side[np.argsort(fit.speed[side])]
        below.plot(fit.speed[order] * 1e3, fit.model[order], 'C1', label=label)
    below.set_xlabel('insertion speed [mm/s]')
    below.legend()
    for axis in (above, below):
        axis.set_ylabel('base force [N]')
        axis.grid(visible=True, alpha=0.3)
    return figure


def stiffness_figure(recording: IndentationRecording, estimate: StiffnessEstimate) -> Figure:
    """Draw the presses with the fit, and the entries of the matrix by force with the truth."""
    figure = Figure(figsize=(9.0, 4.8), layout='constrained')
    plane, entries = figure.subplots(1, 2)
    presses = estimate.presses
    for k, level in enumerate(estimate.levels):
        at = presses.level == k
        fitted = np.linalg.solve(level.matrix, presses.force[at].T).T
        order = np.argsort(np.arctan2(fitted[:, 1], fitted[:, 0]))
        loop = 1e3 * fitted[np.append(order, order[0])]
        plane.plot(*loop.T, f'C{k}', linewidth=0.8)
        plane.plot(
            *(1e3 * presses.displacement[at].T),
            f'C{k}o',
            markersize=4.0,
            label=f'{level.force:.2g} N',
        )
    plane.set(xlabel='x [mm]', ylabel='z [mm]', aspect='equal')
    plane.legend(title='force', loc='center left', bbox_to_anchor=(1.0, 0.5))
    forces = [level.force for level in estimate.levels]
    for k, entry in enumerate(TABLE_2):
        found = [level[entry] for level in estimate.levels]
        reach = [_reach(one) for one in found]
        truth = [stiffness_truth(recording.truth, entry, force) for force in forces]
        entries.errorbar(
            forces, [one.value for one in found], reach, fmt='o', color=f'C{k}', capsize=3.0,
            markersize=4.0, label=entry,
        )  # fmt: skip
        entries.plot(forces, truth, f'C{k}', linewidth=0.8)
    entries.set(xlabel='force [N]', ylabel='stiffness [N/m]')
    entries.legend()
    for axis in (plane, entries):
        axis.grid(visible=True, alpha=0.3)
    return figure
