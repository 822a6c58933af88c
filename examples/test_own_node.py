# SPDX-License-Identifier: Apache-2.0
"""
Test a node of your own with the simulated robot: ``pytest examples/test_own_node.py``.

`Graph` starts nodes of the package as processes on a free ROS domain of this machine, spins your
own nodes in the thread of the test, and ends everything.
"""

from pathlib import Path
from typing import Any

from geometry_msgs.msg import WrenchStamped
from needle_insertion.graph.ros_graph import Graph
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState

DEPTH, STIFFNESS = 0.05, 1000.0


class SpringNode(Node):
    """Control law of your own: a spring between the needle base and a depth of 50 mm."""

    def __init__(self, **options: Any) -> None:
        super().__init__('spring', **options)
        self.commands = self.create_publisher(WrenchStamped, 'wrench_command', 1)
        self.create_subscription(
            JointState, 'joint_states', self.on_state, qos_profile_sensor_data
        )

    def on_state(self, state: JointState) -> None:
        """Answer a sample of the encoders."""
        command = WrenchStamped()
        command.header.stamp, command.header.frame_id = state.header.stamp, 'needle_base'
        depth = state.position[state.name.index('insertion')]
        command.wrench.force.y = STIFFNESS * (DEPTH - depth)
        self.commands.publish(command)


def test_the_spring_reaches_its_depth(tmp_path: Path) -> None:
    """To a millimeter: friction holds the needle where the spring pushes with less than 0.56 N."""
    with Graph(tmp_path) as graph:
        graph.start('plant', {'needle': 'phantom', 'depth': 0.04})
        user = graph.node('user')
        states = graph.latest(user, JointState, 'joint_states', qos_profile_sensor_data)
        graph.wait_active(user, 'plant')
        graph.add(SpringNode)

        def is_there() -> bool:
            state = states.message
            return state is not None and abs(state.position[0] - DEPTH) < 0.001

        graph.spin_until(is_there, 'the depth')
