# SPDX-License-Identifier: Apache-2.0
"""Record, check and draw an insertion of a bending needle whose guide and roll move."""

from math import pi
from pathlib import Path
from typing import Final

from builtin_interfaces.msg import Duration
from matplotlib.figure import Figure
from needle_dynamics import bending_length, FloatArray
from needle_dynamics.needles import NEEDLES
from needle_identification import identify_steering, read_steering_recording, SteeringSettings
from needle_identification.bags.bag import read_topic
from needle_insertion.progress import Show
from needle_insertion.replay.rerun import verify
from needle_insertion.report.insertion import draw_needle, evenly
from needle_ros.errors import NeedleError
import numpy as np
from reproduction.content import Check
from reproduction.insertions.insertion import record_insertion
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

#: Preset of needle and tissue, and plant with a bevel load and a tracker in the tip.
PRESET: Final = 'bending_35mm'
PLANT: Final[dict[str, object]] = {
    'needle': PRESET,
    'steered': True,
    'steering.bevel_load': [0.6],
    'steering.cutting_force': [1.0],
    'tip.rate': 40.0,
    'tip.noise': 1.8e-4,
    'tip.delay': 0.02,
}

#: Moving joints, and their trajectory: times [s] and positions [m, rad]. The guide is displaced
#: early, and the needle is rotated by half a turn in the middle of the insertion.
JOINTS: Final = ('guide_x', 'roll')
MOTION: Final = ((1, (4e-3, 0.0)), (5, (4e-3, 0.0)), (6, (4e-3, pi)))

LEAST_DEFLECTION: Final = 2e-3  #: Least distance of the tip of a bending needle from the axis [m].

#: Largest error of the bending length, in half-widths of the 95 % interval.
LARGEST_DISTANCE: Final = 2.0

DRAWN: Final = 5  #: Number of needles in the picture.


def record_bending(bag: Path, logs: Path, show: Show, *, lockstep: bool = True) -> None:
    """Insert a bending needle with a moving guide and record everything."""
    motion = JointTrajectory(
        joint_names=list(JOINTS),
        points=[
            JointTrajectoryPoint(positions=list(at), time_from_start=Duration(sec=time))
            for time, at in MOTION
        ],
    )
    record_insertion('adaptive', bag, logs, show, PLANT, motion, lockstep=lockstep)


def bending_checks(bag: Path) -> list[Check]:
    """Check the deflection, the replay of the run, and the identified bending length."""
    needle = NEEDLES[PRESET].needle
    truth = bending_length(needle.bending_stiffness, needle.tissue_stiffness)
    (tip, _) = read_needles(bag)
    aside = float(np.hypot(tip[-1][-1, 0], tip[-1][-1, 2]))
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
        replay_check(bag, 'bent needle'),
        Check(
            'lambda, bent needle',
            f'{1e3 * truth:.4g} mm within {LARGEST_DISTANCE:g} x 95 %',
            f'{1e3 * length.value:.4g} ± {1e3 * half:.2g} mm (95 %)',
            length.determined and abs(length.value - truth) <= LARGEST_DISTANCE * half,
        ),
    ]


def replay_check(bag: Path, what: str) -> Check:
    """Check that the recorded run is computed again with the same values."""
    (run,) = verify(bag)
    wanted = 'identical or within tolerance'
    passed = run.verdict != 'differs'
    return Check(f'computed again from its bag, {what}', wanted, run.verdict, passed)


def draw_bending(bag: Path) -> Figure:
    needles, path = read_needles(bag)
    return draw_needle(evenly(needles, DRAWN), path)


def read_needles(bag: Path) -> tuple[list[FloatArray], FloatArray]:
    """Read the shapes of the needle inside, each (k, 3) [m], and its cut path, (m, 3) [m]."""
    needles, path = [], None
    for _, message in read_topic(bag, '/needle_shape'):
        points = np.array([(point.x, point.y, point.z) for point in message.points])
        if message.ns == 'path':
            path = points
        else:
            needles.append(points[1:])
    if path is None or not needles:
        raise NeedleError(f'{bag} holds no needle with a path')
    return needles, path
