# SPDX-License-Identifier: Apache-2.0
"""Playback of bags: order of messages, their QoS, and schedule."""

from itertools import pairwise
from pathlib import Path
import time

from needle_identification import Bag, BagWriter, RecordingError
from needle_identification.bags import bag as reading
from needle_identification.bags.playback import BagPlayback, PlaybackSettings
from needle_identification.bags.topics import BagTopic, OfferedQos
import pytest
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from support.samples import EPOCH, STORE, TEXT, text
import yaml

OLD = """
- history: 1
  depth: 7
  reliability: 2
  durability: 1
  deadline: {sec: 0, nsec: 0}
"""


def everything(_topic: BagTopic) -> bool:
    return True


def test_messages_are_in_order_of_time_across_topics(tmp_path: Path) -> None:
    """Batches are sorted by topic, messages by time."""
    with BagWriter(tmp_path / 'bag') as writer:
        for name in ('/a', '/b'):
            writer.add_topic(name, TEXT)
        for k in range(3000):
            writer.write(('/a', '/b')[k % 2], text(str(k)), EPOCH + k)
    found = list(Bag(tmp_path / 'bag').messages(everything))
    assert [(m.received, m.topic.name, m.data) for m in found] == [
        (EPOCH + k, ('/a', '/b')[k % 2], text(str(k))) for k in range(3000)
    ]


def test_equal_times_keep_the_order_of_the_file(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic('/a', TEXT)
        for k in range(100):
            writer.write('/a', text(str(k)), EPOCH)
    found = [message.data for message in Bag(tmp_path / 'bag').messages(everything)]
    assert found == [text(str(k)) for k in range(100)]


def test_a_long_recording_is_sorted_in_bounded_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only messages of selected topics are buffered, at most the window and one piece."""
    monkeypatch.setattr(reading, '_WINDOW', 1000)
    with BagWriter(tmp_path / 'bag') as writer:
        for name in ('/a', '/b'):
            writer.add_topic(name, TEXT)
        for k in range(1000):
            # Neighbors are swapped.
            writer.write('/a', text(str(k)), EPOCH + (k ^ 1))
            writer.write('/b', text('other'), EPOCH + k)
            if k % 50 == 49:
                writer.flush()
    bag = Bag(tmp_path / 'bag')
    messages = bag.messages(lambda topic: topic.name == '/a')
    first = next(messages)
    # Messages read: the window of 1000 bytes, not the whole recording.
    assert sum(bag.counts.values()) < 500
    times = [first.received, *(message.received for message in messages)]
    assert times == [EPOCH + k for k in range(1000)]


def test_a_very_late_message_is_not_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, '_WINDOW', 0)
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic('/a', TEXT)
        for k in range(10):
            writer.write('/a', text(str(k)), EPOCH - k)
            writer.flush()
    times = [message.received for message in Bag(tmp_path / 'bag').messages(everything)]
    assert sorted(times) == [EPOCH - k for k in reversed(range(10))]
    assert any(late < early for early, late in pairwise(times))


def damaged_bag(path: Path, damaged: int) -> Bag:
    """Return a bag with ten messages, of which one has a receive time 30 years off."""
    with BagWriter(path) as writer:
        writer.add_topic('/a', TEXT)
        for k in range(10):
            at = EPOCH + k * 1_000
            shift = 0 if k != damaged else 10**18 if damaged else -(10**18)
            writer.write('/a', text(str(k)), at + shift)
    return Bag(path)


@pytest.mark.parametrize('damaged', [5, 0], ids=['late', 'early'])
def test_a_damaged_receive_time_ends_the_playback(tmp_path: Path, damaged: int) -> None:
    """A receive time years ahead ends the playback with an error, after earlier messages."""
    bag = damaged_bag(tmp_path / 'bag', damaged)
    play = BagPlayback(bag, {'/a'}, {}, PlaybackSettings(rate=1.0, delay=0.0))
    play.start(paused=False)
    for _ in range(9 if damaged else 1):
        while not play.is_due():
            pass
        assert len(play.take()) == 1
    with pytest.raises(RecordingError, match='has a damaged receive time') as caught:
        play.is_due()
    assert 'a message of /a arrives 1.16e+04 days later' in str(caught.value)


@pytest.mark.parametrize('damaged', [5, 0], ids=['late', 'early'])
def test_at_rate_0_a_damaged_receive_time_loses_no_message(tmp_path: Path, damaged: int) -> None:
    """No wait: all messages are played, and the damage is kept for the report."""
    play = BagPlayback(
        damaged_bag(tmp_path / 'bag', damaged), {'/a'}, {}, PlaybackSettings(rate=0.0, delay=0.0)
    )
    play.start(paused=False)
    assert sorted(played(play)) == [text(str(k)) for k in range(10)]
    assert 'a message of /a arrives 1.16e+04 days later' in play.damage


def test_offered_qos_is_stored(tmp_path: Path) -> None:
    """Profiles are read back unchanged in both storage formats."""
    weak = OfferedQos('best_effort', 'volatile', 'keep_last', 5)
    latched = OfferedQos('reliable', 'transient_local', 'keep_all', 1)
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic('/a', TEXT, [weak, latched])
        writer.write('/a', text('x'), EPOCH)
    (topic,) = Bag(tmp_path / 'bag').topics()
    assert topic.offered_qos() == (weak, latched)
    forever = QosTime(9223372036, 854775807)
    profile = Qos(
        QosHistory.KEEP_LAST, 5, QosReliability.BEST_EFFORT, QosDurability.VOLATILE, forever,
        forever, QosLiveliness.AUTOMATIC, forever, False,
    )  # fmt: skip
    path = tmp_path / 'sqlite'
    with Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection(
            '/a', TEXT, typestore=STORE, offered_qos_profiles=[profile]
        )
        writer.write(connection, EPOCH, text('x'))
    (message,) = Bag(path).messages(everything)
    assert message.topic.offered_qos() == (weak,)


def said(field: str, value: str) -> str:
    """Return the default profile with one changed value."""
    stored = yaml.safe_dump({**OfferedQos().as_mapping(), field: 'VALUE'}, default_flow_style=True)
    return f'- {stored.replace("VALUE", value)}'


@pytest.mark.parametrize(
    ('stored', 'found'),
    [
        (OLD, (OfferedQos('best_effort', 'transient_local', 'keep_last', 7),)),
        (yaml.safe_dump([OfferedQos().as_mapping()]), (OfferedQos(),)),
        ('', ()),
        ('- history: 1', ()),
        ('{', ()),
        ('5', ()),
        ('- [1]', ()),
        # Damaged or hostile profiles: the player then offers its default.
        *((said('depth', number), ()) for number in ('.inf', '-.inf', '.nan', '1.0e+400', '[]')),
        *((said('deadline', f'{{sec: {number}, nsec: 0}}'), ()) for number in ('.inf', '.nan')),
        (said('lifespan', '{sec: -5, nsec: 0}'), (OfferedQos(),)),
    ],
)
def test_offered_qos_of_any_version_of_rosbag2_is_read(
    stored: str, found: tuple[OfferedQos, ...]
) -> None:
    """Older recordings have numbers instead of names; unreadable profiles are ignored."""
    assert BagTopic('/a', TEXT, profiles=stored).offered_qos() == found


@pytest.fixture
def bag(tmp_path: Path) -> Bag:
    """Return a bag with a latched topic, and ten messages 10 ms apart."""
    with BagWriter(tmp_path / 'bag') as writer:
        for name in ('/latched', '/a'):
            writer.add_topic(name, TEXT)
        for k, word in enumerate(('old', 'new')):
            writer.write('/latched', text(word), EPOCH + k)
        for k in range(10):
            writer.write('/a', text(str(k)), EPOCH + 10_000_000 * k)
    return Bag(tmp_path / 'bag')


def playback(bag: Bag, **settings: float) -> BagPlayback:
    """Return a running playback without delay."""
    made = BagPlayback(
        bag, {'/a', '/latched'}, {'/latched': 1}, PlaybackSettings(delay=0.0, **settings)
    )
    made.start(paused=False)
    return made


def played(made: BagPlayback) -> list[bytes]:
    """Play to the end as fast as possible."""
    found: list[bytes] = []
    while made.has_next:
        if made.is_due():
            found += [message.data for message in made.take()]
    return found


def test_playback_starts_with_the_last_latched_message(bag: Bag) -> None:
    """The interval from start to end is played, after earlier latched messages."""
    made = playback(bag, rate=0.0, start=0.02, end=0.05)
    assert played(made) == [text('new'), *(text(str(k)) for k in range(2, 6))]
    assert made.take() == []


def test_playback_keeps_the_recorded_timing(bag: Bag) -> None:
    """Messages are due at their recorded time, and delays are measured."""
    # Before the start: the process may be suspended after it.
    begin = time.monotonic()
    made = playback(bag, rate=2.0)
    assert len(played(made)) == 12
    assert time.monotonic() - begin >= 0.045
    assert 0.0 <= made.late <= made.latest


def test_a_paused_playback_is_stepped(bag: Bag) -> None:
    """Single messages can be taken; the position is the time of the last message."""
    made = playback(bag, rate=1.0)
    made.pause(True)
    assert not made.is_running
    made.take()
    (message,) = made.take()
    position = made.position
    time.sleep(0.01)
    assert made.position == position == message.received
    made.pause(False)
    assert made.is_running
    time.sleep(0.01)
    assert made.position > position


def test_a_playback_loops_or_ends(bag: Bag) -> None:
    made = playback(bag, rate=0.0)
    first = played(made)
    made.finish(loop=True)
    assert (made.loops, made.is_ended) == (1, False)
    assert played(made) == first
    made.finish(loop=False)
    assert made.is_ended
    assert made.seconds(made.position) == pytest.approx(0.09)
