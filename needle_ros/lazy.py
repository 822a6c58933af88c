"""Lazy import of the public names of a package (PEP 562)."""

from __future__ import annotations

import ast
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
import sys
from typing import Any


def lazy_names(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """
    Return ``__getattr__`` and ``__dir__`` of a package, so that importing it is cheap.

    The names are those that its ``__init__.py`` imports under ``if TYPE_CHECKING:``, where type
    checkers see them; assign the two functions in the ``else`` branch.
    """
    module = sys.modules[package]
    modules = _modules_by_name(Path(str(module.__file__)).read_text(encoding='utf-8'))

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f'module {package!r} has no attribute {name!r}')
        value = getattr(import_module(modules[name]), name)
        setattr(module, name, value)
        return value

    return get, lambda: sorted({*vars(module), *modules})


def _modules_by_name(source: str) -> dict[str, str]:
    """Return the module of each name imported under ``if TYPE_CHECKING:``."""
    return {
        alias.name: str(imported.module)
        for branch in ast.parse(source).body
        if isinstance(branch, ast.If) and ast.unparse(branch.test) == 'TYPE_CHECKING'
        for imported in branch.body
        if isinstance(imported, ast.ImportFrom)
        for alias in imported.names
    }
