"""Command line `needle`: exit status 0 done, 1 the job failed, 2 bad usage or bad input."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import fields
import json
from pathlib import Path
import signal
import sys
import tempfile
from types import FrameType
from typing import Any, NoReturn

from needle_dynamics import JobError, NeedleError, ParameterError
from needle_identification import (
    check_distinct,
    FrictionSettings,
    FrictionSummary,
    identify_friction,
    read_friction_recording,
    summarize,
    write_result,
)
from needle_insertion import analyze, simulate
from needle_insertion.report import table
from tqdm import tqdm

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

#: Recordings shipped with the source tree.
SHIPPED_BAGS = Path(__file__).parent.parent / 'bags'


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run the command line.

    Parameters
    ----------
    arguments : sequence of str, optional
        Words after the program's name; those of the process if not given.

    Returns
    -------
    int
        Exit status.

    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    options = _parser().parse_args(_joined(words))
    # What was started is ended on the way out, whatever ends the command.
    previous = {name: signal.signal(name, _interrupt) for name in _SIGNALS}
    try:
        status: int = options.command(options)
    except JobError as error:
        sys.stderr.write(f'error: {error}\n')
        return 1
    except (NeedleError, OSError) as error:
        sys.stderr.write(f'error: {error}\n')
        return 2
    except KeyboardInterrupt:
        sys.stderr.write('interrupted\n')
        return 130
    finally:
        for name, handler in previous.items():
            signal.signal(name, handler)
    return status


def _interrupt(_signal: int, _frame: FrameType | None) -> NoReturn:
    # Once is enough: another signal must not break off the tidying up.
    for name in _SIGNALS:
        signal.signal(name, signal.SIG_IGN)
    raise KeyboardInterrupt


def _joined(words: list[str]) -> list[str]:
    """Join ``--force-axis -y``, which argparse would take for two options."""
    joined: list[str] = []
    for word in words:
        if joined and joined[-1] == '--force-axis' and word in ('-x', '-y', '-z'):
            joined[-1] += f'={word}'
        else:
            joined.append(word)
    return joined


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog='needle', description='Robot-assisted needle insertion.')
    commands = parser.add_subparsers(required=True, metavar='COMMAND')

    demo = commands.add_parser('demo', help='insertion, recording, identification, one report')
    demo.add_argument('-o', '--output', type=Path, default=Path('demo_output'), help='folder')
    demo.add_argument('--bags', type=Path, default=SHIPPED_BAGS, help='shipped recordings')
    demo.set_defaults(command=_demo)

    identify = commands.add_parser('identify', help='fit parameters to recordings')
    what = identify.add_subparsers(required=True, metavar='WHAT')
    friction = what.add_parser('friction', help='Coulomb and viscous friction, equation (15)')
    friction.add_argument('bags', type=Path, nargs='+', metavar='BAG')
    friction.add_argument('-o', '--output', type=Path, help='ROS parameter file to write')
    friction.add_argument('--json', action='store_true', help='print JSON instead of a table')
    friction.add_argument('--wrench-topic', help='WrenchStamped topic')
    friction.add_argument('--motion-topic', help='JointState topic')
    friction.add_argument('--force-axis', default='y', help='x, y, z or signed: -x')
    for item in fields(FrictionSettings):
        friction.add_argument(
            f'--{item.name.replace("_", "-")}',
            type=float,
            default=item.default,
            metavar=item.metadata['unit'],
            help=f'{item.metadata["description"]} (default {item.default:g})',
        )
    friction.set_defaults(command=_identify_friction)

    experiment = commands.add_parser('experiment', help='record an experiment on the stand-in')
    which = experiment.add_subparsers(required=True, metavar='WHICH')
    runs = which.add_parser('friction', help='strokes at several speeds, section 3.2.2.2')
    runs.add_argument('output', type=Path, help='folder for the bags friction_1, friction_2, ...')
    runs.add_argument('--repeats', type=int, default=1, metavar='N')
    runs.add_argument('--seed', type=int, default=1, help='the k-th run has seed + k')
    runs.add_argument(
        '--rate', type=float, default=1000.0, metavar='Hz', help='samples per second'
    )
    runs.set_defaults(command=_experiment_friction)

    open_loop = commands.add_parser('simulate', help='the open-loop needle, without ROS')
    simulate.add_arguments(open_loop)
    open_loop.set_defaults(command=simulate.run)

    analyze.add_arguments(commands.add_parser('analyze', help='controllability and observability'))

    bench = commands.add_parser('bench', help='measure speed as ratios, side by side')
    bench.add_argument('what', choices=('dynamics',))
    bench.set_defaults(command=_bench)
    return parser


def _bench(_options: argparse.Namespace) -> int:
    from needle_insertion import bench

    return bench.dynamics()


def _demo(options: argparse.Namespace) -> int:
    from needle_insertion import demo

    return demo.run(options.output, options.bags)


def _experiment_friction(options: argparse.Namespace) -> int:
    from needle_insertion.experiment import RATES, record_friction_run

    runs = range(options.repeats)
    if options.repeats < 1:
        raise ParameterError(f'--repeats must be >= 1, got {options.repeats}')
    if options.seed < 0:
        raise ParameterError(f'--seed must be >= 0, got {options.seed}')
    if not RATES[0] <= options.rate <= RATES[1]:
        raise ParameterError(
            f'--rate must be in [{RATES[0]:g}, {RATES[1]:g}] Hz, got {options.rate}'
        )
    for k in runs:
        bag = options.output / f'friction_{k + 1}'
        if bag.exists():
            raise ParameterError(f'{bag} exists; name another folder')
    with tempfile.TemporaryDirectory() as logs:
        for k in tqdm(runs, desc='friction runs', disable=None):
            bag = options.output / f'friction_{k + 1}'
            record_friction_run(bag, Path(logs), seed=options.seed + k, rate=options.rate)
    return 0


def _identify_friction(options: argparse.Namespace) -> int:
    settings = FrictionSettings(
        **{item.name: getattr(options, item.name) for item in fields(FrictionSettings)}
    )
    check_distinct(options.bags)
    estimates = []
    for bag in tqdm(options.bags, desc='bags', disable=None, leave=False):
        recording = read_friction_recording(
            bag,
            wrench_topic=options.wrench_topic,
            motion_topic=options.motion_topic,
            force_axis=options.force_axis,
        )
        for loss in recording.losses:
            sys.stderr.write(f'warning: {recording.name}: {loss}\n')
        estimates.append(identify_friction(recording, settings))
    summary = summarize(estimates)
    if options.output is not None:
        write_result(options.output, summary)
    text = json.dumps(_as_json(summary), indent=2) if options.json else _as_table(summary)
    sys.stdout.write(f'{text}\n')
    return 0


def _as_table(summary: FrictionSummary) -> str:
    rows = [
        (
            estimate.name,
            f'{estimate.coulomb_friction:.4f} ± {estimate.coulomb_error:.4f}',
            f'{estimate.viscous_friction:.3f} ± {estimate.viscous_error:.3f}',
            f'{estimate.samples}',
            f'{estimate.residual:.4f}',
        )
        for estimate in summary.estimates
    ]
    c, v = summary.coulomb, summary.viscous
    if c.deviation is not None and v.deviation is not None:
        rows.append(('STD over bags', f'{c.deviation:.4f}', f'{v.deviation:.3f}', '', ''))
    rows.append(
        ('mean ± its SE', f'{c.mean:.4f} ± {c.error:.4f}', f'{v.mean:.3f} ± {v.error:.3f}', '', '')
    )
    heads = ('bag', 'mu_s [N] ± SE', 'mu_v [N s/m] ± SE', 'samples', 'residual [N]')
    return table(rows, heads)


def _as_json(summary: FrictionSummary) -> dict[str, Any]:
    def values(record: Any) -> dict[str, Any]:
        return {item.name: getattr(record, item.name) for item in fields(record)}

    return {
        'coulomb_friction': {**values(summary.coulomb), 'unit': 'N'},
        'viscous_friction': {**values(summary.viscous), 'unit': 'N s/m'},
        'bags': [values(estimate) for estimate in summary.estimates],
    }


if __name__ == '__main__':
    sys.exit(main())
