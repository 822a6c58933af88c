"""What the commands share: their form, model constants as words, folders for results."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Sequence
import json
import os
from pathlib import Path
from typing import Any, NamedTuple

from needle_ros.errors import ParameterError


class Command(NamedTuple):
    """
    A subcommand of `needle`: ``COMMAND`` of the module of its name.

    Attributes
    ----------
    add_arguments : callable
        Declares its options on a parser.
    run : callable
        Does the work, given the options, and returns the exit status. Raises a `JobError` if the
        job fails, and any other `NeedleError` if an option or an input is not valid.
    signed : tuple of str
        Options whose value may begin with a minus sign.

    """

    add_arguments: Callable[[ArgumentParser], None]
    run: Callable[[Namespace], int]
    signed: tuple[str, ...] = ()


def add_needle(parser: ArgumentParser) -> None:
    """
    Add the options that choose the constants of the model, ``--preset`` and ``--set``.

    Parameters
    ----------
    parser : ArgumentParser
        Parser of a command.

    """
    from needle_dynamics import DEFAULT_PRESET, PRESETS

    parser.add_argument(
        '--preset',
        choices=tuple(PRESETS),
        default=DEFAULT_PRESET,
        help=f'constants of needle and tissue (default {DEFAULT_PRESET})',
    )
    parser.add_argument(
        '--set',
        action='append',
        default=[],
        metavar='NAME=VALUE',
        help='any other constant of the model, SI units; repeatable',
    )


def constants(words: Sequence[str]) -> dict[str, Any]:
    """
    Read model constants given as words.

    Parameters
    ----------
    words : sequence of str
        ``name=value`` each; the value is JSON, or a plain word.

    Returns
    -------
    dict
        Values by name, for `NeedleParameters.preset`.

    Raises
    ------
    ParameterError
        If a word is not of that form.

    """
    values: dict[str, Any] = {}
    for word in words:
        name, sign, text = word.partition('=')
        if not sign:
            raise ParameterError(f'--set takes NAME=VALUE, got {word!r}')
        try:
            values[name] = json.loads(text)
        except json.JSONDecodeError:
            values[name] = text
    return values


def check_file(path: Path) -> None:
    """
    Check that a file can be written, before the work that gives its content.

    Parameters
    ----------
    path : Path
        The file; its folder must exist.

    Raises
    ------
    ParameterError
        If it cannot be written.

    """
    if not path.name or path.is_dir():
        raise ParameterError(f'{path} cannot be written: it is not the name of a file')
    if not path.absolute().parent.is_dir():
        raise ParameterError(f'{path} cannot be written: the folder it is in does not exist')
    check_folder(path.absolute().parent)


def check_folder(folder: Path) -> None:
    """
    Check that a folder can be made and written to, before the work for it; nothing is made.

    Parameters
    ----------
    folder : Path
        May exist, or lack some of the folders that it is in.

    Raises
    ------
    ParameterError
        If it cannot be made or written to.

    """
    there = folder.absolute()
    while not there.exists():
        there = there.parent
    if not there.is_dir():
        raise ParameterError(f'{folder} cannot be written: {there} is not a folder')
    if not os.access(there, os.W_OK | os.X_OK):
        raise ParameterError(f'{folder} cannot be written: no permission to write in {there}')


def make_folder(folder: Path) -> None:
    """
    Make a folder for results, with those that it is in.

    Parameters
    ----------
    folder : Path
        May exist.

    Raises
    ------
    ParameterError
        If it cannot be made.

    """
    check_folder(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ParameterError(f'{folder} cannot be written: {error.strerror}') from error
