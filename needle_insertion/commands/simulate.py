"""`needle simulate`: the open-loop needle without ROS, to a table, CSV, picture or bag."""

from __future__ import annotations

import argparse
import csv
from io import StringIO
import json
from pathlib import Path
import sys

from matplotlib.figure import Figure
from needle_dynamics import (
    NeedleModel,
    NeedleParameters,
    ParameterError,
    PRESETS,
    simulate,
    Trajectory,
)
from needle_dynamics.simulated.integrators import DEFAULT_TOLERANCE
from needle_identification import BagWriter, encode, message_type
from needle_insertion.commands.options import constants
from needle_insertion.report.page import png, table, write_whole
from needle_ros.timing import NANOSECONDS
import numpy as np


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument('--preset', choices=tuple(PRESETS), default='paper_si')
    parser.add_argument(
        '--set',
        action='append',
        default=[],
        metavar='NAME=VALUE',
        help='change a model constant; repeatable',
    )
    parser.add_argument('--depth', type=float, default=0.02, metavar='m', help='inserted length')
    parser.add_argument('--tip-deflection', type=float, default=5e-4, metavar='m')
    parser.add_argument('--force', type=float, default=3.0, metavar='N', help='insertion force')
    parser.add_argument('--duration', type=float, default=0.05, metavar='s')
    parser.add_argument('--interval', type=float, default=1e-4, metavar='s', help='of samples')
    parser.add_argument(
        '--tolerance', type=float, default=DEFAULT_TOLERANCE, help='of each interval'
    )
    parser.add_argument(
        '-o',
        '--output',
        type=Path,
        action='append',
        default=[],
        help='file.csv, file.png or a folder for a bag; repeatable',
    )
    parser.add_argument('--json', action='store_true', help='print JSON instead of a table')


def run(options: argparse.Namespace) -> int:
    """Simulate, write what was asked for, and print a summary; return the exit status."""
    for path in options.output:
        if path.suffix not in ('', '.csv', '.png'):
            raise ParameterError(f'{path}: output must be .csv, .png or a folder for a bag')
        if not path.absolute().parent.is_dir() or (not path.suffix and path.exists()):
            raise ParameterError(f'{path}: the folder it is in must exist, a bag must not')
    parameters = NeedleParameters.preset(options.preset, **constants(options.set))
    model = NeedleModel(parameters)
    trajectory = simulate(
        parameters,
        model.state_at(options.depth, options.tip_deflection),
        options.force,
        duration=options.duration,
        interval=options.interval,
        tolerance=options.tolerance,
    )
    for path in options.output:
        if path.suffix == '.csv':
            _write_csv(trajectory, path)
        elif path.suffix == '.png':
            write_whole(path, png(figure(trajectory)))
        else:
            _write_bag(trajectory, path)
    tips = trajectory.tip_deflection
    summary = {
        'duration [s]': float(trajectory.time[-1]),
        'inserted length at the end [m]': float(trajectory.depth[-1]),
        'insertion speed at the end [m/s]': float(-trajectory.states[-1, model.coordinates]),
        'largest tip deflection [m]': float(np.abs(tips).max()),
        'tip deflection at the end [m]': float(tips[-1]),
        'energy at the start [J]': model.energy(trajectory.states[0]),
        'energy at the end [J]': model.energy(trajectory.states[-1], float(trajectory.time[-1])),
    }
    if options.json:
        sys.stdout.write(f'{json.dumps(summary, indent=2)}\n')
    else:
        rows = [(name, f'{value:.6g}') for name, value in summary.items()]
        sys.stdout.write(f'{table(rows, ("quantity", "value"))}\n')
    return 0


def figure(trajectory: Trajectory) -> Figure:
    """Draw depth, modal coordinates and tip deflection over time."""
    model = NeedleModel(trajectory.parameters)
    result = Figure(figsize=(9.0, 7.0), layout='constrained')
    above, middle, below = result.subplots(3, 1, sharex=True)
    time = trajectory.time * 1e3
    above.plot(time, trajectory.depth * 1e3)
    above.set_ylabel('inserted length [mm]')
    for i in range(model.modes.count):
        middle.plot(time, trajectory.states[:, 2 + i] * 1e3, label=f'q{i + 1}')
    middle.set_ylabel('modal coordinates [1e-3 m^3/2]')
    middle.legend()
    below.plot(time, trajectory.tip_deflection * 1e3)
    below.set_ylabel('tip deflection [mm]')
    below.set_xlabel('time [ms]')
    for axis in (above, middle, below):
        axis.grid(visible=True, alpha=0.3)
    return result


def _write_csv(trajectory: Trajectory, path: Path) -> None:
    names = NeedleModel(trajectory.parameters).coordinate_names
    text = StringIO(newline='')
    writer = csv.writer(text)
    writer.writerow(['time', *names, *(f'{name}_dot' for name in names), 'tip_deflection'])
    rows = np.column_stack([trajectory.time, trajectory.states, trajectory.tip_deflection])
    writer.writerows(rows.tolist())
    write_whole(path, text.getvalue().encode())


def _write_bag(trajectory: Trajectory, path: Path) -> None:
    """Write the topics of the plant, stamped with the simulated time."""
    model = NeedleModel(trajectory.parameters)
    m = model.coordinates
    kinds = {
        '/joint_states': 'sensor_msgs/msg/JointState',
        '/ground_truth': 'sensor_msgs/msg/JointState',
        '/tip_deflection': 'geometry_msgs/msg/PointStamped',
    }
    header, stamp = (
        message_type('std_msgs/msg/Header'),
        message_type('builtin_interfaces/msg/Time'),
    )
    point = message_type('geometry_msgs/msg/Point')
    joint, pointed = (message_type(kinds[name]) for name in ('/joint_states', '/tip_deflection'))
    empty = np.zeros(0)
    with BagWriter(path) as bag:
        for topic, kind in kinds.items():
            bag.add_topic(topic, kind)
        tips = trajectory.tip_deflection
        forces = np.append(trajectory.forces, trajectory.forces[-1])
        for k, state in enumerate(trajectory.states):
            ns = round(trajectory.time[k] * NANOSECONDS)
            at = stamp(sec=ns // NANOSECONDS, nanosec=ns % NANOSECONDS)
            depth = trajectory.depth[k]
            messages = {
                '/joint_states': joint(
                    header=header(stamp=at, frame_id=''),
                    name=['insertion', 'rotation'],
                    position=np.array([depth, state[1]]),
                    velocity=np.array([-state[m], state[m + 1]]),
                    effort=np.array([forces[k], 0.0]),
                ),
                '/ground_truth': joint(
                    header=header(stamp=at, frame_id=''),
                    name=list(model.coordinate_names),
                    position=state[:m].copy(),
                    velocity=state[m:].copy(),
                    effort=empty,
                ),
                '/tip_deflection': pointed(
                    header=header(stamp=at, frame_id='needle_entry'),
                    point=point(x=0.0, y=float(depth), z=float(tips[k])),
                ),
            }
            for topic, message in messages.items():
                bag.write(topic, encode(message), ns)
