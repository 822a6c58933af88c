"""Command line `needle`: exit status 0 done, 1 the job failed, 2 bad usage or bad input."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
import signal
import sys
from types import FrameType
from typing import NoReturn

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


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
    # Loading takes a second, and leaves nothing to tidy up: a signal just ends it.
    previous = {name: signal.signal(name, signal.SIG_DFL) for name in _SIGNALS}
    try:
        return _run(words)
    finally:
        for name, handler in previous.items():
            signal.signal(name, handler)


def _run(words: list[str]) -> int:
    from needle_dynamics import JobError, NeedleError

    options = _parser().parse_args(_joined(words))
    try:
        # What was started is ended on the way out, whatever ends the command.
        for name in _SIGNALS:
            signal.signal(name, _interrupt)
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
    return status


def _interrupt(_signal: int, _frame: FrameType | None) -> NoReturn:
    # Once is enough: another signal must not break off the tidying up.
    for name in _SIGNALS:
        signal.signal(name, signal.SIG_IGN)
    raise KeyboardInterrupt


def _joined(words: list[str]) -> list[str]:
    """Join ``--force-axis -y``, which argparse would take for two options."""
    from needle_insertion.commands.identify import SIGNED

    joined: list[str] = []
    for word in words:
        signed = word.startswith('-') and not word.startswith('--')
        if joined and joined[-1] in SIGNED and signed:
            joined[-1] += f'={word}'
        else:
            joined.append(word)
    return joined


def _parser() -> argparse.ArgumentParser:
    from needle_insertion.commands import (
        analyze,
        identify,
        reproduce,
        simulate,
        verify,
    )
    from needle_insertion.experiment import protocol

    parser = argparse.ArgumentParser(prog='needle', description='Robot-assisted needle insertion.')
    parser.add_argument('--version', action='version', version=version('needle_insertion'))
    commands = parser.add_subparsers(required=True, metavar='COMMAND')

    demo = commands.add_parser('demo', help='insertion, recording, identification, one report')
    demo.add_argument('-o', '--output', type=Path, default=Path('demo_output'), help='folder')
    demo.add_argument(
        '--bags', type=Path, default=protocol.SHIPPED_BAGS, help='shipped recordings'
    )
    demo.set_defaults(command=_demo)

    identify.add_arguments(commands.add_parser('identify', help='fit parameters to recordings'))

    experiment = commands.add_parser('experiment', help='record an experiment on the stand-in')
    protocol.add_arguments(experiment)
    experiment.set_defaults(command=_experiment)

    paper = commands.add_parser('reproduce', help="the paper's results anew, beside the paper's")
    reproduce.add_arguments(paper)
    paper.set_defaults(command=_reproduce)

    open_loop = commands.add_parser('simulate', help='the open-loop needle, without ROS')
    simulate.add_arguments(open_loop)
    open_loop.set_defaults(command=simulate.run)

    analyze.add_arguments(commands.add_parser('analyze', help='controllability and observability'))

    again = commands.add_parser('verify', help='compute recorded runs anew and compare')
    verify.add_arguments(again)
    again.set_defaults(command=verify.run)

    bench = commands.add_parser('bench', help='measure speed as ratios, and errors')
    subjects = bench.add_subparsers(required=True, dest='subject', metavar='SUBJECT')
    for subject, asked in (
        ('dynamics', 'the integrator'),
        ('identification', 'bag to result'),
        ('control', 'a control step'),
    ):
        subjects.add_parser(subject, help=f'speed: {asked}').set_defaults(command=_bench)
    graph = subjects.add_parser('graph', help='speed: the nodes beside bare ones')
    length = graph.add_mutually_exclusive_group()
    length.add_argument('--full', action='store_true', help='record 60 s, watch memory 10 min')
    length.add_argument('--quick', action='store_true', help='a trial, too short for figures')
    graph.set_defaults(command=_bench)
    intervals = subjects.add_parser('calibration', help='do the intervals hold the truth?')
    intervals.add_argument(
        '--recordings', type=int, default=1000, metavar='N', help='simulated ones of each kind'
    )
    intervals.add_argument('--seed', type=int, default=2014, help='of the truth and of the noise')
    intervals.add_argument('--json', action='store_true', help='print JSON instead')
    intervals.set_defaults(command=_bench)
    return parser


def _bench(options: argparse.Namespace) -> int:
    # The benchmarks are not installed: they are run from a clone, which is not on the path.
    from needle_ros.errors import ParameterError

    root = Path(__file__).parents[1]
    if not (root / 'benchmarks').is_dir():
        raise ParameterError('needle bench needs a clone of the repository: benchmarks/ is there')
    sys.path.insert(0, str(root))
    own = options.subject in ('graph', 'calibration')
    benchmark = import_module(f'benchmarks.{options.subject}' if own else 'benchmarks.run')
    return int(benchmark.run(options))


def _demo(options: argparse.Namespace) -> int:
    from needle_insertion.commands import demo

    return demo.run(options.output, options.bags)


def _experiment(options: argparse.Namespace) -> int:
    from needle_insertion.experiment import experiment

    return experiment.run(options)


def _reproduce(options: argparse.Namespace) -> int:
    from needle_insertion.commands import reproduce

    recorded = None
    if options.record is not None:
        from needle_insertion.experiment import experiment

        recorded = {
            name: experiment.record(campaign, options.record)
            for name, campaign in reproduce.campaigns(options.what).items()
        }
    return reproduce.run(options, recorded)


if __name__ == '__main__':
    sys.exit(main())
