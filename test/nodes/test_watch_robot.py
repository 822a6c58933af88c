# SPDX-License-Identifier: Apache-2.0
"""Node of `needle watch` with the drivers of a robot: own topics, two publishers."""

from __future__ import annotations

from time import monotonic

from needle_insertion.watch.view import View
from needle_insertion.watch.watch_node import WatchNode
from needle_ros import contract
from needle_ros.base_node import profile
import pytest
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.ros_graph import RosGraph

CONFIGURATION = """/controller:
  ros__parameters:
    hardware.joint: slide
    hardware.scale: 0.001
    hardware.state_topic: {topic}
"""


def configure(graph: RosGraph, topic: str) -> None:
    """Publish the configuration of a controller with a robot."""
    node = graph.node('controller')
    qos = profile(contract.CONFIGURATION.qos)
    made = node.create_publisher(String, 'controller/configuration', qos)
    made.publish(String(data=CONFIGURATION.format(topic=topic)))


def test_topic_of_the_robot_is_subscribed(ros_graph: RosGraph) -> None:
    """As soon as the configuration is received; the other topic is left."""
    configure(ros_graph, 'stage/joints')
    driver = ros_graph.node('driver')
    other = driver.create_publisher(JointState, 'joint_states', 10)
    own = driver.create_publisher(JointState, 'stage/joints', 10)
    view = View()
    node = WatchNode(view, ros_graph.context)

    def shown() -> bool:
        other.publish(JointState(name=['slide'], position=[7.0]))
        own.publish(JointState(name=['slide'], position=[50.0]))
        node.poll(monotonic())
        return view.frame(monotonic())['depth'] == pytest.approx(0.05)

    try:
        ros_graph.spin_until(shown, 'the depth', 60.0)
        ros_graph.spin_until(lambda: other.get_subscription_count() == 0, 'its end', 60.0)
    finally:
        node.destroy_node()


def test_invalid_topic_of_the_robot_is_reported(ros_graph: RosGraph) -> None:
    """The topic of the contract stays subscribed."""
    configure(ros_graph, 'a b')
    view = View()
    node = WatchNode(view, ros_graph.context)

    def reported() -> bool:
        node.poll(monotonic())
        return view.robot.words.startswith("hardware: the topic 'a b': Invalid topic name")

    try:
        ros_graph.spin_until(reported, 'the words', 60.0)
        assert {'/joint_states', '/base_wrench'} <= {one.topic_name for one in node.subscriptions}
    finally:
        node.destroy_node()


def test_depth_of_a_slow_publisher_is_shown_with_a_fast_publisher(ros_graph: RosGraph) -> None:
    """Its message, the first of 20 since the last poll, is not replaced by those of an arm."""
    drivers = ros_graph.node('arm'), ros_graph.node('stage')
    arm, stage = (one.create_publisher(JointState, 'joint_states', 10) for one in drivers)
    view = View()
    node = WatchNode(view, ros_graph.context)
    depth = 0.0

    def follows() -> bool:
        nonlocal depth
        node.poll(monotonic())
        seen, told = view.frame(monotonic())['depth'], depth
        depth += 1.0
        stage.publish(JointState(name=['insertion'], position=[depth]))
        for _ in range(20):
            arm.publish(JointState(name=['arm'], position=[1.0]))
        return told > 0.0 and seen == told

    try:
        ros_graph.spin_until(follows, 'the depth of the newest message', 60.0)
    finally:
        node.destroy_node()
