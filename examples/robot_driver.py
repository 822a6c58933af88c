"""
Drivers of two robots that know nothing of the needle: how to drive them with parameters only.

The first one takes efforts as a forward controller of ros2_control does, the second one follows
positions. Run one of them, and the controller with the parameters in docs/howto/own-robot.md.
"""

from math import copysign, exp
import sys
from typing import Any

from geometry_msgs.msg import WrenchStamped
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

PERIOD = 0.005


class Mass:
    """0.5 kg with friction, on a slide that counts out of the tissue."""

    position, velocity, effort = 0.18, 0.0, 0.0

    def move(self, h: float) -> None:
        """Move for a time [s]."""
        push = self.velocity + self.effort * h / 0.5
        self.velocity = copysign(max(abs(push) - 0.5 * h / 0.5, 0.0), push) / (1 + 300 * h / 0.5)
        self.position += self.velocity * h


class ForceRobot(Node):
    """Drives the mass by efforts; a force sensor that looks out of the tissue feels the needle."""

    def __init__(self, **options: Any) -> None:
        super().__init__('force_robot', **options)
        self.mass, self.last = Mass(), self.get_clock().now()
        self.states = self.create_publisher(JointState, 'joint_states', 10)
        self.wrenches = self.create_publisher(WrenchStamped, 'ft_sensor/wrench', 10)
        self.create_subscription(Float64MultiArray, 'slide/commands', self.on_command, 10)
        self.create_timer(PERIOD, self.sample)

    def on_command(self, message: Float64MultiArray) -> None:
        """Take a command."""
        self.mass.effort = message.data[0]

    def sample(self) -> None:
        """Move, and say what is measured."""
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
    """A stage that counts in mm and follows positions with a lag of 20 ms; nothing else."""

    def __init__(self, **options: Any) -> None:
        super().__init__('position_robot', **options)
        self.position = self.goal = 120.0
        self.states = self.create_publisher(JointState, 'joint_states', 10)
        self.create_subscription(JointTrajectory, 'stage/joint_trajectory', self.on_command, 10)
        self.create_timer(PERIOD, self.sample)
        self.last = self.get_clock().now()

    def on_command(self, message: JointTrajectory) -> None:
        """Take a command."""
        self.goal = message.points[-1].positions[0]

    def sample(self) -> None:
        """Move, and say what is measured."""
        now = self.get_clock().now()
        h, self.last = (now - self.last).nanoseconds * 1e-9, now
        self.position += (self.goal - self.position) * (1.0 - exp(-h / 0.02))
        state = JointState(name=['stage'], position=[self.position])
        state.header.stamp = now.to_msg()
        self.states.publish(state)


if __name__ == '__main__':
    rclpy.init()
    rclpy.spin(PositionRobot() if 'position' in sys.argv else ForceRobot())
