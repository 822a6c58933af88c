# SPDX-License-Identifier: Apache-2.0
"""Nodes installed by setup.py."""

from __future__ import annotations

from importlib import import_module
import inspect
from pathlib import Path

from needle_insertion.nodes import NODES
from needle_ros.base_node import BaseNode

ROOT = Path(__file__).parent.parent.parent


def node_class(name: str) -> type[BaseNode]:
    """Return the node class of an executable."""
    module = NODES[name]
    (kind,) = (
        item
        for _, item in inspect.getmembers(import_module(module), inspect.isclass)
        if issubclass(item, BaseNode) and item.__module__ == module
    )
    return kind
