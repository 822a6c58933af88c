# SPDX-License-Identifier: Apache-2.0
"""Shipped SROS2 policies as sets of names."""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

from lxml import etree
from support.installed import ROOT

POLICIES: Final = ROOT / 'config/security/policies.xml'

#: Published by every node, and not recorded.
NOT_RECORDED: Final = {'/rosout', '/parameter_events'}

#: Reports to a plant in lockstep, not recorded.
REPORTS: Final = {'/joint_states/_processed', '/joint_states/_recorded'}


#: Part of the names of the topics and services of an action.
ACTION: Final = '/_action/'


class Profile(NamedTuple):
    """Permitted or used names of a node."""

    publish: frozenset[str]
    subscribe: frozenset[str]
    reply: frozenset[str]
    request: frozenset[str]
    #: Actions that are offered and used, with their topics and services.
    execute: frozenset[str] = frozenset()
    call: frozenset[str] = frozenset()


def load(path: Path = POLICIES) -> etree._ElementTree:
    """Return a policy file with its includes, as sros2 reads it."""
    tree = etree.parse(path)
    tree.xinclude()
    return tree


def parsed(tree: etree._ElementTree) -> dict[str, Profile]:
    """Return the permitted names of each enclave by its node."""
    found = {}
    for enclave in tree.iterfind('enclaves/enclave'):
        (profile,) = enclave.iterfind('profiles/profile')
        node, namespace = profile.get('node'), profile.get('ns')
        allowed: dict[str, set[str]] = {rule: set() for rule in Profile._fields}
        for block in profile.iterchildren('topics', 'services', 'actions'):
            for rule in allowed.keys() & block.attrib.keys():
                assert block.get(rule) == 'ALLOW'
                for name in (item.text.replace('~', f'{namespace}{node}') for item in block):
                    allowed[rule].add(name if name.startswith('/') else namespace + name)
        assert enclave.get('path') == f'/needle_insertion/{node}'
        found[node] = Profile(**{rule: frozenset(names) for rule, names in allowed.items()})
    return found


POLICY: Final = parsed(load())
