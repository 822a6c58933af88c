# SPDX-License-Identifier: Apache-2.0
"""`needle identify steering`: fit the bending of a needle that cuts its path to recordings."""

import argparse
from collections.abc import Sequence
from itertools import count
from pathlib import Path
import re
from typing import Any

from needle_dynamics.needles import find_needle
from needle_dynamics.parameters import NeedleParameters, PAPER_NEEDLE
from needle_identification.estimation.estimate import between, measured, ParameterEstimate
from needle_identification.recordings.tables import column_roles
from needle_identification.steering.estimate import HeldOut, LAYER, SteeringEstimate
from needle_identification.steering.reading import read_steering_recording, STEERING_ROLES
from needle_identification.steering.recording import ORDERS, SteeringRecording, TERMS
from needle_insertion.commands import common
from needle_insertion.progress import ProgressLine
from needle_insertion.report.content import table
from needle_insertion.report.identify_text import interval_of, plain, title_of
from needle_ros.errors import NeedleError, ParameterError
from needle_ros.files import write_whole

_ONE = 'all'  #: name of a medium without a name

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
    common.add_recordings(parser, common.SKIPPED)
    common.add_output(parser, ', for a steered plant; for a single medium only')
    reading = parser.add_argument_group('input')
    reading.add_argument(
        '--columns',
        metavar='ROLE=[-]NAME[*FACTOR][UNIT][@ROWS],...',
        help=f'columns by role ({", ".join(STEERING_ROLES)}); @1: the value of the previous row '
        '(default: recognized by usual names); for a bag, the joints of depth, guide and roll, '
        'and the axes of the tip',
    )
    tip = 'the tip, a PointStamped or PoseStamped'
    common.add_topic(reading, '--tip-topic', tip, 'tip_deflection')
    common.add_topic(reading, '--motion-topic', 'the joints, a JointState', 'joint_states')
    common.add_time(reading)
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
        default=','.join(TERMS),
        metavar='TERM,...',
        help=f'causes of drift, from {", ".join(TERMS)} (default: all)',
    )
    fitting.add_argument(
        '--order',
        choices=ORDERS,
        help='order of motion between samples: guide and needle together, or the guide first '
        '(default: the most likely order)',
    )
    common.add_quantity(fitting, '--free-length', 'm', 'known free length (default: fitted)')
    nominal = fitting.add_mutually_exclusive_group()
    common.add_needle(
        nominal, None, f'{PAPER_NEEDLE}, in uniform tissue; the stiffness of each layer is fitted'
    )
    nominal.add_argument(
        '--plan', type=Path, metavar='FILE', help='plan of `needle plan -o` with needle and layers'
    )
    parser.set_defaults(identify=_run)


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


def _nominal(options: argparse.Namespace) -> tuple[str, NeedleParameters | None]:
    """Return the name of the nominal needle, and the needle in its tissue if it was given."""
    if options.plan is not None:
        # Imported here: most runs have no plan.
        from needle_controller.steering.insertion_plan import in_layers, read_plan

        plan = read_plan(options.plan)
        preset = find_needle(plan.needle)
        return plan.needle, in_layers(plan.layers, preset.needle, preset.steering).needle
    if options.needle is not None:
        return options.needle, find_needle(options.needle).needle
    return PAPER_NEEDLE, None


def _run(options: argparse.Namespace) -> int:
    # A large import, which the other subcommands do not need.
    from needle_identification import identify_steering, SteeringSettings
    from needle_identification.result import steering_yaml

    common.check_file(options.output)
    terms = tuple(common.words_of(options.terms))
    name, tissue = _nominal(options)
    settings = SteeringSettings(
        terms=terms, order=options.order, free_length=options.free_length, tissue=tissue
    )
    reading = {name: getattr(options, name) for name in ('tip_topic', 'motion_topic', 'time')}
    reading['columns'] = column_roles(options.columns, STEERING_ROLES) if options.columns else {}
    known = dict[bytes, SteeringRecording]()
    failed = False
    with ProgressLine('reading', brief=True):
        for path in options.recordings:
            try:
                medium = _medium_of(path, options.medium)
                one = read_steering_recording(path, medium=medium, **reading)
            except (NeedleError, OSError) as error:
                common.print_each('error', [error])
                failed = True
                continue
            if (same := known.setdefault(one.digest, one)) is not one:
                copy = f'{one.name}: the same samples as {same.name}: counts once'
                common.print_each('warning', [copy])
    recordings = [*known.values()]
    if not recordings:
        return 2
    common.print_each('warning', _alike(recordings))
    with ProgressLine('identification', brief=True) as show:
        fits = count(1)
        found = identify_steering(recordings, settings, lambda: show(f'fit {next(fits)}'))
    common.print_each('warning', found.warnings)
    written, errors = common.try_write(
        options.output, lambda path: write_whole(path, steering_yaml(found, name).encode())
    )
    document = steering_document(found, recordings)
    common.print_result(document, steering_text(found), written, as_json=options.json)
    common.print_each('error', errors)
    return 2 if errors or failed else 0


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


def _undetermined(one: ParameterEstimate) -> str:
    used = f' ({one.value:.3g} used)' if one.name.startswith(LAYER) else ''
    return f'not determined{used}'


def steering_text(found: SteeringEstimate) -> str:
    parameters = [(one.medium or _ONE, each) for one in found.media for each in one.parameters]
    rows = [
        (
            medium,
            title_of(one),
            measured(one.value, one.error) if one.determined else _undetermined(one),
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
    layers = ', '.join(
        f'{one["stiffness"]:.4g} N/m^2 from {1e3 * one["depth"]:g} mm' for one in _layers(found)
    )
    motion = 'move together' if found.order == ORDERS[0] else 'move one after the other'
    return '\n'.join(
        [
            table(rows, ('medium', 'parameter', 'value ± SE', '95 % interval')),
            '',
            table(fits, _FITS),
            '',
            f'drift by {", ".join(found.terms)}; guide and needle {motion}',
            *([f'k_nominal: {layers}'] if layers else []),
        ]
    )


def _layers(found: SteeringEstimate) -> list[dict[str, float]]:
    """Return depth [m] and nominal stiffness [N/m^2] of each fitted layer."""
    if found.tissue is None or not found.media[0].layers:
        return []
    tissue = found.tissue.tissue
    return [
        {'depth': depth, 'stiffness': stiffness}
        for depth, stiffness in zip(tissue.starts, tissue.stiffnesses, strict=True)
    ]


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
        **({'nominal_layers': layers} if (layers := _layers(found)) else {}),
        'terms': list(found.terms),
        'order': found.order,
        'optima': found.optima,
        'recordings': [
            {'name': one.name, 'medium': one.medium, 'losses': list(one.losses)}
            for one in recordings
        ],
        'warnings': list(found.warnings),
    }
