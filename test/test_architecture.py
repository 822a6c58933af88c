# SPDX-License-Identifier: Apache-2.0
"""Architecture rules: package dependencies, and separation of mathematics and middleware."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
import re

import pytest

ROOT = Path(__file__).resolve().parents[1]

#: Allowed imports between the packages.
MAY_IMPORT = {
    'needle_ros': set(),
    'needle_dynamics': {'needle_ros'},
    'needle_controller': {'needle_dynamics', 'needle_ros'},
    'needle_identification': {'needle_dynamics', 'needle_ros'},
    'needle_study': {'needle_controller', 'needle_dynamics', 'needle_ros'},
    'needle_planning': {'needle_controller', 'needle_dynamics', 'needle_ros', 'needle_study'},
    'needle_insertion': {
        'needle_controller',
        'needle_dynamics',
        'needle_identification',
        'needle_planning',
        'needle_ros',
        'needle_study',
    },
    'reproduction': {
        'needle_controller',
        'needle_dynamics',
        'needle_identification',
        'needle_insertion',
        'needle_planning',
        'needle_ros',
    },
    'benchmarks': {
        'needle_controller',
        'needle_dynamics',
        'needle_identification',
        'needle_insertion',
        'needle_planning',
        'needle_ros',
        'needle_study',
        'reproduction',
    },
    'tools': {'needle_insertion'},
}
#: Largest number of lines of a file.
MOST_LINES = 500
#: Packages without nodes.
NO_NODES = {'needle_planning', 'needle_study'}
#: These packages may import any external package.
TOP = {'needle_insertion', 'reproduction', 'benchmarks', 'tools'}
ROS = re.compile(r'(rclpy|rcl_\w+|ros\w+_py|ament_\w+|launch(_\w+)?|\w+_(msgs|srvs|interfaces))$')
BAGS = {'mcap', 'rosbags'}
BAG_READERS = 'needle_identification/bags/'
# Split, so that this file passes its own test.
FORBIDDEN = tuple('/'.join(parts) for parts in (('..', 'shared'), ('work', 'shared')))
NOT_OURS = {
    '.git',
    '.hypothesis',
    '.mypy_cache',
    '.pytest_cache',
    '.ruff_cache',
    '.venv',
    '__pycache__',
    'build',
    'demo_output',
    'dist',
    'install',
    'log',
}


def imports(path: str, tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and qualified name of all imports in the syntax tree of a file."""
    package = path.removesuffix('.py').split('/')[:-1]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            base = '.'.join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                yield node.lineno, f'{base}.{alias.name}'
        elif isinstance(node, ast.Call) and node.args:
            called = ast.unparse(node.func).rpartition('.')[2]
            name = node.args[0]
            if called in ('import_module', '__import__') and isinstance(name, ast.Constant):
                yield node.lineno, str(name.value)


def violations(path: str, source: str) -> list[str]:
    """Return the rule violations of a file; the path is relative to the root."""
    package = path.partition('/')[0]
    is_node = path.endswith('_node.py') and package not in NO_NODES
    found = []
    for line, name in imports(path, ast.parse(source, path)):
        root, *parts = name.split('.')
        where = f'{path}:{line}: '
        if root in MAY_IMPORT and root != package and root not in MAY_IMPORT[package]:
            found.append(f'{where}{package} must not import {root}')
        if package in TOP:
            continue
        if not is_node and ROS.match(root):
            found.append(f'{where}only *_node.py may import {root}')
        if not is_node and root in MAY_IMPORT and any(part.endswith('_node') for part in parts):
            found.append(f'{where}only *_node.py may import a node, {name}')
        if root in BAGS and not path.startswith(BAG_READERS):
            found.append(f'{where}only {BAG_READERS} may import {root}')
    return sorted(set(found))


class WithoutFunctions(ast.NodeTransformer):
    """Remove all functions of a syntax tree."""

    def visit_FunctionDef(self, _node: ast.FunctionDef) -> None:
        """Remove a function."""


def import_circle(files: Mapping[str, str]) -> list[str]:
    """Return a circle of modules that import each other when they are imported, or []."""
    paths = {
        path.removesuffix('.py').removesuffix('/__init__').replace('/', '.'): path
        for path in files
    }
    graph = {}
    for module, path in paths.items():
        tree = WithoutFunctions().visit(ast.parse(files[path], path))
        found = [name for _, name in imports(path, tree)]
        # A name is a module, or a name in a module.
        used = {name if name in paths else name.rpartition('.')[0] for name in found}
        graph[module] = (used & paths.keys()) - {module}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def repeated_classes(files: Mapping[str, str]) -> list[str]:
    """Return the public names of classes that several files define, with the files."""
    found: dict[str, list[str]] = {}
    for path, source in files.items():
        for node in ast.parse(source, path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith('_'):
                found.setdefault(node.name, []).append(path)
    return [f'{name}: {", ".join(paths)}' for name, paths in found.items() if len(paths) > 1]


def long_files(files: Mapping[str, str]) -> list[str]:
    """Return the files with too many lines, with their number of lines."""
    counts = {path: len(source.splitlines()) for path, source in files.items()}
    return [f'{path}: {count}' for path, count in counts.items() if count > MOST_LINES]


def forbidden_words(path: str, content: str) -> list[str]:
    """Return the lines with a word that must not be published."""
    return [
        f'{path}:{number}: mentions {word}'
        for number, line in enumerate(content.splitlines(), 1)
        for word in FORBIDDEN
        if word in line
    ]


def sources() -> dict[str, str]:
    """Return the Python files of the packages, by their paths relative to the root."""
    return {
        path.relative_to(ROOT).as_posix(): path.read_text('utf-8')
        for package in MAY_IMPORT
        for path in sorted((ROOT / package).rglob('*.py'))
    }


def texts() -> Iterator[Path]:
    """List all files of the repository except generated files."""
    pending = [ROOT]
    while pending:
        for path in sorted(pending.pop().iterdir()):
            if path.name in NOT_OURS or path.name.endswith('.egg-info') or path.is_symlink():
                continue
            if path.is_dir():
                pending.append(path)
            else:
                yield path


def test_packages_import_lower_layers_only() -> None:
    """Packages import downwards, and ROS and bags only in the designated files."""
    broken = [line for path, source in sources().items() for line in violations(path, source)]
    assert not broken, '\n'.join(broken)


def test_all_packages_are_checked() -> None:
    """The rules cover every package, and each has files."""
    there = {path.parent.name for path in ROOT.glob('*/__init__.py')}
    assert there == set(MAY_IMPORT)
    assert there == {path.partition('/')[0] for path in sources()}


def test_files_do_not_import_each_other_in_circles() -> None:
    """Every file can be read after the files that it imports."""
    assert import_circle(sources()) == []


def test_names_of_public_classes_are_unique() -> None:
    """A name of a class identifies it, in all packages."""
    assert repeated_classes(sources()) == []


def test_files_are_short() -> None:
    """One concept per file."""
    assert long_files(sources()) == []


def test_no_file_mentions_a_forbidden_word() -> None:
    """No file of the repository refers to a place outside of it."""
    seen, broken = set(), []
    for path in texts():
        name = path.relative_to(ROOT).as_posix()
        seen.add(name)
        broken += forbidden_words(name, path.read_text('utf-8', errors='replace'))
    assert {'pyproject.toml', 'test/test_architecture.py', 'needle_dynamics/model.py'} <= seen
    assert not broken, '\n'.join(broken)


@pytest.mark.parametrize(
    ('path', 'source', 'complaint'),
    [
        ('needle_dynamics/a.py', 'import needle_controller', 'not import needle_controller'),
        ('needle_dynamics/a.py', 'import needle_insertion.cli', 'not import needle_insertion'),
        (
            'needle_controller/a.py',
            'from needle_identification.estimation.estimate import fit',
            'not import needle_identification',
        ),
        (
            'needle_identification/a_node.py',
            'import needle_controller as c',
            'not import needle_controller',
        ),
        (
            'needle_identification/sub/a.py',
            'import needle_insertion',
            'not import needle_insertion',
        ),
        ('needle_controller/a.py', 'from needle_study import engine', 'not import needle_study'),
        ('needle_study/a.py', 'import needle_insertion.cli', 'not import needle_insertion'),
        ('needle_study/a.py', 'import needle_planning', 'not import needle_planning'),
        ('needle_study/a_node.py', 'import rclpy', 'may import rclpy'),
        ('needle_planning/a_node.py', 'import rclpy', 'may import rclpy'),
        ('needle_study/a.py', 'from needle_ros.base_node import x', 'import a node'),
        ('needle_insertion/a.py', 'import reproduction.command', 'not import reproduction'),
        ('needle_insertion/a.py', "import_module('benchmarks.run')", 'not import benchmarks'),
        ('reproduction/a.py', 'from benchmarks import run', 'not import benchmarks'),
        ('needle_dynamics/a.py', 'import rclpy', 'may import rclpy'),
        ('needle_dynamics/a.py', 'import numpy, rclpy.node', 'may import rclpy'),
        ('needle_dynamics/a.py', 'def f():\n    from rclpy.node import Node', ':2: only'),
        ('needle_dynamics/a.py', 'if TYPE_CHECKING:\n    import std_msgs.msg', 'import std_msgs'),
        ('needle_controller/a.py', 'from std_srvs.srv import Trigger', 'may import std_srvs'),
        (
            'needle_controller/a.py',
            'from builtin_interfaces.msg import Time',
            'builtin_interfaces',
        ),
        ('needle_controller/node.py', 'import rclpy', 'may import rclpy'),
        ('needle_dynamics/a.py', "importlib.import_module('rclpy')", 'may import rclpy'),
        ('needle_dynamics/a.py', "__import__('sensor_msgs.msg')", 'may import sensor_msgs'),
        ('needle_dynamics/__init__.py', 'from .plant_node import PlantNode', 'import a node'),
        ('needle_dynamics/__init__.py', 'from . import plant_node', 'import a node'),
        ('needle_controller/a.py', 'from needle_dynamics import base_node', 'import a node'),
        ('needle_controller/a.py', 'import rosbags.rosbag2', 'may import rosbags'),
        ('needle_identification/a_node.py', 'from mcap.reader import x', 'may import mcap'),
    ],
)
def test_rule_violation_is_reported(path: str, source: str, complaint: str) -> None:
    """Each violation is reported with its file and line."""
    found = violations(path, source)
    assert len(found) == 1
    assert found[0].startswith(f'{path}:')
    assert complaint in found[0]


@pytest.mark.parametrize(
    ('path', 'source'),
    [
        ('needle_dynamics/a.py', 'from needle_dynamics.modes import x\nfrom . import model'),
        ('needle_controller/a.py', 'import needle_dynamics'),
        ('needle_controller/a_node.py', 'import rclpy\nfrom needle_ros.base_node import x'),
        ('needle_ros/base_node.py', 'from rcl_interfaces.msg import SetParametersResult'),
        ('needle_identification/bags/bag.py', 'import mcap\nfrom rosbags.typesys import Stores'),
        ('needle_insertion/a.py', 'import rclpy, rosbags, needle_controller.controller_node'),
        ('needle_dynamics/a.py', '"""import rclpy"""\nTEXT = "import rclpy"'),
    ],
)
def test_allowed_imports_are_not_reported(path: str, source: str) -> None:
    assert violations(path, source) == []


@pytest.mark.parametrize('word', FORBIDDEN)
def test_forbidden_word_is_reported(word: str) -> None:
    assert forbidden_words('docs/a.md', f'one\nsee {word}/model.md') == [
        f'docs/a.md:2: mentions {word}'
    ]
    assert forbidden_words('docs/a.md', 'shared work') == []


def test_import_circle_is_reported() -> None:
    """Imports inside functions do not count."""
    files = {
        'needle_ros/a.py': 'from needle_ros import b',
        'needle_ros/b.py': 'class B:\n    from needle_ros.c import C',
        'needle_ros/c.py': 'from needle_ros.a import A\nclass C:\n    pass',
    }
    assert set(import_circle(files)) == {'needle_ros.a', 'needle_ros.b', 'needle_ros.c'}
    later = {**files, 'needle_ros/c.py': 'def f():\n    import needle_ros.a'}
    assert import_circle(later) == []


def test_repeated_class_is_reported() -> None:
    files = {
        'needle_ros/a.py': 'class A:\n    class B:\n        pass\nclass _C:\n    pass',
        'tools/a.py': 'class A:\n    pass\nclass B:\n    pass\nclass _C:\n    pass',
    }
    assert repeated_classes(files) == ['A: needle_ros/a.py, tools/a.py']


def test_long_file_is_reported() -> None:
    files = {'tools/a.py': '\n' * MOST_LINES, 'tools/b.py': '\n' * (MOST_LINES + 1)}
    assert long_files(files) == [f'tools/b.py: {MOST_LINES + 1}']
