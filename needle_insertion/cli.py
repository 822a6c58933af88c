# SPDX-License-Identifier: Apache-2.0
"""
Run the command line `needle`.

Exit status: 0 success, 1 failed job, 2 invalid usage or input, 128 + the number of a signal.
"""

import argparse
from codecs import register_error
from collections.abc import Iterator, Mapping, Sequence
import errno
from importlib import import_module
from io import TextIOWrapper
import os
from pathlib import Path
import re
import shlex
import signal
import sys
from types import FrameType, ModuleType
from typing import Any, Final, NoReturn

from needle_insertion.report.made import COMMAND
from needle_ros.errors import JobError, missing_ros, NeedleError, ParameterError
from needle_ros.process import ENDINGS

#: Help text of each subcommand; key: its module in `needle_insertion.commands`, or in `ABOVE`.
COMMANDS: Final[Mapping[str, str]] = {
    'compile': 'compile all functions for this machine, once',
    'demo': 'insertion, recording, identification and a report (from a clone)',
    'run': 'start the nodes and send them targets',
    'watch': 'show a live insertion or a bag in a browser',
    'inspect': 'list the contents of recordings, and how to identify from them',
    'identify': 'fit parameters to recordings',
    'experiment': 'record an experiment on the simulated robot',
    'reproduce': "compute the paper's results and compare them with the paper",
    'simulate': 'simulate the needle in open loop, without ROS',
    'plan': 'find an entry point and a needle path in a segmented image',
    'steer': 'steer a simulated needle to a target, without ROS',
    'study': 'estimate the hit probability in a population of insertions',
    'analyze': 'controllability and observability',
    'verify': 'compute recorded runs again and compare',
    'bench': 'measure speed and accuracy (from a clone)',
}

#: Modules of the subcommands in ``reproduction`` and ``benchmarks``, which import this package;
#: they are imported by name when the subcommand runs.
ABOVE: Final[Mapping[str, str]] = {
    'demo': 'reproduction.demo_command',
    'experiment': 'reproduction.experiment_command',
    'reproduce': 'reproduction.command',
    'bench': 'benchmarks.run',
}

_ROOT: Final = Path(__file__).parents[1]

#: Errors of a disk, with any input.
_DISK: Final = (errno.ENOSPC, errno.EDQUOT, errno.EIO)

#: ASCII substitutes of table characters, by character.
_PLAIN: Final = {'±': '+-', '−': '-', '–': '-'}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line with the words after the program name; return the exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if '_ARGCOMPLETE' in os.environ:
        # Shell completion request.
        words = os.environ.get('COMP_LINE', '').split()[1:]
    register_error('plain', _plain)
    for output in ('stdout', 'stderr'):
        if getattr(sys, output) is None:
            # Closed by the caller, as by `>&-`; else the next opened file would replace it.
            setattr(sys, output, Path(os.devnull).open('w', encoding='utf-8'))  # noqa: SIM115
        elif isinstance(stream := getattr(sys, output), TextIOWrapper):
            stream.reconfigure(errors='plain')
    # Imports take up to a second and need no clean-up: a signal ends the process at once.
    previous = {name: signal.signal(name, signal.SIG_DFL) for name in ENDINGS}
    try:
        return _run(words)
    except ModuleNotFoundError as error:
        sys.stderr.write(f'error: {missing_ros(error, shlex.join(["needle", *words[:1]]))}\n')
        return 1
    except (NeedleError, OSError) as error:
        sys.stderr.write(f'error: {error}\n')
        return _status(error)
    except KeyboardInterrupt as error:
        sys.stderr.write('interrupted\n')
        return 128 + int(error.args[0] if error.args else signal.SIGINT)
    finally:
        for name, handler in previous.items():
            signal.signal(name, handler)


def _status(error: NeedleError | OSError) -> int:
    if isinstance(error, OSError):
        return 1 if error.errno in _DISK else 2
    return 1 if isinstance(error, JobError) and not isinstance(error, ParameterError) else 2


def _plain(error: UnicodeError) -> tuple[str, int]:
    """Replace characters that the terminal cannot encode, as an error handler of `codecs`."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = error.object[error.start : error.end]
    return ''.join(_PLAIN.get(character, '?') for character in text), error.end


def _run(words: list[str]) -> int:
    chosen = next((word for word in words if not word.startswith('-')), '')
    command: ModuleType | None = None
    COMMAND.set(shlex.join(['needle', *words]))
    if chosen in COMMANDS:
        command = _load(chosen)
        at = words.index(chosen) + 1
        # A completion must not read recordings.
        if '_ARGCOMPLETE' not in os.environ:
            words = [*words[:at], *getattr(command, 'completed', list)(words[at:])]
        words = _joined(words, getattr(command, 'SIGNED', ()))
    parser = _parser(chosen, command)
    if '_ARGCOMPLETE' in os.environ:
        import argcomplete

        argcomplete.autocomplete(parser)
    options = parser.parse_args([_as_value(word) for word in words])
    # From here on a signal must end the nodes that the command has started.
    for name in ENDINGS:
        signal.signal(name, _interrupt)
    status: int = command.run(options)  # type: ignore[union-attr]
    return status


def _interrupt(number: int, _frame: FrameType | None) -> NoReturn:
    # A second signal must not interrupt the clean-up.
    for name in ENDINGS:
        signal.signal(name, signal.SIG_IGN)
    raise KeyboardInterrupt(number)


def _load(name: str) -> ModuleType:
    if name == 'bench':
        if not (_ROOT / 'benchmarks').is_dir():
            _Parser(prog='needle bench').error(
                'only a clone of the repository has the benchmarks; run it from there'
            )
        # The clone is not on the import path.
        sys.path.insert(0, str(_ROOT))
    return import_module(ABOVE.get(name, f'needle_insertion.commands.{name}'))


def _parser(chosen: str, command: ModuleType | None) -> argparse.ArgumentParser:
    """Return a parser with the options of the chosen command only: other commands cost imports."""
    parser = _Parser(prog='needle', description='Robot-assisted needle insertion.')
    parser.add_argument('--version', action=_Version, nargs=0, help='show the version and exit')
    commands = parser.add_subparsers(required=True, metavar='COMMAND')
    for name, words in COMMANDS.items():
        subparser = commands.add_parser(name, help=words)
        if command is not None and name == chosen:
            command.add_arguments(subparser)
    return parser


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        # Imported here: the help does not need it.
        from difflib import get_close_matches

        message = re.sub(r"invalid int value: ('.*')$", r'must be a whole number, got \1', message)
        if wrong := re.search(r"invalid choice: '([^']*)'", message):
            known = [str(choice) for action in self._actions for choice in action.choices or ()]
            near = get_close_matches(wrong[1], known, 1)
        else:
            _, _, words = message.partition('unrecognized arguments: ')
            given = [word.partition('=')[0] for word in words.split() if word.startswith('-')]
            options: dict[str, list[str]] = {}
            for name, command in self._options():
                options.setdefault(name, []).append(command)
            others = [
                f'{word} is an option of {" and ".join(options[word])}'
                for word in given
                if word in options
            ]
            if others:
                self.exit(2, f'{self.prog}: error: {message}; {", ".join(others)}\n')
            # Without the dashes, which all options have in common.
            names = {name.lstrip('-'): name for name in options}
            near = [
                names[name]
                for word in given
                for name in get_close_matches(word.lstrip('-'), names, 1)
            ]
        if near:
            message += f'; did you mean {", ".join(near)}?'
        elif 'invalid' not in message:
            message += '; --help lists all arguments'
        self.exit(2, f'{self.prog}: error: {message}\n')

    def _options(self) -> Iterator[tuple[str, str]]:
        """Yield each option of this command and of its subcommands with the command."""
        yield from ((name, self.prog) for name in self._option_string_actions)
        for action in self._actions:
            for parser in action.choices or ():
                if isinstance(action.choices, Mapping):
                    yield from action.choices[parser]._options()


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_rest: Any) -> None:
        # Imported here: takes as long as all other imports of the help.
        from importlib.metadata import version

        sys.stdout.write(f'{version("needle_insertion")}\n')
        parser.exit()


def _as_value(word: str) -> str:
    """Prefix a negative number such as ``-5mm`` with a space, or argparse reads an option."""
    return f' {word}' if re.match(r'-(\.?\d|inf|nan)', word) else word


def _joined(words: list[str], signed: Sequence[str]) -> list[str]:
    """Join ``--force-axis -y`` with an equals sign, or argparse reads a second option."""
    joined: list[str] = []
    for word in words:
        has_sign = word.startswith('-') and not word.startswith('--')
        if joined and joined[-1] in signed and has_sign:
            joined[-1] += f'={word}'
        else:
            joined.append(word)
    return joined


if __name__ == '__main__':
    sys.exit(main())
