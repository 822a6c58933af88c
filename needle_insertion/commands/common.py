# SPDX-License-Identifier: Apache-2.0
"""Shared parts of the commands: options, model constants from words, results and their folders."""

from argparse import _ArgumentGroup, Action, ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable, Iterable, Sequence
import json
import os
from pathlib import Path
import sys
from typing import Any

from needle_ros.errors import ParameterError, shown
from needle_ros.quantities import EXAMPLES, quantity

#: End of the help on recordings.
SKIPPED = '; an unusable recording is reported and skipped, and the exit status is 2'


def add_needle(parser: ArgumentParser, default: str | None, otherwise: str = '') -> None:
    """Add the option ``--needle``; ``otherwise`` describes the default if it is None."""
    from needle_dynamics.needles import NEEDLE_HELP, NEEDLES

    added: Any = parser.add_argument(
        '--needle',
        default=default,
        metavar='NAME',
        help=f'needle and tissue: {NEEDLE_HELP} (default {default or otherwise})',
    )
    added.completer = lambda **_: [*NEEDLES, *map(str, Path().glob('*.yaml'))]


class _Recordings(Action):
    """Store the recordings in each folder that is no bag itself."""

    def __call__(
        self, _parser: ArgumentParser, options: Namespace, values: Any, _option: str | None = None
    ) -> None:
        from needle_identification.recordings.folders import recordings_in

        setattr(options, self.dest, [one for path in values for one in recordings_in(path)])


def add_recordings(parser: ArgumentParser, otherwise: str = '', *, tables: bool = True) -> None:
    """Add the argument of recordings, with or without tables; ``otherwise`` ends its help."""
    kinds = 'rosbag2 folder, .mcap, .db3 or ROS 1 .bag file'
    parser.add_argument(
        'recordings',
        type=Path,
        nargs='+',
        action=_Recordings,
        metavar='RECORDING',
        help=f'{kinds}{", table (.csv, .tsv, .mat)" * tables}, or a folder of these{otherwise}',
    )


def add_time(reading: ArgumentParser | _ArgumentGroup) -> None:
    from needle_identification.recordings import TIMES

    reading.add_argument(
        '--time',
        choices=TIMES,
        default='header',
        help='time of a sample: stamp of its message or time of receipt (default header)',
    )


def add_output(parser: ArgumentParser | _ArgumentGroup, use: str = '') -> None:
    """Add the options of the results, of which the parameter file has a use."""
    parser.add_argument(
        '-o',
        '--output',
        type=Path,
        metavar='FILE',
        help=f'ROS parameter file with the result{use}',
    )
    add_flag(parser, '--json', 'print JSON instead of tables')


def words_of(text: str) -> list[str]:
    return [word.strip() for word in text.split(',')]


def with_unit(
    unit: str, read: Callable[[str, str], float | list[float]] = quantity
) -> dict[str, Any]:
    """Return type and word of an option for a quantity, such as ``50mm``."""

    def parse(text: str) -> float | list[float]:
        try:
            return read(text, unit)
        except ParameterError as error:
            raise ArgumentTypeError(str(error)) from None

    return {'type': parse, 'metavar': EXAMPLES.get(unit, unit)}


def add_flag(parser: ArgumentParser | _ArgumentGroup, name: str, meaning: str) -> None:
    parser.add_argument(name, action='store_true', help=meaning)


def add_topic(
    parser: ArgumentParser | _ArgumentGroup, name: str, of: str, otherwise: str = ''
) -> None:
    """Add the option of a topic, by default the only one of its type, or the one named."""
    default = f'the only such topic{otherwise and f", or {otherwise}"}'
    parser.add_argument(name, metavar='TOPIC', help=f'topic of {of} (default: {default})')


def add_quantity(
    parser: ArgumentParser | _ArgumentGroup,
    name: str,
    unit: str,
    meaning: str,
    default: Any = None,
    **options: Any,
) -> None:
    """Add an option for a quantity, or for several with the option `nargs`."""
    parser.add_argument(name, default=default, help=meaning, **with_unit(unit), **options)


def add_constants(parser: ArgumentParser, option: str, meaning: str) -> None:
    parser.add_argument(
        option,
        action='append',
        default=[],
        metavar='NAME=VALUE',
        help=f'{meaning}; in SI units, or with a unit as length=150mm; repeatable',
    )


def constants(words: Sequence[str], option: str = '--set') -> dict[str, Any]:
    """Parse ``name=value`` words into values by name; a value is YAML, as in a needle file."""
    # Imported here: the help does not need it.
    from needle_ros.files import read_value

    values: dict[str, Any] = {}
    for word in words:
        name, sign, text = word.partition('=')
        if not sign:
            raise ParameterError(f'{option} takes NAME=VALUE, got {word!r}')
        values[name] = read_value(text)
    return values


def print_result(
    document: object, text: str, files: Iterable[Path] = (), *, as_json: bool
) -> None:
    if as_json:
        sys.stdout.write(f'{json.dumps(document, indent=2)}\n')
    else:
        sys.stdout.write(''.join([f'{text}\n', *(f'wrote {path}\n' for path in files)]))


def try_write(path: Path | None, write: Callable[[Path], object]) -> tuple[list[Path], list[str]]:
    """Write a parameter file, if any; return it, or the error if no parameter is determined."""
    from needle_identification import IdentificationError

    if path is None:
        return [], []
    try:
        write(path)
    except IdentificationError as error:
        return [], [f'{path} is not written: {error}']
    return [path], []


def print_each(kind: str, lines: Iterable[object]) -> None:
    for line in lines:
        sys.stderr.write(shown(f'{kind}: {line}') + '\n')


def check_file(path: Path | None) -> None:
    """Raise `ParameterError` if a file cannot be written, before its content is computed."""
    if path is None:
        return
    if not path.name or path.is_dir():
        raise ParameterError(f'{path} cannot be written: it is not the name of a file')
    if not path.absolute().parent.is_dir():
        raise ParameterError(f'{path} cannot be written: its folder does not exist')
    check_folder(path.absolute().parent)


def check_folder(folder: Path | None) -> None:
    """Raise `ParameterError` if a folder cannot be created and written to; create nothing."""
    if folder is None:
        return
    there = folder.absolute()
    while not there.exists():
        there = there.parent
    if not there.is_dir():
        raise ParameterError(f'{folder} cannot be written: {there} is not a folder')
    if not os.access(there, os.W_OK | os.X_OK):
        raise ParameterError(f'{folder} cannot be written: no permission to write in {there}')


def make_folder(folder: Path) -> None:
    """Create a folder for results with its parents; raise `ParameterError` if that fails."""
    check_folder(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ParameterError(f'{folder} cannot be written: {error.strerror}') from error
