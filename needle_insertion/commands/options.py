"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Sequence
import json
from pathlib import Path
from typing import Any

from needle_ros.errors import ParameterError


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
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ParameterError(f'{folder} cannot be written: {error.strerror}') from error
