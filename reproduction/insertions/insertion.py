# SPDX-License-Identifier: Apache-2.0
"""Record, read, check and draw a controlled insertion of the simulated needle."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from matplotlib.figure import Figure
from needle_dynamics import FloatArray
from needle_identification.bags.bag import read_topic
from needle_insertion.graph.lockstep import WARM_UP
from needle_insertion.graph.ros_graph import Graph
from needle_insertion.progress import Show
from needle_ros.timing import seconds
import numpy as np
from reproduction.content import Check
from reproduction.insertions.simulated_run import SimulatedRun
from trajectory_msgs.msg import JointTrajectory

#: Insertion depth at the start and at the end [m], speed [m/s], sample rate [Hz].
START_DEPTH, TARGET_DEPTH, SPEED, RATE = 0.02, 0.12, 0.010, 1000.0

START_DEFLECTION: Final = 5e-4  #: Tip deflection at the start [m], as in the paper's simulations.

#: Topics sampled at `RATE`, whose messages are counted.
COUNTED: Final = ('joint_states', 'base_wrench', 'tip_deflection', 'ground_truth')

SETTLING: Final = 1.6  #: Recorded time after the nominal arrival, for ramps and settling [s].


@dataclass(frozen=True, eq=False)
class RecordedInsertion:
    """Curves of a recorded insertion, shape (2, n): times since the target [s], and values."""

    law: str
    #: Insertion depth and its reference [m].
    depth: FloatArray
    reference: FloatArray
    tip: FloatArray  #: Tip deflection [m].
    force: FloatArray  #: Commanded force [N].
    #: Recorded over expected number of messages, by topic of `COUNTED`.
    completeness: dict[str, float]


def record_insertion(
    law: str,
    bag: Path,
    logs: Path,
    show: Show,
    plant: Mapping[str, object] | None = None,
    motion: JointTrajectory | None = None,
    *,
    lockstep: bool = True,
) -> None:
    """
    Insert the simulated needle to the target under a control law and record everything.

    `plant` holds parameters of the plant, of which ``model.*`` also go to the controller; default
    is the needle of the paper, bent at the start. `motion` moves the guide of a steered needle
    from the time of the target on. Raises `GraphError` if a node fails.
    """
    given = {'tip_deflection': START_DEFLECTION} if plant is None else plant
    model = {name: value for name, value in given.items() if name.startswith('model.')}
    nodes = {
        'controller': {'law': law, 'rate': RATE, 'reference.speed': SPEED, **model},
        'plant': {'depth': START_DEPTH, 'rate': RATE, **given},
    }
    end = WARM_UP + (TARGET_DEPTH - START_DEPTH) / SPEED + SETTLING
    with Graph(logs) as graph:
        SimulatedRun(graph, show, lockstep=lockstep).insert(
            bag,
            nodes,
            START_DEPTH,
            (0.0, TARGET_DEPTH, 0.0),
            lambda sample: sample.time < end,
            motion,
        )


def read_insertion(law: str, bag: Path) -> RecordedInsertion:

    def series(topic: str, value: Callable[[Any], float]) -> FloatArray:
        pairs = [(seconds(m.header.stamp), value(m)) for _, m in read_topic(bag, f'/{topic}')]
        return np.array(pairs).T

    curves = {
        'depth': series('joint_states', lambda m: m.position[0]),
        'reference': series('reference', lambda m: m.position[0]),
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
    return RecordedInsertion(law=law, completeness=completeness, **curves)


def insertion_checks(run: RecordedInsertion) -> list[Check]:
    """Check final depth, overshoot, tracking error and number of messages of an insertion."""
    law = run.law.replace('_', ' ')
    end, over = run.depth[1, -1] - TARGET_DEPTH, run.depth[1].max() - TARGET_DEPTH
    reference = np.interp(run.depth[0], *run.reference)
    worst = np.abs(run.depth[1] - reference)[run.depth[0] > 0.0].max()
    topic, part = min(run.completeness.items(), key=lambda item: -abs(item[1] - 1.0))
    return [
        Check(
            f'depth at the end, {law}',
            f'{TARGET_DEPTH * 1e3:g} mm ± 0.5 mm',
            # The encoder counts micrometers.
            f'{run.depth[1, -1] * 1e3:.3f} mm',
            abs(end) < 5e-4,
        ),
        Check(f'overshoot, {law}', '< 1 mm', f'{max(over, 0.0) * 1e3:.3f} mm', over < 1e-3),
        Check(f'largest tracking error, {law}', '< 1 mm', f'{worst * 1e3:.3f} mm', worst < 1e-3),
        Check(
            f'messages in the bag, {law}',
            f'{RATE:g} Hz x duration ± 0.5 %',
            f'{part:.1%} (worst: {topic})',
            abs(part - 1.0) <= 0.005,
        ),
    ]


def draw_insertions(runs: Sequence[RecordedInsertion]) -> Figure:
    """Draw depth, tracking error, force and tip deflection for two control laws."""
    figure = Figure(figsize=(9.0, 9.0), layout='constrained')
    axes = figure.subplots(4, 1)
    labels = ('insertion depth [mm]', 'tracking error [mm]', 'force [N]', 'tip deflection [mm]')
    for axis, label in zip(axes, labels, strict=True):
        axis.set_ylabel(label)
        axis.set_xlabel('time since the target was sent [s]')
        axis.grid(visible=True, alpha=0.3)
    time, reference = runs[0].reference
    axes[0].plot(time, reference * 1e3, 'k--', label='reference', zorder=3)
    # A broad first line stays visible below an equal second line.
    for run, width in zip(runs, (3.0, 1.2), strict=True):
        time, reference = run.reference
        depth = np.interp(time, *run.depth)
        law = {'label': run.law.replace('_', ' '), 'linewidth': width}
        axes[0].plot(run.depth[0], run.depth[1] * 1e3, **law)
        axes[1].plot(time, (reference - depth) * 1e3, **law)
        axes[2].plot(run.force[0], run.force[1], **law)
        axes[3].plot((run.tip[0] - run.tip[0, 0]) * 1e3, run.tip[1] * 1e3, **law)
    for axis in axes[:3]:
        axis.set_xlim(-0.2, runs[0].depth[0, -1])
    axes[3].set_xlim(0.0, 60.0)
    axes[3].set_xlabel('time since the start of the plant [ms]')
    axes[0].legend()
    return figure
