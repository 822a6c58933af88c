# SPDX-License-Identifier: Apache-2.0
"""The system state: a stop has priority, and all nodes agree for any order of messages."""

from __future__ import annotations

from functools import partial
from time import time_ns

from hypothesis import given
from hypothesis import strategies as st
from needle_ros.system_state import (
    Authority,
    CLEAR_STOP,
    Mode,
    PAUSE,
    REQUESTS,
    RESUME,
    RETRACT,
    STOP,
    SystemState,
)
import pytest

NODES = ('/controller', '/steering', '/plant')


def authorities() -> list[Authority]:
    """Return the authorities of three nodes whose clocks stand still at different times."""
    return [Authority(node, partial(int, 1000 * k)) for k, node in enumerate(NODES)]


def exchange(nodes: list[Authority], order: list[int]) -> None:
    """Deliver the states of the nodes in an order, then each to each."""
    for sender in [*order, 0, 1, 2]:
        for node in nodes:
            node.receive(nodes[sender].state)


steps = st.lists(
    st.tuples(
        st.integers(0, 2),
        st.sampled_from([*REQUESTS, 'fault', 'run']),
        st.lists(st.integers(0, 2), max_size=2),
    ),
    max_size=12,
)


def perform(node: Authority, word: str) -> None:
    if word == 'fault':
        node.stop('the tip is lost')
    elif word == 'run':
        node.run()
    else:
        node.request(word)


@pytest.mark.requirement('S-011', 'S-018')
@given(steps=steps, order=st.permutations([0, 1, 2]))
def test_nodes_agree_for_any_order_of_messages(
    steps: list[tuple[int, str, list[int]]], order: list[int]
) -> None:
    """After every exchange all nodes have the same state; repeated messages change nothing."""
    nodes = authorities()
    for at, word, sent in steps:
        perform(nodes[at], word)
        for sender in sent:
            nodes[(at + 1) % 3].receive(nodes[sender].state)
    exchange(nodes, list(order))
    assert nodes[0].state == nodes[1].state == nodes[2].state
    before = nodes[0].state
    exchange(nodes, [2, 2, 0, 1])
    assert nodes[0].state == before


@pytest.mark.requirement('S-011', 'S-012')
@given(before=steps, after=steps, concurrent=st.sampled_from([PAUSE, RESUME, RETRACT, CLEAR_STOP]))
def test_a_stop_holds_until_it_is_cleared(
    before: list[tuple[int, str, list[int]]],
    after: list[tuple[int, str, list[int]]],
    concurrent: str,
) -> None:
    """No other request ends it, also not one that another node receives at the same time."""
    nodes = authorities()
    for at, word, _ in before:
        perform(nodes[at], word)
    exchange(nodes, [])
    # A clearance of an earlier stop does not clear this one.
    nodes[1].request(concurrent)
    nodes[0].request(CLEAR_STOP)
    nodes[0].stop('emergency')
    exchange(nodes, [])
    for at, word, _ in after:
        if word != CLEAR_STOP:
            perform(nodes[at], word)
        exchange(nodes, [])
        assert {node.mode for node in nodes} == {Mode.STOPPED}
        assert 'emergency' in nodes[2].reason
    nodes[2].request(CLEAR_STOP)
    exchange(nodes, [])
    assert {node.mode for node in nodes} == {Mode.RUNNING}


@pytest.mark.requirement('S-004')
@given(steps=steps)
def test_state_survives_its_values(steps: list[tuple[int, str, list[int]]]) -> None:
    """Converting a state to text values and back changes nothing."""
    nodes = authorities()
    for at, word, _ in steps:
        perform(nodes[at], word)
    exchange(nodes, [])
    state = nodes[0].state
    assert SystemState.from_values(state.to_values()) == state


@pytest.mark.requirement('S-004')
@given(st.dictionaries(st.text(), st.text()))
def test_any_values_are_read(values: dict[str, str]) -> None:
    """Values of another node are ignored if they are no state."""
    found = SystemState.from_values(
        {**values, 'stop /x': 'soon', 'motion': '', 'cleared /x': '-1'}
    )
    assert found.mode is not None
    assert '/x' not in found.cleared


#: Times of a message: also such as no clock has, and with more digits than Python reads.
numbers = st.one_of(
    st.integers(0, 10**20).map(str), st.sampled_from([1, 18, 19, 20, 4300, 4301]).map('9'.__mul__)
)
#: Values of a `system_state`, valid and invalid.
foreign = st.dictionaries(
    st.sampled_from(
        ['motion', *(f'{word} {node}' for word in ('stop', 'cleared') for node in NODES)]
    ),
    st.builds(' '.join, st.tuples(numbers, st.sampled_from(['', 'paused', 'retracting'])))
    | numbers,
)


@pytest.mark.requirement('S-273')
@given(received=st.lists(foreign, max_size=4), at=st.integers(0, 2))
def test_no_message_prevents_a_later_stop(received: list[dict[str, str]], at: int) -> None:
    """Whatever one node has received: its stop, as text, stops the others until it is cleared."""
    nodes = [Authority(node) for node in NODES]

    def publish(sender: Authority) -> None:
        for node in nodes:
            node.receive(SystemState.from_values(sender.state.to_values()))

    for values in received:
        nodes[at].receive(SystemState.from_values(values))
    nodes[at].request(CLEAR_STOP)
    publish(nodes[at])
    nodes[at].stop('emergency')
    publish(nodes[at])
    assert all('emergency' in node.reason for node in nodes)
    nodes[at - 1].request(CLEAR_STOP)
    publish(nodes[at - 1])
    assert {node.mode for node in nodes} == {Mode.RUNNING}


@pytest.mark.requirement('S-273')
@pytest.mark.parametrize('word', ['stop', 'cleared'])
def test_entries_of_other_nodes_are_bounded_and_keep_a_stop(word: str) -> None:
    """A state stays small, and a stop in effect in it, however many nodes publish."""
    node = Authority('/controller')
    node.stop('emergency')
    for k in range(1000):
        state = SystemState.from_values({f'{word} /node{k}': f'{time_ns()} {word}'})
        node.receive(state)
    assert len(node.state.to_values()) <= 2 * 64 + 2
    assert node.mode is Mode.STOPPED
    assert word == 'stop' or node.reason == 'emergency'
    many = {f'stop /node{k}': f'{k} stop' for k in range(10**5)}
    assert len(SystemState.from_values(many).stops) <= 2 * 64 + 2


@pytest.mark.requirement('S-011', 'S-058')
@pytest.mark.parametrize('word', [PAUSE, RESUME, RETRACT])
def test_requests_are_refused_during_a_stop(word: str) -> None:
    """The line names the reason and the release."""
    node = Authority('/controller')
    node.stop('axial force 40 N')
    assert node.request(word) == (
        False,
        f'{word} refused: stopped: axial force 40 N; ~/clear_stop releases',
    )
    assert node.request(STOP)[0]
    assert node.reason == 'axial force 40 N'


@pytest.mark.requirement('S-008')
def test_pause_of_a_retraction_resumes_the_retraction() -> None:
    """A request of a motion ends the retraction, a pause does not."""
    node = Authority('/steering')
    for word, mode in (
        (RETRACT, Mode.RETRACTING),
        (PAUSE, Mode.PAUSED),
        (RESUME, Mode.RETRACTING),
    ):
        assert node.request(word)[0]
        assert node.mode is mode
    node.run()
    assert node.mode is Mode.RUNNING
