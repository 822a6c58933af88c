# SPDX-License-Identifier: Apache-2.0
"""
Simulate two robot drivers with their own topics, joints and units, for `hardware.*` parameters.

The first driver accepts efforts, like a forward controller of ros2_control; the second follows
positions. Run a driver, and the controller with the parameters in docs/howto/own-robot.md.
"""

from contextlib import suppress
from math import copysign, exp
import sys
from typing import Any

from geometry_msgs.msg import WrenchStamped
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

PERIOD = 0.005


class Mass:
    """Mass of 0.5 kg with friction, on a slide that is positive out of the tissue."""

    position, velocity, effort = 0.18, 0.0, 0.0

    def move(self, h: float) -> None:
        """Advance the mass by a time [s]."""
        push = self.velocity + self.effort * h / 0.5
        self.velocity = copysign(max(abs(push) - 0.5 * h / 0.5, 0.0), push) / (1 + 300 * h / 0.5)
        self.position += self.velocity * h


class ForceRobot(Node):
    """Driver with effort commands and a force sensor whose z axis points out of the tissue."""

    def __init__(self, **options: Any) -> None:
        super().__init__('force_robot', **options)
        self.mass, self.last = Mass(), self.get_clock().now()
        self.states = self.create_publisher(JointState, 'joint_states', 10)
        self.wrenches = self.create_publisher(WrenchStamped, 'ft_sensor/wrench', 10)
        self.create_subscription(Float64MultiArray, 'slide/commands', self.on_command, 10)
        self.create_timer(PERIOD, self.sample)

    def on_command(self, message: Float64MultiArray) -> None:
        """Store a command."""
        self.mass.effort = message.data[0]

    def sample(self) -> None:
        """Advance the mass, and publish the measurements."""
        mass, now = self.mass, self.get_clock().now()
        mass.move((now - self.last).nanoseconds * 1e-9)
        self.last = now
        state = JointState(name=['door', 'slide'], position=[1.0, mass.position])
        state.velocity, state.effort = [0.0, mass.velocity], [0.0, mass.effort]
        wrench = WrenchStamped()
        state.header.stamp = wrench.header.stamp = now.to_msg()
        wrench.header.frame_id, wrench.wrench.force.z = 'ft_frame', -mass.effort
        self.states.publish(state)
        self.wrenches.publish(wrench)


class PositionRobot(Node):
    """Driver of a stage in mm that follows position commands with a lag of 20 ms."""

    def __init__(self, **options: Any) -> None:
        super().__init__('position_robot', **options)
        self.position = self.goal = 120.0
        self.states = self.create_publisher(JointState, 'joint_states', 10)
        self.create_subscription(JointTrajectory, 'stage/joint_trajectory', self.on_command, 10)
        self.create_timer(PERIOD, self.sample)
        self.last = self.get_clock().now()

    def on_command(self, message: JointTrajectory) -> None:
        """Store a command."""
        self.goal = message.points[-1].positions[0]

    def sample(self) -> None:
        """Advance the stage, and publish the measured position."""
        now = self.get_clock().now()
        h, self.last = (now - self.last).nanoseconds * 1e-9, now
        self.position += (self.goal - self.position) * (1.0 - exp(-h / 0.02))
        state = JointState(name=['stage'], position=[self.position])
        state.header.stamp = now.to_msg()
        self.states.publish(state)


if __name__ == '__main__':
    rclpy.init()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(PositionRobot() if 'position' in sys.argv else ForceRobot())
