"""What setup.py installs, read from setup.py itself."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from importlib import import_module
import inspect
from pathlib import Path

from needle_ros.base_node import BaseNode

ROOT = Path(__file__).parent.parent.parent


def _constant(name: str) -> Mapping[str, str]:
    """Return a constant of setup.py without running it."""
    for item in ast.parse((ROOT / 'setup.py').read_text()).body:
        if isinstance(item, ast.Assign) and ast.unparse(item.targets[0]) == name:
            return ast.literal_eval(item.value)
    raise KeyError(name)


#: Modules of the nodes by the name of their executable.
NODES = _constant('NODES')


def node_class(name: str) -> type[BaseNode]:
    """Return the class of the node that an executable runs."""
    module = NODES[name]
    (kind,) = (
        item
        for _, item in inspect.getmembers(import_module(module), inspect.isclass)
        if issubclass(item, BaseNode) and item.__module__ == module
    )
    return kind
