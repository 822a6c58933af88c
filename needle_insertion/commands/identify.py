# SPDX-License-Identifier: Apache-2.0
"""`needle identify`: fit parameters to recordings; write tables, JSON, parameter file and page."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from functools import partial
from itertools import takewhile
from pathlib import Path
import shlex
import sys
from typing import Any, Final

import needle_identification as identification
from needle_identification.recordings.folders import recordings_in
from needle_identification.recordings.tables import column_roles, ROLES
from needle_identification.result import constants_of, limited
from needle_identification.steering.reading import STEERING_ROLES
from needle_insertion.commands import common
from needle_insertion.commands.identify_sensor import add_sensor
from needle_insertion.commands.identify_steering import add_steering
from needle_insertion.progress import ProgressLine
from needle_insertion.report.identify_text import identified_document, identified_text, warned
from needle_insertion.report.origin import identify_all, Origin
from needle_ros.errors import NeedleError, ParameterError, shown
from needle_ros.quantities import quantities

#: Options whose value may begin with a minus sign.
SIGNED: Final = ('--force-axis', '--motion-axis', '--axes', '--force-axes', '--truth')

KINDS: Final = ('friction', 'stiffness', 'steering', 'sensor')  #: Kinds of identification.

#: Reader and estimator of the kinds with a result for all recordings.
_FITS: Final[Mapping[str, tuple[Callable[..., Any], Callable[..., Any]]]] = {
    'friction': (identification.read_friction_recording, identification.identify_friction),
    'stiffness': (identification.read_indentation_recording, identification.identify_stiffness),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        'needle identify RECORDINGS [OPTIONS] chooses friction, stiffness or steering by the '
        'content of the recordings, as needle inspect does, and prints the command'
    )
    what = parser.add_subparsers(required=True, metavar='WHAT')
    friction = what.add_parser(
        'friction',
        help='Coulomb and viscous friction, equation (15)',
        description='Fit mu_s sgn(v) + mu_v v, equation (15), to force and motion of the needle '
        'base while the tip is past the tissue.',
        epilog='example: needle identify friction run_1 run_2.mcap --wrench-topic /ft '
        '--motion-axis -slide -o result.yaml --report page',
    )
    reading, fitting = _add_common(friction, identification.FrictionSettings())
    reading.add_argument(
        '--force-axis',
        default='y',
        metavar='AXIS',
        help='axis of the wrench, x, y or z, that points into the tissue for the force on the '
        'needle; -x, -y or -z inverts the sign, z[mN] has a unit (default y)',
    )
    reading.add_argument(
        '--motion-axis',
        metavar='AXIS',
        help='axis of the motion, likewise; for a JointState the name of the joint, or -name '
        'or name[mm] (default y; the joint insertion or the only joint)',
    )
    reading.add_argument(
        '--columns',
        metavar='ROLE=[-]NAME[*FACTOR][UNIT],...',
        help=f'columns of a table (CSV, MATLAB) by role ({", ".join(ROLES)}), such as '
        'time=sec:nanosec,depth=-q[mm],force=Fz (default: recognized by usual names)',
    )
    fitting.add_argument(
        '--terms',
        type=common.words_of,
        action='extend',
        metavar='TERM,...',
        help=f'terms of the force model, from {", ".join(identification.TERMS)} '
        f'(default {",".join(identification.FrictionSettings().terms)})',
    )
    fitting.add_argument(
        '--layers',
        **{**common.with_unit('m', quantities), 'metavar': '30mm,...'},
        help='insertion depths at which layers begin, for the term layers',
    )
    friction.set_defaults(identify=_run_friction)

    stiffness = what.add_parser(
        'stiffness',
        help='2 x 2 tissue stiffness by force level, as in Table 2',
        description='Fit the 2 x 2 stiffness of the tissue to force and position of an '
        'end-effector that presses it in several directions and rests in between.',
        epilog='example: needle identify stiffness place_1 place_2.mcap --axes x,-z '
        '-o result.yaml --report page',
    )
    reading, fitting = _add_common(stiffness, identification.StiffnessSettings())
    reading.add_argument(
        '--axes',
        type=common.words_of,
        default=['x', 'z'],
        metavar='X,Z',
        help='axes across the needle and along its deflection; -x inverts an axis, x[mm] has a '
        'unit (default x,z)',
    )
    reading.add_argument(
        '--force-axes',
        type=common.words_of,
        metavar='X,Z',
        help='axes of the force along --axes, likewise, if they or their signs differ',
    )
    level = 'force level of the stiffness to report (default: the largest)'
    common.add_quantity(fitting, '--level', 'N', level)
    stiffness.set_defaults(identify=_run_stiffness)
    add_steering(what)
    add_sensor(what)


def _add_common(
    parser: argparse.ArgumentParser,
    defaults: identification.FrictionSettings | identification.StiffnessSettings,
) -> tuple[argparse._ArgumentGroup, argparse._ArgumentGroup]:
    """Add the options of all kinds; return the option groups of reading and of fitting."""
    tables = isinstance(defaults, identification.FrictionSettings)
    common.add_recordings(parser, common.SKIPPED, tables=tables)
    writing = parser.add_argument_group('output')
    common.add_output(writing)
    writing.add_argument(
        '--report', type=Path, metavar='DIR', help='folder for a page of HTML with its pictures'
    )
    all_warnings = 'print the warnings of each recording, not one warning of each kind'
    common.add_flag(writing, '--all-warnings', all_warnings)
    reading = parser.add_argument_group('input')
    common.add_topic(reading, '--wrench-topic', 'the force, a WrenchStamped', 'base_wrench')
    reading.add_argument(
        '--motion-topic',
        metavar='TOPIC',
        help='topic of the motion (default: the only topic of a suitable type, or joint_states or '
        'end_effector_pose)',
    )
    common.add_time(reading)
    fitting = parser.add_argument_group('identification')
    # The default of the settings is the first choice.
    estimators = tuple(dict.fromkeys([defaults.estimator, *identification.ESTIMATORS]))
    fitting.add_argument(
        '--estimator',
        choices=estimators,
        default=estimators[0],
        help='least squares: ordinary; weighted by the measured noise; huber, robust to outliers; '
        f'total, with noise in the motion (default {estimators[0]})',
    )
    for item in fields(defaults):
        name = f'--{item.name.replace("_", "-")}'
        if item.metadata.get('type') is bool:
            common.add_flag(fitting, name, item.metadata['description'])
        elif 'unit' in item.metadata and not isinstance(item.default, tuple):
            unit = item.metadata['unit']
            default = f'{item.default:g} {unit}'.removesuffix(' 1')
            meaning = f'{item.metadata["description"]} (default {default})'
            common.add_quantity(fitting, name, unit, meaning, item.default)
    return reading, fitting


def _settings(kind: Callable[..., Any], options: argparse.Namespace) -> Any:
    """Create settings from the options of the same names; missing options keep their defaults."""
    names = [item.name for item in fields(kind)]  # type: ignore[arg-type]
    given = {name: getattr(options, name, None) for name in names}
    values = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in given.items()
        if value is not None
    }
    return kind(**values)


def _run_friction(options: argparse.Namespace) -> int:
    settings = _settings(identification.FrictionSettings, options)
    if (
        settings.decay_time != identification.FrictionSettings().decay_time
        and 'decay' not in settings.terms
    ):
        raise ParameterError(
            f'--decay-time is for the term decay, got the terms {", ".join(settings.terms)}'
        )
    fit = (settings, len(options.recordings))
    axes = {
        'force_axis': options.force_axis,
        'motion_axis': options.motion_axis,
        'columns': column_roles(options.columns) if options.columns else None,
    }
    return _identify(options, 'friction', fit, axes, identification.summarize)


def _run_stiffness(options: argparse.Namespace) -> int:
    settings = _settings(identification.StiffnessSettings, options)
    axes = {'axes': options.axes, 'force_axes': options.force_axes}
    for name, given in axes.items():
        if given is not None and len(given) != 2:
            option = f'--{name.replace("_", "-")}'
            raise ParameterError(f'{option} must name two axes, got {",".join(given)}')
    summarize = partial(
        identification.summarize_stiffness,
        force=options.level,
        level_tolerance=settings.level_tolerance,
    )
    axes = {name: given and tuple(given) for name, given in axes.items()}
    return _identify(options, 'stiffness', (settings,), axes, summarize)


def _identify(
    options: argparse.Namespace,
    kind: str,
    fit: tuple[Any, ...],
    axes: Mapping[str, Any],
    summarize: Callable[[list[Any]], Any],
) -> int:
    """Identify all bags with the settings and other arguments of a fit, and write the results."""
    common.check_file(options.output)
    common.check_folder(options.report)
    reading = {name: getattr(options, name) for name in ('wrench_topic', 'motion_topic', 'time')}
    reading |= axes
    read, identify = _FITS[kind]
    estimates, origin = identify_all(
        options.recordings,
        partial(read, **reading),
        lambda recording: identify(recording, *fit),
        Origin(settings=fit[0], reading=reading, result=options.output),
        digest=options.json or options.report is not None,
    )
    common.print_each('error', origin.failed)
    (other,) = _FITS.keys() - {kind}
    read, identify = _FITS[other]
    for name, _reason in origin.failures:
        with suppress(NeedleError, OSError):
            identify(read(Path(name)))
            sys.stderr.write(shown(f'{name}: try needle identify {other}') + '\n')
    if not estimates:
        return 2
    summary = summarize(estimates)
    result = {'friction': None, kind: summary}
    written, errors = common.try_write(
        options.output, lambda path: identification.write_result(path, **result)
    )
    if written:
        common.print_each('warning', limited(constants_of(summary)))
    if options.report is not None:
        # Imports plotting: not needed for tables.
        from needle_insertion.report.identify_page import write_identified_page

        common.make_folder(options.report)
        with ProgressLine('page', brief=True):
            written.append(write_identified_page(options.report, summary, origin))
    short, full = warned(summary, origin)
    common.print_each('warning', full if options.all_warnings else short)
    if len(full) > len(short) and not options.all_warnings:
        sys.stderr.write(f'--all-warnings prints all {len(full)} warnings\n')
    document = {**identified_document(summary, origin), 'files': [str(path) for path in written]}
    common.print_result(document, identified_text(summary), written, as_json=options.json)
    common.print_each('error', errors)
    return 2 if origin.failures or errors else 0


def completed(words: Sequence[str]) -> list[str]:
    """Insert the kind and the options for recordings that are given without a kind."""
    first = words[0] if words else '-'
    path = Path(first)
    is_recording = path.exists() or path.suffix or len(path.parts) > 1
    if first in KINDS or first.startswith('-') or not is_recording:
        return list(words)
    given = list(takewhile(lambda word: not word.startswith('-'), words))
    #: Columns of the user, in place of those that are found.
    own = [word for word in words if word.startswith('--columns')]
    reasons = []
    for path in [one for name in given for one in recordings_in(Path(name))]:
        try:
            with ProgressLine(f'reading {path}', brief=True):
                found = identification.inspect_recording(path)
        except (NeedleError, OSError) as error:
            reasons.append(str(error))
            continue
        if found.command and (own or not found.lacking):
            break
        reasons.append(f'{found.path}: {found.lacking or "; ".join(found.words)}')
    else:
        # The reason of the first recording: the others are probably alike.
        raise identification.IdentificationError(reasons[0])
    kind, _, *options = shlex.split(found.command)[2:]
    if own:
        steered = any(f'{role}=' in word for word in words for role in STEERING_ROLES[1:])
        kind, options = 'steering' if steered else kind, []
    chosen = [kind, *given, *options, *words[len(given) :]]
    # Values with a minus sign are quoted where the terminal needs it.
    sys.stderr.write(shown(f'chosen: {shlex.join(["needle", "identify", *chosen])}') + '\n')
    return chosen


def run(options: argparse.Namespace) -> int:
    status: int = options.identify(options)
    return status
