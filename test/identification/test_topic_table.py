# SPDX-License-Identifier: Apache-2.0
"""Topics of bags as columns, for standard and foreign message types."""

from __future__ import annotations

from pathlib import Path

from needle_identification import Bag, BagWriter, read_bag, RecordingError
from needle_identification.bags.bag import read_topic
from needle_identification.bags.messages import encode, message_type
from needle_ros.contract import JOINT_STATES
import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

BAGS = Path(__file__).parents[2] / 'bags'


def write(path: Path, type_name: str, messages: list[object]) -> None:
    """Write messages to a topic, received at 1 s, 2 s, ..."""
    with BagWriter(path) as bag:
        bag.add_topic('/data', type_name)
        for k, message in enumerate(messages, 1):
            bag.write('/data', encode(message), k * 10**9)


def test_named_joints_are_columns() -> None:
    """Columns of the shipped bags, against the deserialized messages."""
    table = read_bag(BAGS / 'friction_01', 'joint_states')
    messages = [message for _, message in read_topic(BAGS / 'friction_01', '/joint_states')]
    joint = list(messages[0].name).index('insertion')
    np.testing.assert_array_equal(
        table['position.insertion'], [one.position[joint] for one in messages]
    )
    stamps = np.array([s.sec * 10**9 + s.nanosec for s in (m.header.stamp for m in messages)])
    np.testing.assert_array_equal(table['header.stamp [ns]'], stamps)
    np.testing.assert_allclose(table['time [s]'], (stamps - stamps[0]) / 1e9, rtol=0, atol=1e-9)
    assert table.topic == f'/{JOINT_STATES.name}'
    assert not [name for name in table.values if '__' in name]


def test_every_topic_of_a_shipped_bag_is_read() -> None:
    for topic in Bag(BAGS / 'stiffness_01').topics():
        table = read_bag(BAGS / 'stiffness_01', topic.name)
        assert len({len(values) for values in table.values.values()}) == 1


def test_time_without_a_stamp_is_the_time_of_reception(tmp_path: Path) -> None:
    kind = message_type('std_msgs/msg/Float64')
    write(tmp_path / 'bag', 'std_msgs/msg/Float64', [kind(data=0.5), kind(data=1.5)])
    table = read_bag(tmp_path / 'bag', '/data')
    assert table['time [s]'].tolist() == [0.0, 1.0]
    assert table['data'].tolist() == [0.5, 1.5]


def test_missing_elements_are_nan_and_long_sequences_stay_arrays(tmp_path: Path) -> None:
    """A sequence of two and then one element; a sequence of 65 elements."""
    kind = message_type('std_msgs/msg/Float64MultiArray')
    layout = message_type('std_msgs/msg/MultiArrayLayout')(dim=[], data_offset=0)
    sizes = (2, 1, 65)
    messages = [kind(layout=layout, data=np.arange(float(size))) for size in sizes]
    write(tmp_path / 'bag', 'std_msgs/msg/Float64MultiArray', messages[:2])
    np.testing.assert_array_equal(read_bag(tmp_path / 'bag', 'data')['data[1]'], [1.0, np.nan])
    write(tmp_path / 'long', 'std_msgs/msg/Float64MultiArray', messages[2:])
    np.testing.assert_array_equal(read_bag(tmp_path / 'long', 'data')['data'][0], np.arange(65.0))


def test_type_that_only_the_bag_defines_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A type outside ROS 2 Jazzy, written where it is installed, and read where it is not."""
    definition = 'float64 force\nstring unit\ngeometry_msgs/Vector3 moment\n'
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(definition, 'lab_msgs/msg/Load'))
    vector = store.types['geometry_msgs/msg/Vector3'](0.0, 0.1, 0.2)
    load = store.types['lab_msgs/msg/Load'](1.5, 'N', vector)
    file = tmp_path / 'share/lab_msgs/msg/Load.msg'
    file.parent.mkdir(parents=True)
    file.write_text(definition)
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add_topic('/load', 'lab_msgs/msg/Load')
        bag.write('/load', bytes(store.serialize_cdr(load, 'lab_msgs/msg/Load')), 10**9)
    monkeypatch.delenv('AMENT_PREFIX_PATH')
    table = read_bag(tmp_path / 'bag', 'load')
    assert [table[name][0] for name in ('force', 'unit', 'moment.y')] == [1.5, 'N', 0.1]


def test_unknown_topic_and_unknown_column_list_the_valid_names() -> None:
    with pytest.raises(RecordingError, match='has no topic /nothing; it has /base_wrench'):
        read_bag(BAGS / 'friction_01', 'nothing')
    with pytest.raises(KeyError, match=r'position\.insertion'):
        read_bag(BAGS / 'friction_01', 'joint_states')['position']
