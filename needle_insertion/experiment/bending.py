"""An insertion of a needle that bends: guide and roll move, and what it recorded is judged."""

from __future__ import annotations

from math import pi
from pathlib import Path
from typing import Any, Final

from builtin_interfaces.msg import Duration
from matplotlib.figure import Figure
from needle_dynamics import bending_length, FloatArray
from needle_dynamics.steering.parameters import NEEDLES
from needle_identification import (
    identify_steering,
    read_steering_recording,
    read_topic,
    SteeringSettings,
)
from needle_insertion.experiment.insertion import record_insertion
from needle_insertion.experiment.progress import Show
from needle_insertion.replay.rerun import verify
from needle_insertion.report.insertion import draw_needle
from needle_insertion.report.text import Check
from needle_ros.errors import NeedleError
import numpy as np
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

#: Needle and tissue, and its plant: a bevel that bends it, and a tracker in the tip.
PRESET: Final = 'bending_35mm'
PLANT: Final[dict[str, object]] = {
    'model.preset': PRESET,
    'steered': True,
    'steering.bevel_load': [0.6],
    'steering.cutting_force': [1.0],
    'tip.rate': 40.0,
    'tip.noise': 1.8e-4,
    'tip.delay': 0.02,
}

#: Joints that move, times [s], and where they then are [m, rad]: the guide goes aside early, and
#: the needle is turned half way.
JOINTS: Final = ('guide_x', 'roll')
COURSE: Final = ((1, (4e-3, 0.0)), (5, (4e-3, 0.0)), (6, (4e-3, pi)))

#: A needle that bends has its tip this far off the axis at least [m].
LEAST_DEFLECTION: Final = 2e-3

#: Largest distance of the bending length from the truth, in 95 % intervals.
LARGEST_DISTANCE: Final = 2.0

#: Needles that are drawn.
_DRAWN: Final = 5


def record_bending(bag: Path, logs: Path, show: Show, *, lockstep: bool = True) -> None:
    """
    Drive a steered needle to the target, with a guide that moves, and record everything.

    Parameters
    ----------
    bag : Path
        Bag to write.
    logs : Path
        Folder for what the nodes print.
    show : callable
        Shows the progress.
    lockstep : bool
        As for `SimulatedRun`.

    Raises
    ------
    GraphError
        If a node fails.

    """
    course = JointTrajectory(
        joint_names=list(JOINTS),
        points=[
            JointTrajectoryPoint(positions=list(at), time_from_start=Duration(sec=time))
            for time, at in COURSE
        ],
    )
    record_insertion('adaptive', bag, logs, show, PLANT, course, lockstep=lockstep)


def bending_checks(bag: Path) -> list[Check]:
    """
    Check that the needle bends, that its run can be computed again, and what is identified.

    Parameters
    ----------
    bag : Path
        The bag.

    Returns
    -------
    list of Check
        One for each.

    Raises
    ------
    NeedleError
        If the bag cannot be used.

    """
    needle = NEEDLES[PRESET]
    truth = bending_length(needle.bending_stiffness, needle.tissue_stiffness)
    (tip, _) = read_needles(bag)
    aside = float(np.hypot(tip[-1][-1, 0], tip[-1][-1, 2]))
    (run,) = verify(bag)
    found = identify_steering(
        [read_steering_recording(bag)], SteeringSettings(terms=('bevel',), order='together')
    )
    length = found.media[0]['bending_length']
    low, high = length.interval
    half = 0.5 * (high - low)
    return [
        Check(
            'tip off the axis, bent needle',
            f'> {1e3 * LEAST_DEFLECTION:g} mm',
            f'{1e3 * aside:.2f} mm',
            aside > LEAST_DEFLECTION,
        ),
        Check(
            'computed again from its bag, bent needle',
            'identical or within tolerance',
            run.verdict,
            run.verdict != 'differs',
        ),
        Check(
            'lambda, bent needle',
            f'{1e3 * truth:.4g} mm within {LARGEST_DISTANCE:g} x 95 %',
            f'{1e3 * length.value:.4g} ± {1e3 * half:.2g} mm (95 %)',
            length.determined and abs(length.value - truth) <= LARGEST_DISTANCE * half,
        ),
    ]


def draw_bending(bag: Path) -> Figure:
    """
    Draw the needle on its way, as the plant has shown it.

    Parameters
    ----------
    bag : Path
        The bag.

    Returns
    -------
    Figure
        Both planes, to scale.

    """
    needles, path = read_needles(bag)
    at = np.linspace(0, len(needles) - 1, _DRAWN).round().astype(int).tolist()
    return draw_needle([needles[k] for k in at], path)


def read_needles(bag: Path) -> tuple[list[FloatArray], FloatArray]:
    """
    Read the needle as its plant has shown it.

    Parameters
    ----------
    bag : Path
        The bag.

    Returns
    -------
    list of ndarray, shape (k, 3)
        The needle now and then, without its straight part outside [m].
    ndarray, shape (m, 3)
        The path that it cut [m].

    Raises
    ------
    NeedleError
        If the bag has none.

    """
    needles, path = [], None
    for _, message in read_topic(bag, '/needle_shape'):
        points = _points(message)
        if message.ns == 'path':
            path = points
        else:
            needles.append(points[1:])
    if path is None or not needles:
        raise NeedleError(f'{bag} holds no needle with a path')
    return needles, path


def _points(message: Any) -> FloatArray:
    return np.array([(point.x, point.y, point.z) for point in message.points])
