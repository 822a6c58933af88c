# SPDX-License-Identifier: Apache-2.0
"""Check the content of a study file."""

from collections.abc import Iterable, Mapping
from typing import Any

from needle_ros.errors import ParameterError
from needle_ros.settings import check_choice, unknown_name


def check_names(where: str, given: Iterable[Any], valid: Iterable[str]) -> None:
    """Raise `ParameterError`, with the prefix `where`, if a name is not valid."""
    known = list(valid)
    for name in given:
        if name not in known:
            raise ParameterError(f'{where}{unknown_name(str(name), known)}')


def mapping(name: str, value: Any) -> Mapping[str, Any]:
    """Return a mapping of the file, empty for None; raise `ParameterError` otherwise."""
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise ParameterError(f'{name} must be names with values, got {value!r}')
    return value


def one_of(name: str, value: Any, valid: Iterable[str]) -> str:
    """Return a word of the file; raise `ParameterError` if it is not valid."""
    check_choice(name, value, tuple(valid))
    return str(value)
