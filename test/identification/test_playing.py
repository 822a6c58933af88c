"""What a player needs of a bag: its messages in the order of time, and how they were offered."""

from itertools import pairwise
from pathlib import Path

from needle_identification import Bag, BagWriter, OfferedQos, Topic
from needle_identification.bags import bag as reading
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


def everything(_topic: Topic) -> bool:
    return True


def test_messages_come_in_the_order_of_time_across_topics(tmp_path: Path) -> None:
    """Batches come topic by topic; messages do not."""
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
    """Of messages received at once the one written first comes first."""
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic('/a', TEXT)
        for k in range(100):
            writer.write('/a', text(str(k)), EPOCH)
    found = [message.data for message in Bag(tmp_path / 'bag').messages(everything)]
    assert found == [text(str(k)) for k in range(100)]


def test_a_long_recording_is_put_in_order_piece_by_piece(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No more waits than the window and the piece that is read; only the wanted topics do."""
    monkeypatch.setattr(reading, '_WINDOW', 1000)
    with BagWriter(tmp_path / 'bag') as writer:
        for name in ('/a', '/b'):
            writer.add_topic(name, TEXT)
        for k in range(1000):
            # Neighbors are exchanged.
            writer.write('/a', text(str(k)), EPOCH + (k ^ 1))
            writer.write('/b', text('other'), EPOCH + k)
            if k % 50 == 49:
                writer.flush()
    bag = Bag(tmp_path / 'bag')
    messages = bag.messages(lambda topic: topic.name == '/a')
    first = next(messages)
    # Messages read so far: those of the window of 1000 bytes, not the whole recording.
    assert sum(bag.counts.values()) < 500
    times = [first.received, *(message.received for message in messages)]
    assert times == [EPOCH + k for k in range(1000)]


def test_a_message_behind_the_window_comes_when_it_is_met(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is lost, whatever the order."""
    monkeypatch.setattr(reading, '_WINDOW', 0)
    with BagWriter(tmp_path / 'bag') as writer:
        writer.add_topic('/a', TEXT)
        for k in range(10):
            writer.write('/a', text(str(k)), EPOCH - k)
            writer.flush()
    times = [message.received for message in Bag(tmp_path / 'bag').messages(everything)]
    assert sorted(times) == [EPOCH - k for k in reversed(range(10))]
    assert any(late < early for early, late in pairwise(times))


def test_what_was_offered_comes_back(tmp_path: Path) -> None:
    """Profiles are those that the recorder stored, in either form of storage."""
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
    ],
)
def test_reads_what_any_version_of_rosbag2_stored(
    stored: str, found: tuple[OfferedQos, ...]
) -> None:
    """Numbers stand for the words in older recordings; what is not readable says nothing."""
    assert Topic('/a', TEXT, profiles=stored).offered_qos() == found
