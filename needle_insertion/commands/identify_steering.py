# SPDX-License-Identifier: Apache-2.0
"""`needle identify steering`: fit the bending of a needle that cuts its path to recordings."""

import argparse
from collections.abc import Mapping, Sequence
from itertools import count
from pathlib import Path
import re
from typing import Any

from needle_identification.errors import IdentificationError
from needle_identification.estimation.estimate import ParameterEstimate
from needle_identification.estimation.formatting import between, measured
from needle_identification.recordings import TIMES
from needle_identification.recordings.tables import column_roles
from needle_identification.steering.columns import STEERING_ROLES
from needle_identification.steering.estimate import HeldOut, SteeringEstimate
from needle_identification.steering.reading import read_steering_recording
from needle_identification.steering.recording import SteeringRecording
from needle_identification.steering.response import ORDERS, TERMS
from needle_insertion.commands.common import (
    add_recordings,
    check_file,
    print_each,
    print_result,
    with_unit,
)
from needle_insertion.progress import ProgressLine
from needle_insertion.report.identify_text import interval_of, plain, title_of
from needle_insertion.report.text import table
from needle_ros.errors import NeedleError, ParameterError
from needle_ros.files import write_whole

_ONE = 'all'  #: name of a medium without a name

#: End of the help on recordings.
SKIPPED = '; an unusable recording is reported and skipped, and the exit status is 2'

#: Columns of the table of media.
_FITS = (
    'medium', 'recordings', 'samples', 'rms per axis [mm]', 'rms of a predicted recording [mm]',
    'noise [mm]', 'path noise [rad^2/m]',
)  # fmt: skip


def add_steering(what: Any) -> None:
    parser = what.add_parser(
        'steering',
        help='bending length, free length, skin, tilt and bevel of a needle that cuts its path',
        description='Fit the bending of a needle to the recorded positions of guide and tip, in '
        'one or several media, all recordings together.',
        epilog='example: needle identify steering gel/*.csv liver/*.csv --columns '
        "'depth=-robot[m],guide_x=base.x[mm]@1,guide_z=base.z[mm]@1,tip_x=tip.x[mm],"
        "tip_z=tip.z[mm]'",
    )
    add_recordings(parser, SKIPPED)
    add_output(parser, ', for a steered plant; for a single medium only')
    reading = parser.add_argument_group('input')
    reading.add_argument(
        '--columns',
        metavar='ROLE=[-]NAME[*FACTOR][UNIT][@ROWS],...',
        help=f'columns by role ({", ".join(STEERING_ROLES)}); @1: the value of the previous row '
        '(default: recognized by usual names); for a bag, the joints of depth, guide and roll, '
        'and the axes of the tip',
    )
    reading.add_argument(
        '--tip-topic',
        metavar='TOPIC',
        help='topic of the tip, a PointStamped or PoseStamped (default: the only such topic, or '
        'tip_deflection)',
    )
    reading.add_argument(
        '--motion-topic',
        metavar='TOPIC',
        help='topic of the joints, a JointState (default: the only such topic, or joint_states)',
    )
    add_time(reading)
    reading.add_argument(
        '--medium',
        type=_pattern,
        metavar='REGEX',
        help='regular expression with one group, which matches the medium in the path of a '
        'recording (default: the folder of the recording)',
    )
    fitting = parser.add_argument_group('identification')
    fitting.add_argument(
        '--terms',
        metavar='TERM,...',
        help=f'causes of drift, from {", ".join(TERMS)} (default: the most likely cause)',
    )
    fitting.add_argument(
        '--order',
        choices=ORDERS,
        help='order of motion between samples: guide and needle together, or the guide first '
        '(default: the most likely order)',
    )
    fitting.add_argument(
        '--free-length', help='known free length (default: fitted)', **with_unit('m')
    )
    parser.set_defaults(identify=_run)


def add_time(reading: argparse._ArgumentGroup) -> None:
    reading.add_argument(
        '--time',
        choices=TIMES,
        default='header',
        help='time of a sample: stamp of its message or time of receipt (default header)',
    )


def add_output(parser: argparse._ActionsContainer, use: str = '') -> None:
    """Add the options of the results, of which the parameter file has a use."""
    parser.add_argument(
        '-o',
        '--output',
        type=Path,
        metavar='FILE',
        help=f'ROS parameter file with the result{use}',
    )
    parser.add_argument('--json', action='store_true', help='print JSON instead of tables')


def words_of(text: str) -> list[str]:
    return [word.strip() for word in text.split(',')]


def _pattern(text: str) -> re.Pattern[str]:
    try:
        pattern = re.compile(text)
    except re.error as error:
        raise argparse.ArgumentTypeError(f'is no regular expression: {error}') from None
    if pattern.groups != 1:
        raise argparse.ArgumentTypeError(f'must have one group in brackets, got {text!r}')
    return pattern


def _medium_of(path: Path, pattern: re.Pattern[str] | None) -> str:
    if pattern is None:
        return path.resolve().parent.name
    if (match := pattern.search(str(path))) is None:
        raise ParameterError(f'{path} does not match --medium {pattern.pattern}')
    return str(match[1])


def _read(
    path: Path, columns: Mapping[str, str], options: argparse.Namespace
) -> SteeringRecording | None:
    try:
        return read_steering_recording(
            path,
            medium=_medium_of(path, options.medium),
            tip_topic=options.tip_topic,
            motion_topic=options.motion_topic,
            time=options.time,
            columns=columns,
        )
    except (NeedleError, OSError) as error:
        print_each('error', [error])
        return None


def _run(options: argparse.Namespace) -> int:
    # A large import, which the other subcommands do not need.
    from needle_identification import identify_steering, SteeringSettings
    from needle_identification.result import steering_yaml

    check_file(options.output)
    terms = options.terms and tuple(words_of(options.terms))
    settings = SteeringSettings(terms=terms, order=options.order, free_length=options.free_length)
    columns = column_roles(options.columns, STEERING_ROLES) if options.columns else {}
    with ProgressLine('reading', brief=True):
        read = [_read(path, columns, options) for path in options.recordings]
    recordings = [one for one in read if one is not None]
    if not recordings:
        return 2
    print_each('warning', _alike(recordings))
    with ProgressLine('identification', brief=True) as show:
        fits = count(1)
        found = identify_steering(recordings, settings, lambda: show(f'fit {next(fits)}'))
    print_each('warning', found.warnings)
    written, errors = list[Path](), list[str]()
    if options.output is not None:
        try:
            write_whole(options.output, steering_yaml(found).encode())
            written.append(options.output)
        except IdentificationError as error:
            errors.append(f'{options.output} is not written: {error}')
    document = steering_document(found, recordings)
    print_result(document, steering_text(found), written, as_json=options.json)
    print_each('error', errors)
    return 2 if errors or len(recordings) < len(read) else 0


def _alike(recordings: Sequence[SteeringRecording]) -> list[str]:
    """Group the losses of all recordings: the recordings with a message, and the message."""
    groups: dict[str, list[str]] = {}
    for one in recordings:
        for words in one.losses:
            groups.setdefault(words, []).append(one.name)
    return [
        f'{names[0]}{f" and {len(names) - 1} more" if names[1:] else ""}: {words}'
        for words, names in groups.items()
    ]


def _predicted(one: HeldOut | None) -> str:
    if one is None:
        return ''
    low, high = (1e3 * end for end in one.interval)
    return f'{1e3 * one.rms:.3f} ({between((low, high))})'


def steering_text(found: SteeringEstimate) -> str:
    parameters = [
        (medium.medium or _ONE, one) for medium in found.media for one in medium.parameters
    ]
    rows = [
        (
            medium,
            title_of(one),
            measured(one.value, one.error) if one.determined else 'not determined',
            # A given free length has no error.
            interval_of(one) if one.error else '',
        )
        for medium, one in [*parameters, ('all media', found.free_length)]
    ]
    fits = [
        (
            medium.medium or _ONE,
            f'{medium.recordings}',
            f'{medium.samples}',
            f'{1e3 * medium.rms:.3f}',
            _predicted(medium.held_out),
            f'{1e3 * medium.noise:.3f}',
            f'{medium.path_noise:.1e}',
        )
        for medium in found.media
    ]
    others = ', '.join(
        f'{"+".join(terms)} {1e3 * rms:.3f} mm' for terms, rms in found.alternatives.items()
    )
    motion = 'move together' if found.order == ORDERS[0] else 'move one after the other'
    return '\n'.join(
        [
            table(rows, ('medium', 'parameter', 'value ± SE', '95 % interval')),
            '',
            table(fits, _FITS),
            '',
            f'drift by {"+".join(found.terms)}; rms by cause: {others}; guide and needle {motion}',
        ]
    )


def steering_document(
    found: SteeringEstimate, recordings: Sequence[SteeringRecording]
) -> dict[str, Any]:

    def entry(one: ParameterEstimate) -> dict[str, Any]:
        known = {'value': one.value, 'error': one.error, 'interval': plain(one.interval)}
        values = known if one.determined else {'used': one.value}
        return {**values, 'unit': one.unit, 'determined': one.determined}

    return {
        'free_length': entry(found.free_length),
        'media': {
            medium.medium or _ONE: {
                'parameters': {one.name: entry(one) for one in medium.parameters},
                **{
                    name: getattr(medium, name) for name in ('rms', 'noise', 'path_noise', 'slope')
                },
                'held_out': medium.held_out and medium.held_out._asdict(),
                **{name: getattr(medium, name) for name in ('samples', 'recordings')},
            }
            for medium in found.media
        },
        'terms': list(found.terms),
        'order': found.order,
        'optima': found.optima,
        'rms_by_terms': {'+'.join(terms): rms for terms, rms in found.alternatives.items()},
        'recordings': [
            {'name': one.name, 'medium': one.medium, 'losses': list(one.losses)}
            for one in recordings
        ],
        'warnings': list(found.warnings),
    }
