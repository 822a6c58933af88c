# SPDX-License-Identifier: Apache-2.0
"""Lazy import of the public names of a package (PEP 562)."""

import ast
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
import sys
from typing import Any


def lazy_names(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """
    Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package that is cheap to import.

    Its ``__init__.py`` imports the names under ``if TYPE_CHECKING:``, and else assigns the three.
    """
    module = sys.modules[package]
    modules = _modules_by_name(Path(str(module.__file__)).read_text(encoding='utf-8'))

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f'module {package!r} has no attribute {name!r}')
        value = getattr(import_module(modules[name]), name)
        setattr(module, name, value)
        return value

    names = sorted(modules, key=lambda name: (not name.isupper(), name))
    return get, lambda: sorted({*vars(module), *names}), names


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
