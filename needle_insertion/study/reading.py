"""What is read of a study file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from needle_ros.errors import ParameterError
from needle_ros.settings import unknown_name


def check_names(where: str, given: Iterable[Any], valid: Iterable[str]) -> None:
    """
    Check that all names are known.

    Parameters
    ----------
    where : str
        What the message begins with.
    given : iterable
        Names of the file.
    valid : iterable of str
        Valid ones.

    Raises
    ------
    ParameterError
        If one is not.

    """
    known = list(valid)
    for name in given:
        if name not in known:
            raise ParameterError(f'{where}{unknown_name(str(name), known)}')


def mapping(name: str, value: Any) -> Mapping[str, Any]:
    """
    Return names with values.

    Parameters
    ----------
    name : str
        What it is, for the message.
    value : object
        What the file says; None for nothing.

    Returns
    -------
    dict
        The same.

    Raises
    ------
    ParameterError
        If it is something else.

    """
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise ParameterError(f'{name} must be names with values, got {value!r}')
    return value


def one_of(name: str, value: Any, valid: Iterable[str]) -> str:
    """
    Return a word that is one of some.

    Parameters
    ----------
    name : str
        What it is, for the message.
    value : object
        What the file says.
    valid : iterable of str
        Valid words.

    Returns
    -------
    str
        The same.

    Raises
    ------
    ParameterError
        If it is something else.

    """
    words = tuple(valid)
    if value not in words:
        raise ParameterError(f'{name} must be one of {", ".join(words)}, got {value!r}')
    return str(value)
