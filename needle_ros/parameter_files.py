# SPDX-License-Identifier: Apache-2.0
"""Match the sections of ROS parameter files to nodes; rcl reports no unused section."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
import re
from typing import Any, NamedTuple

import yaml

_MARK = 'ros__parameters'


class ParameterSection(NamedTuple):
    """Section of a parameter file, with the names of its parameters."""

    file: str
    #: Full name of the nodes; ``*`` matches one name, ``**`` any number of names.
    nodes: str
    names: frozenset[str]

    def is_for(self, node: str) -> bool:
        """Return whether the section applies to a node with a full name such as ``/plant``."""
        parts = [part for part in self.nodes.split('/') if part]
        pattern = ''.join(
            '(/[^/]+)*' if part == '**' else '/[^/]+' if part == '*' else '/' + re.escape(part)
            for part in parts
        )
        return re.fullmatch(pattern, node) is not None


def sections(arguments: Sequence[str]) -> list[ParameterSection]:
    """Read the parameter files of a command line that rcl has already parsed."""
    files = [file for flag, file in pairwise(arguments) if flag == '--params-file']
    return [
        ParameterSection(file, f'/{name}', frozenset(_flat(values)))
        for file in files
        for name, values in _nodes(yaml.safe_load(Path(file).read_text(encoding='utf-8')))
    ]


def unmatched_files(found: Sequence[ParameterSection], node: str) -> list[str]:
    """Return a warning for each file without a section for a node."""
    lines = []
    for file in dict.fromkeys(section.file for section in found):
        own = [section for section in found if section.file == file]
        if not any(section.is_for(node) for section in own):
            others = ', '.join(section.nodes for section in own)
            lines.append(f'{file} has no parameters for {node}, only for {others}')
    return lines


def shared_names(found: Sequence[ParameterSection], node: str) -> frozenset[str]:
    """Return the parameters that wildcard sections (``/**``) set for a node."""
    shared = (one for one in found if '*' in one.nodes.rpartition('/')[2] and one.is_for(node))
    return frozenset(name for section in shared for name in section.names)


def _nodes(content: Any, namespace: str = '') -> Iterator[tuple[str, Mapping[str, Any]]]:
    for name, below in content.items() if isinstance(content, Mapping) else ():
        path = f'{namespace}/{name}'.strip('/')
        if isinstance(below, Mapping) and _MARK in below:
            yield path, below[_MARK] or {}
        else:
            yield from _nodes(below, path)


def _flat(values: Mapping[str, Any], prefix: str = '') -> Iterator[str]:
    """Yield the dotted names of nested parameters."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f'{prefix}{name}.')
        else:
            yield f'{prefix}{name}'
