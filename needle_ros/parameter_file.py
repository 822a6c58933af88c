# SPDX-License-Identifier: Apache-2.0
"""Parameters of nodes in a ROS parameter file."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

from needle_ros.errors import ParameterError
from needle_ros.files import DocumentError, read_document, read_yaml

MARK: Final = 'ros__parameters'  #: Key of the parameters in a section of a file.


def sections_of(document: Any, namespace: str = '') -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the name of each node in a file, without the first ``/``, and its parameters."""
    for name, below in document.items() if isinstance(document, Mapping) else ():
        path = f'{namespace}/{name}'.strip('/')
        if isinstance(below, Mapping) and MARK in below:
            found = below[MARK]
            yield path, found if isinstance(found, Mapping) else {}
        else:
            yield from sections_of(below, path)


def read_sections(path: str) -> list[tuple[str, Mapping[str, Any]]]:
    """Return the sections of a parameter file; `ParameterError` if it has none."""
    document = read_yaml(path)
    if found := list(sections_of(document)):
        return found
    keys = [str(name) for name in document] if isinstance(document, Mapping) else []
    below = document[next(iter(document))] if keys else None
    keys += [f'{keys[0]}.{name}' for name in below] if isinstance(below, Mapping) else []
    raise ParameterError(
        f'{path} has no parameters of a node: a key {MARK!r} below the name of a node is needed, '
        f'found {", ".join(map(repr, keys[:4])) or "no keys"}'
    )


def parameters_by_node(text: str) -> dict[str, dict[str, Any]]:
    """Return the parameters by node in the text of a file; {} if it is not a parameter file."""
    try:
        found = sections_of(read_document(text))
    except DocumentError:
        return {}
    return {node: {str(key): one for key, one in values.items()} for node, values in found}


def parameters_in(text: str) -> dict[str, Any]:
    """Return the parameters of the first node of a file; {} if it is not a parameter file."""
    return next(iter(parameters_by_node(text).values()), {})
