# SPDX-License-Identifier: Apache-2.0
"""`needle identify sensor`: noise, bias, delay and losses of a tip sensor."""

import argparse
from pathlib import Path
from typing import Any

from needle_identification.estimation.estimate import ParameterEstimate, rounded
from needle_identification.recordings.recording import SensorRecording
from needle_identification.recordings.tables import column_roles, is_table
from needle_identification.sensor.identify import SensorEstimate
from needle_identification.sensor.reading import read_sensor_recording, SENSOR_ROLES
from needle_insertion.commands import common
from needle_insertion.progress import ProgressLine
from needle_insertion.report.content import table
from needle_insertion.report.identify_text import interval_of, title_of
from needle_ros.errors import ParameterError
from needle_ros.files import write_whole
from needle_ros.quantities import AXES, point


def add_sensor(what: Any) -> None:
    parser = what.add_parser(
        'sensor',
        help='noise, correlation time, bias, delay, losses and outliers of a tip sensor',
        description='Compare a recording of the tip sensor with the true position of the tip, '
        'which is constant or recorded by another sensor.',
        epilog='example: needle identify sensor held.csv --truth 0mm,52.3mm,0mm '
        "--columns 'time=t[ms],tip_x=X[mm],tip_y=Y[mm],tip_z=Z[mm]' -o sensor.yaml",
    )
    parser.add_argument(
        'log', type=Path, metavar='LOG', help='bag or table (.csv, .tsv, .mat) of the tip sensor'
    )
    parser.add_argument(
        '--truth',
        metavar='X,Y,Z|FILE',
        help='true position: constant, such as 0mm,52.3mm,0mm, or a bag or table by the same '
        'clock (default: LOG itself, with --truth-topic or --truth-columns)',
    )
    common.add_output(parser, ', for plant and steering')
    reading = parser.add_argument_group('input')
    for option, of in (('--columns', 'the sensor'), ('--truth-columns', 'the true position')):
        reading.add_argument(
            option,
            metavar='ROLE=[-]NAME[*FACTOR][UNIT],...',
            help=f'columns of {of} by role ({", ".join(SENSOR_ROLES)}; default: recognized by '
            'usual names); for a bag, axes such as tip_x=-z',
        )
    for option, of in (('--tip-topic', 'the tip'), ('--truth-topic', 'the true position')):
        common.add_topic(reading, option, f'{of}, a PointStamped or PoseStamped')
    reading.add_argument(
        '--axes',
        default=','.join(AXES),
        help='axes to compare (default x,y,z)',
        metavar='AXIS,...',
    )
    common.add_time(reading)
    parser.set_defaults(identify=_run)


def _truth(options: argparse.Namespace) -> Path | list[float]:
    if options.truth is None:
        if options.truth_topic is None and options.truth_columns is None:
            raise ParameterError(
                '--truth X,Y,Z or --truth FILE must give the true position, or --truth-topic or '
                f'--truth-columns its place in {options.log}'
            )
        return Path(options.log)
    if Path(options.truth).exists():
        return Path(options.truth)
    what = '--truth must be a file, or three lengths x,y,z such as 0mm,52.3mm,0mm'
    return point(options.truth, what)


def _run(options: argparse.Namespace) -> int:
    # Large imports, which the other subcommands do not need.
    from needle_controller.steering.settings import ExecutiveSettings
    from needle_identification import identify_sensor
    from needle_identification.result import sensor_yaml

    common.check_file(options.output)

    reading = {name: getattr(options, name) for name in ('tip_topic', 'truth_topic', 'time')}
    for name in ('columns', 'truth_columns'):
        text = getattr(options, name)
        reading[name] = column_roles(text, SENSOR_ROLES) if text else {}
    axes = tuple(common.words_of(options.axes))
    with ProgressLine('reading', brief=True):
        recording = read_sensor_recording(options.log, _truth(options), axes=axes, **reading)
    common.print_each('warning', recording.losses)
    with ProgressLine('identification', brief=True):
        found = identify_sensor(recording)
    common.print_each('warning', found.warnings)
    written = list(filter(None, [options.output]))
    if written:
        # Stamps of headers are the times of the samples: their messages come later.
        delayed = is_table(options.log) or options.time == 'receive'
        text = sensor_yaml(found, ExecutiveSettings().measurement_time, delayed=delayed)
        write_whole(options.output, text.encode())
    document = sensor_document(found, recording)
    common.print_result(document, sensor_text(found), written, as_json=options.json)
    return 0


def sensor_text(found: SensorEstimate) -> str:
    rows = []
    for one in found.parameters:
        low, high = one.interval
        shown = rounded(one.value, (high - low) / 4.0) if one.determined else 'not determined'
        rows.append((title_of(one), shown, interval_of(one)))
    return (
        f'{table(rows, ("parameter", "value", "95 % interval"))}\n\n'
        f'{found.samples} samples at {found.rate:.4g} Hz in {found.duration:.4g} s'
    )


def sensor_document(found: SensorEstimate, recording: SensorRecording) -> dict[str, Any]:

    def entry(one: ParameterEstimate) -> dict[str, Any]:
        known = {'value': one.value, 'interval': one.interval} if one.determined else {}
        return {**known, 'unit': one.unit, 'determined': one.determined}

    return {
        'parameters': {one.name: entry(one) for one in found.parameters},
        'axes': list(found.axes),
        **{name: getattr(found, name) for name in ('rate', 'samples', 'duration')},
        'recording': {'name': recording.name, 'losses': list(recording.losses)},
        'warnings': list(found.warnings),
    }
