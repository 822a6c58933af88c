# SPDX-License-Identifier: Apache-2.0
"""Typed status of the nodes: mapping to and from key-value pairs."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
import re
from types import NoneType, SimpleNamespace, UnionType
from typing import Any, get_args, get_origin, get_type_hints

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_ros.errors import shown
from needle_ros.requests import Acknowledgement, RequestStatus, Verdict
from needle_ros.status import (
    ControllerPhase,
    ControllerStatus,
    InputStatus,
    LEVELS,
    NodeReport,
    NodeStatus,
    PlantStatus,
    read_reports,
    STATUSES,
    SteeringPhase,
    SteeringStatus,
)
import pytest

ROOT = Path(__file__).resolve().parents[2]

#: Names of topics, and texts without leading or trailing brackets.
NAMES = st.from_regex(r'[a-z/][a-z0-9_/]{0,12}', fullmatch=True)

REQUESTS = st.builds(
    RequestStatus,
    st.dictionaries(NAMES, st.lists(NAMES, max_size=3).map(tuple), max_size=2),
    st.lists(
        st.builds(
            Acknowledgement, NAMES, st.integers(0, 2**63 - 1), st.sampled_from(Verdict), st.text()
        ),
        max_size=3,
        unique_by=lambda one: (one.topic, one.stamp),
    ).map(tuple),
)


def values_of(hint: Any) -> st.SearchStrategy[Any]:
    """Return any values of a type of a field."""
    arguments = get_args(hint)
    if get_origin(hint) is UnionType:
        (inner,) = (one for one in arguments if one is not NoneType)
        return st.none() | values_of(inner)
    if hint is RequestStatus:
        return REQUESTS
    if is_dataclass(hint):
        return any_of(hint)
    if get_origin(hint) is Mapping:
        return st.dictionaries(NAMES, values_of(arguments[1]), max_size=3)
    if get_origin(hint) is tuple:
        return st.tuples(*map(values_of, arguments))
    if issubclass(hint, Enum):
        return st.sampled_from(hint)
    plain = {bool: st.booleans(), int: st.integers(), str: st.text()}
    return plain[hint] if hint in plain else st.floats(allow_nan=False)


def any_of(kind: Any) -> st.SearchStrategy[Any]:
    """Return any instances of a dataclass."""
    hints = get_type_hints(kind)
    return st.builds(kind, **{one.name: values_of(hints[one.name]) for one in fields(kind)})


def report(values: Mapping[str, str], name: str = '/a', level: bytes | int = 0) -> NodeReport:
    pairs = [SimpleNamespace(key=key, value=value) for key, value in values.items()]
    status = SimpleNamespace(name=name, level=level, message='', values=pairs)
    [found] = read_reports(SimpleNamespace(status=[status]))
    return found


@pytest.mark.parametrize('kind', STATUSES.values())
@settings(max_examples=50, deadline=None)
@given(data=st.data())
def test_status_round_trip(kind: type[NodeStatus], data: st.DataObject) -> None:
    """Exactly, with full precision; a received one without control characters."""
    status = data.draw(any_of(kind))
    values = status.to_values()
    assert all(isinstance(text, str) for pair in values.items() for text in pair)
    assert kind.from_values(values) == status
    safe = {shown(key): shown(value) for key, value in values.items()}
    assert report(values).status == kind.from_values(safe)


@pytest.mark.parametrize('kind', STATUSES.values())
@settings(max_examples=50, deadline=None)
@given(data=st.data())
def test_invalid_values_are_defaults(kind: type[NodeStatus], data: st.DataObject) -> None:
    """Any text in any pair is read without an error, as a value or as the default."""
    values = data.draw(any_of(kind)).to_values()
    changed = {key: data.draw(st.text() | st.just(text)) for key, text in values.items()}
    assert isinstance(kind.from_values(changed), kind)


def keys_of(kind: Any, prefix: str = '') -> set[str]:
    """Return the keys of all fields; `NAME` is the name of an entry of a mapping."""
    found, hints = set(), get_type_hints(kind)
    for one in fields(kind):
        hint = hints[one.name]
        inner = [part for part in (hint, *get_args(hint)) if is_dataclass(part)]
        key = f'{prefix}{one.name}'.replace('_', ' ')
        key += ' NAME' if get_origin(hint) is Mapping else ''
        unit = one.metadata['unit']
        if not inner:
            found.add(f'{key} [{unit}]' if unit else key)
        elif inner[0] is not RequestStatus:
            found |= keys_of(inner[0], f'{key} ')
    return found


@pytest.mark.parametrize('kind', STATUSES.values())
def test_keys_are_distinct(kind: type[NodeStatus]) -> None:
    """No key begins like the entries of a mapping of another field."""
    keys = keys_of(kind) | {'kind', 'paused', 'takes NAME', 'request NAME'}
    starts = {key.partition('NAME')[0] for key in keys if 'NAME' in key}
    for start in starts:
        mine = [key for key in keys if key.startswith(start)]
        assert all(key.startswith(f'{start}NAME') for key in mine), mine


def test_keys_and_texts() -> None:
    """Keys are names with units, for people and plots."""
    status = SteeringStatus(
        phase=SteeringPhase.INSERTING,
        target=(0.004, 0.1, -0.002),
        input={'joint_states': InputStatus(rate=1000.0, rejected={'not finite': 3})},
    )
    values = status.to_values()
    assert values['kind'] == 'steering'
    assert values['phase'] == 'inserting'
    assert values['target [m]'] == '0.004, 0.1, -0.002'
    assert values['input joint_states rate [Hz]'] == '1000.0'
    assert values['input joint_states rejected not finite'] == '3'
    assert 'hit probability' not in values
    assert PlantStatus(insertion_depth=0.05).to_values()['insertion depth [m]'] == '0.05'


def test_status_of_another_node() -> None:
    """A status of another suite has no type; missing fields have their defaults."""
    assert report({'phase': 'active'}).status is None
    assert report({'kind': 'camera'}).status is None
    assert report({'kind': 'controller'}).status == ControllerStatus()
    found = ControllerStatus.from_values({'phase': 'active', 'target [m]': 'x', 'stops': '2'})
    assert found == ControllerStatus(phase=ControllerPhase.ACTIVE, stops=2)


def test_all_fields_are_documented() -> None:
    """The table of the status fields lists every key."""
    table = (ROOT / 'docs' / 'diagnostics.md').read_text('utf-8')
    listed = set(re.findall(r'^\| `([^`]+)` \|', table, re.MULTILINE))
    keys = {key for kind in STATUSES.values() for key in keys_of(kind)}
    assert listed >= keys, sorted(keys - listed)


def lookups(source: str) -> list[str]:
    """Return the texts that a source uses as keys, in brackets or with `get`."""
    found: list[ast.expr] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Subscript):
            found.append(node.slice)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith('.get'):
            found += node.args[:1]
    return [str(one.value) for one in found if isinstance(one, ast.Constant)]


def test_readers_use_the_dataclasses() -> None:
    """No file that reads /diagnostics looks a key up."""
    keys = {key for kind in STATUSES.values() for key in keys_of(kind)}
    # Other keys of one word are common.
    keys = {key for key in keys if ' ' in key} | {'phase'}
    assert lookups("values['target [m]'], values.get('phase')") == ['target [m]', 'phase']
    folders = ('needle_*', 'benchmarks', 'examples', 'test')
    paths = [one for folder in folders for one in sorted(ROOT.glob(f'{folder}/**/*.py'))]
    readers = [
        one
        for one in paths
        if re.search('DiagnosticArray|needle_ros.status', one.read_text('utf-8'))
    ]
    assert len(readers) > 20
    broken = [
        f'{path.relative_to(ROOT)}: {key!r}'
        for path in readers
        for key in lookups(path.read_text('utf-8'))
        if key in keys and path != Path(__file__).resolve()
    ]
    assert not broken, '\n'.join(broken)


def test_statuses_of_other_nodes_keep_their_task() -> None:
    """A node may report several tasks; an error of one must not hide behind another."""
    names = ['/plant', '/plant: state', 'manager: activity', 'manager: hardware', 'a: b: state']
    nodes = ['/plant', '/plant', 'manager: activity', 'manager: hardware', 'a: b']
    assert [report({}, name).node for name in names] == nodes


@given(level=st.integers(0, 255))
def test_levels_of_rclpy_and_of_a_bag_are_equal(level: int) -> None:
    found = [report({}, level=one) for one in (level, bytes([level]))]
    assert found[0] == found[1]
    assert found[0].level_name == (LEVELS[level] if level < 4 else str(level))
