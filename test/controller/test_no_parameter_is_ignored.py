# SPDX-License-Identifier: Apache-2.0
"""Every parameter has effect: each is read, and each friction constant changes the command."""

import ast
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from importlib import import_module
from inspect import getmembers, isclass
from pathlib import Path
from typing import Any

from needle_controller import Controller, Measurement, PidGains
from needle_dynamics import NeedleParameters
from needle_dynamics.compiled.friction import FrictionConstants
import pytest

ROOT = Path(__file__).parents[2]
PERIOD = 1e-3
#: Functions of `needle_ros.settings` that declare a field.
DECLARE = ('constant', 'positive', 'choice', 'flag', 'text')
SOURCES = {
    path.relative_to(ROOT): ast.parse(path.read_text(encoding='utf-8'))
    for path in sorted(ROOT.glob('needle_*/**/*.py'))
}
#: Metadata of a field that is declared by them; a status has others.
DECLARED = {'low', 'valid', 'type'}
#: Methods of a node that declare a parameter, and that read one.
DECLARE_ROS = ('declare_text', 'declare_parameter')
READ_ROS = ('text', 'get_parameter', 'get', 'value')


def settings_classes() -> list[type]:
    """Return every dataclass of the packages with a field that is declared by `DECLARE`."""
    found = set()
    for path, tree in SOURCES.items():
        if any(isinstance(one, ast.FunctionDef) and one.name in DECLARE for one in tree.body):
            continue
        if not set(DECLARE) & {one.id for one in ast.walk(tree) if isinstance(one, ast.Name)}:
            continue
        module = import_module('.'.join(path.with_suffix('').parts))
        for _, one in getmembers(module, isclass):
            if is_dataclass(one) and DECLARED & {
                key for item in fields(one) for key in item.metadata
            }:
                found.add(one)
    return sorted(found, key=lambda one: one.__name__)


SETTINGS = settings_classes()


def names_read() -> Iterator[str]:
    """Yield every attribute that code of the packages reads, checks of the values left out."""
    for path, tree in SOURCES.items():
        for node in ast.walk(tree):
            # Checks of a value are ignored, except where laws are created.
            if isinstance(node, ast.FunctionDef) and node.name == '__post_init__':
                node.body = [] if '_set_constants' not in ast.unparse(node) else node.body
            if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
                yield node.attr
            # Attributes by name: of each layer, and of forces and torques.
            text = str(node.value) if isinstance(node, ast.Constant) else ''
            if path.name == 'force_sensor.py':
                yield from (f'force_{text}', f'torque_{text}')
            elif path.parts[-2:] == ('steering', 'insertion.py'):
                yield text


READ = frozenset(names_read())


@pytest.mark.parametrize('settings', [*SETTINGS, FrictionConstants], ids=lambda one: one.__name__)
def test_every_parameter_is_read(settings: Any) -> None:
    """By its name, in computing code."""
    known: Any = getattr(settings, '_fields', None) or [one.name for one in fields(settings)]
    assert set(known) <= READ


def test_settings_classes_of_all_packages_are_found() -> None:
    packages = {one.__module__.partition('.')[0] for one in SETTINGS}
    assert packages == {
        f'needle_{name}'
        for name in ('controller', 'dynamics', 'identification', 'insertion', 'planning', 'study')
    }


def called(tree: ast.AST, methods: tuple[str, ...]) -> set[str]:
    """Return the first arguments of the calls of methods of a node."""
    return {
        ast.unparse(node.args[0])
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
        and node.func.attr in methods and node.args
    }  # fmt: skip


ROS = [
    (path, name) for path, tree in SOURCES.items() for name in sorted(called(tree, DECLARE_ROS))
]
#: Parameters by a name that is computed: fields of dataclasses, and the method itself.
ROS = [(path, name) for path, name in ROS if path.name != 'parameter_node.py']


@pytest.mark.parametrize(('path', 'name'), ROS, ids=str)
def test_every_other_ros_parameter_is_read_by_its_node(path: Path, name: str) -> None:
    """In its file, or by the functions that start the node."""
    files = [SOURCES[path]]
    if path.name == 'base_node.py':
        files.append(SOURCES[path.with_name('run_node.py')])
    subscripts = {
        ast.unparse(node.slice)
        for tree in files
        for node in ast.walk(tree)
        if isinstance(node, ast.Subscript)
    }
    assert name in subscripts.union(*(called(tree, READ_ROS) for tree in files))


def forces(law: str, gains: dict[str, Any], **changes: Any) -> list[float]:
    """Return the commands of a law to a needle that moves in, rests, and has a goal outside."""
    parameters = NeedleParameters.preset('phantom', **changes)
    controller = Controller(parameters, law, gains=gains)
    controller.set_target(0.05)
    found = []
    for i in range(40):
        speed = 0.002 if i < 20 else 0.0
        depth = 0.03 + 0.002 * PERIOD * min(i, 20)
        if i == 25:
            controller.set_target(0.01)
        now = i * PERIOD if i < 30 else i * PERIOD + 0.05 * (i - 29)
        measured = Measurement(time=now, depth=depth, velocity=speed)
        found.append(controller.command(measured).force)
    return found


@pytest.mark.parametrize('law', ['adaptive', 'inverse_dynamics', 'pid'])
@pytest.mark.parametrize(
    ('base', 'name', 'value'),
    [
        ({}, 'coulomb_friction', 0.7),
        ({}, 'viscous_friction', 320.0),
        ({}, 'withdrawal_friction', 0.6),
        ({}, 'friction_law', 'tanh'),
        ({'friction_law': 'stribeck', 'breakaway_friction': 1.2}, 'breakaway_friction', 1.5),
        ({'friction_law': 'stribeck', 'breakaway_friction': 1.2}, 'stribeck_speed', 5e-3),
        ({'friction_law': 'tanh'}, 'smoothing_speed', 1e-3),
    ],
)
def test_every_constant_of_friction_changes_the_command(
    law: str, base: dict[str, Any], name: str, value: Any
) -> None:
    """For each law; PID with feed-forward, because it does not compensate friction otherwise."""
    gains = {'pid': {'insertion': PidGains(feed_forward=True)}} if law == 'pid' else {}
    assert forces(law, gains, **base) != forces(law, gains, **{**base, name: value})
