# SPDX-License-Identifier: Apache-2.0
"""OpenIGTLink connection: recovery from lost, silent, slow and invalid peers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, ExitStack
import socket
import struct
from threading import active_count
from time import monotonic, sleep
from typing import Any

from benchmarks.igtl_peer import free_port
from hypothesis import given
from hypothesis import strategies as st
from needle_insertion.slicer.link import Connection, Frames, HEADER, LinkSettings
from needle_insertion.slicer.messages import largest_target, TARGET
from needle_ros.errors import MessageError, ParameterError
from needle_ros.event_log import EventLog
import numpy as np
import pyigtl
import pytest

MESSAGE = pyigtl.TransformMessage(np.eye(4), device_name=TARGET).pack()


class Desk:
    """Link with its log lines and received frames, and an adjustable clock."""

    def __init__(self, role: str = 'server', port: int | None = None) -> None:
        self.port = free_port() if port is None else port
        self.events, self.ahead = EventLog(self.clock), 0.0
        settings = LinkSettings(role=role, port=self.port)
        self.link = Connection(settings, largest_target, self.events, self.clock)
        self.lines: list[str] = []
        self.frames: list[Any] = []

    def clock(self) -> float:
        return monotonic() + self.ahead

    def poll(self) -> None:
        """Poll the link as the node."""
        begin = monotonic()
        self.frames += self.link.poll()
        # No blocking calls; the bound allows for a busy machine.
        assert monotonic() - begin < 5.0
        self.lines += [line for _, line in self.events.take()]

    def until(self, condition: Callable[[], Any], what: str = 'it') -> None:
        deadline = monotonic() + 60.0
        while not condition():
            assert monotonic() < deadline, f'{what} did not come: {self.lines}'
            self.poll()
            sleep(0.005)

    def said(self, words: str) -> bool:
        return any(words in line for line in self.lines)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as opened:
        yield opened


@pytest.fixture
def desk(stack: ExitStack) -> Desk:
    """Return a listening link."""
    made = Desk()
    stack.callback(made.link.close)
    made.until(lambda: made.said('listens on'))
    return made


def visitor(desk: Desk, stack: ExitStack) -> socket.socket:
    """Connect, and wait until the link has accepted the connection."""
    before = desk.link.peer
    one = stack.enter_context(closing(socket.create_connection(('127.0.0.1', desk.port))))
    desk.until(lambda: desk.link.peer not in ('', before), 'the peer')
    return one


def test_messages_are_exchanged_in_both_directions(desk: Desk, stack: ExitStack) -> None:
    """With the client of pyigtl, and without a thread in the link."""
    threads = active_count()
    client = pyigtl.OpenIGTLinkClient(port=desk.port)
    stack.callback(client.stop)
    desk.until(lambda: desk.link.peer, 'the client')
    assert active_count() == threads + 1
    client.send_message(pyigtl.StringMessage('1 2 3', device_name=TARGET), wait=False)
    client.send_message(pyigtl.StringMessage('1 2 3', device_name='Other'), wait=False)
    assert desk.link.send(MESSAGE)
    desk.until(lambda: desk.frames and client.incoming_messages, 'the messages')
    assert [(one.kind, one.device) for one in desk.frames] == [('STRING', TARGET)]
    assert list(client.incoming_messages) == [TARGET]


@pytest.mark.parametrize('size', [0, 30, 70])
def test_next_peer_is_accepted_after_disconnect(desk: Desk, stack: ExitStack, size: int) -> None:
    """Also after a partial header or body, where the server of pyigtl loops forever."""
    for _ in range(3):
        one = visitor(desk, stack)
        one.sendall(MESSAGE[:size])
        one.close()
        desk.until(lambda: not desk.link.peer, 'the end')
    assert desk.said('is gone: it closed the connection')
    assert [one.error for one in desk.frames] == (
        [f'connection lost, {size} of {len(MESSAGE)} bytes received'] * 3 if size > 58 else []
    )
    desk.frames.clear()
    one = visitor(desk, stack)
    one.sendall(MESSAGE)
    desk.until(lambda: desk.frames, 'the message')
    assert not desk.frames[0].error


def test_next_peer_is_accepted_after_connection_reset(desk: Desk, stack: ExitStack) -> None:
    """The connection is reset while data is queued."""
    one = visitor(desk, stack)
    one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack('ii', 1, 0))
    desk.link.send(MESSAGE)
    one.close()
    desk.until(lambda: not desk.link.peer, 'the end')
    assert not desk.link.send(MESSAGE)
    visitor(desk, stack)


def test_message_before_disconnect_is_received(desk: Desk, stack: ExitStack) -> None:
    """A script may connect, send a target and disconnect."""
    with closing(socket.create_connection(('127.0.0.1', desk.port))) as one:
        one.sendall(MESSAGE)
    desk.until(lambda: desk.frames, 'the message')
    desk.until(lambda: not desk.link.peer, 'the end')


@pytest.mark.parametrize(
    ('words', 'line'),
    [
        (b'GET / HTTP/1.1\r\n' + b'Accept: */*\r\n' * 5, 'refused: not OpenIGTLink'),
        (HEADER.pack(1, b'IMAGE', b'', 0, 0, 2**63, 0), 'of 9223372036854775808 bytes'),
    ],
    ids=['HTTP', 'a long image'],
)
def test_other_protocol_closes_connection(
    desk: Desk, stack: ExitStack, words: bytes, line: str
) -> None:
    """With at most one log line per second."""
    for _ in range(5):
        visitor(desk, stack).sendall(words)
        desk.until(lambda: not desk.link.peer, 'the end')
    assert sum(line in said for said in desk.lines) == 1
    assert desk.events.rejected == 5
    assert '\n' not in ''.join(desk.lines)


@pytest.mark.requirement('S-165')
def test_second_peer_is_rejected(desk: Desk, stack: ExitStack) -> None:
    """The first connection stays."""
    first = visitor(desk, stack)
    peer = desk.link.peer
    second = stack.enter_context(closing(socket.create_connection(('127.0.0.1', desk.port))))
    desk.until(lambda: desk.said(f'turned away: {peer} is connected'), 'the line')
    second.settimeout(60.0)
    assert second.recv(1) == b''
    assert desk.link.peer == peer
    first.sendall(MESSAGE)
    desk.until(lambda: desk.frames, 'the message')


@pytest.mark.requirement('S-164')
def test_link_listens_on_configured_address_only(desk: Desk) -> None:
    """Connections to other local addresses are refused."""
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(('127.0.0.2', desk.port))


def test_peer_without_reads_is_disconnected(desk: Desk, stack: ExitStack) -> None:
    """Messages are dropped first; the queue is bounded and never blocks."""
    visitor(desk, stack)
    sent = 0
    while desk.link.send(bytes(50_000)):
        sent += 1
        assert sent < 1000
    desk.poll()
    assert desk.said('reads too slowly: messages are left out')
    assert desk.link.left_out == 1
    desk.ahead += 6.0
    desk.until(lambda: not desk.link.peer, 'the end')
    assert desk.said('it has read nothing for 5 s')
    visitor(desk, stack)


def test_messages_are_sent_completely_or_dropped(desk: Desk, stack: ExitStack) -> None:
    """A peer that reads in bursts receives whole messages."""
    one = visitor(desk, stack)
    one.settimeout(60.0)
    body = bytes(range(256)) * 100
    message = HEADER.pack(1, b'POINT', b'a', 0, 0, len(body), 0) + body
    sent = 0
    while desk.link.send(message):
        sent += 1
        assert sent < 1000
    data = bytearray()
    while len(data) < sent * len(message):
        desk.poll()
        data += one.recv(1 << 20)
    assert data == sent * message


def test_port_in_use_is_reported_and_retried(stack: ExitStack) -> None:
    """The link listens once the port is free."""
    other = stack.enter_context(closing(socket.create_server(('127.0.0.1', 0))))
    desk = Desk(port=other.getsockname()[1])
    stack.callback(desk.link.close)
    for _ in range(3):
        desk.poll()
        desk.ahead += 1.5
    assert [line for line in desk.lines if 'the port is in use' in line] == [
        f'cannot listen on 127.0.0.1:{desk.port}: the port is in use; tries again every 1 s'
    ]
    assert desk.link.error == desk.link.state
    other.close()
    desk.ahead += 1.5
    desk.until(lambda: desk.said('listens on'), 'the port')
    assert desk.link.error == ''
    visitor(desk, stack)


def test_client_reconnects_to_server(stack: ExitStack) -> None:
    """Before, after, and again after an interruption."""
    desk = Desk(role='client')
    stack.callback(desk.link.close)
    desk.until(lambda: desk.said('cannot connect to'), 'the line')
    for _ in range(2):
        with ExitStack() as while_it_is_there:
            server = socket.create_server(('127.0.0.1', desk.port))
            while_it_is_there.callback(server.close)
            desk.until(lambda: desk.link.peer, 'the server')
            came, _address = server.accept()
            while_it_is_there.callback(came.close)
            came.settimeout(60.0)
            came.sendall(MESSAGE)
            assert desk.link.send(MESSAGE)
            desk.until(lambda: desk.frames, 'the message')
            assert came.recv(1 << 16) == MESSAGE
            desk.frames.clear()
        desk.until(lambda: not desk.link.peer, 'the end')


def test_closed_link_can_be_reopened(desk: Desk, stack: ExitStack) -> None:
    """As after deactivation and activation of the node."""
    one = visitor(desk, stack)
    desk.link.close()
    one.settimeout(60.0)
    assert one.recv(1) == b''
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(('127.0.0.1', desk.port))
    desk.poll()
    visitor(desk, stack)


@pytest.mark.parametrize(
    ('given_', 'complaint'),
    [
        ({'role': 'peer'}, 'role must be one of server, client'),
        ({'host': 'slicer'}, "host must be an IPv4 address such as 127.0.0.1, got 'slicer'"),
        ({'port': 0}, 'port must be finite, >= 1'),
        ({'port': 80.5}, 'port must be a whole number'),
    ],
)
def test_invalid_link_settings_are_rejected(given_: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ParameterError, match=complaint):
        LinkSettings(**given_)


def test_localhost_is_this_machine() -> None:
    """It needs no look-up of a name, which can block."""
    assert LinkSettings(host='localhost') == LinkSettings(host='127.0.0.1')


@given(
    st.integers(0, 5) | st.integers(0, 65535),
    st.binary(min_size=12, max_size=12) | st.sampled_from([b'POINT' + bytes(7), b'STATUS' * 2]),
)
def test_message_type_names_are_printable(version: int, kind: bytes) -> None:
    """A header of another protocol is rejected."""
    header = struct.pack('>H12s', version, kind) + bytes(HEADER.size - 14)
    name = kind.rstrip(b' \0')
    if version in (1, 2, 3) and name.isascii() and name.decode('latin1').isprintable():
        found = Frames(largest_target).take(header)
        assert [one.kind for one in found] == ['POINT'] * (name == b'POINT')
    else:
        with pytest.raises(MessageError):
            Frames(largest_target).take(header)
