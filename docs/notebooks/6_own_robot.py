# SPDX-License-Identifier: Apache-2.0
"""
Your robot, first in simulation
===============================

A robot has its own joint names, units and directions. Describe them by settings, and check them in
a closed loop before anything moves.
"""

# %%
# The settings
# ------------
# The joint ``slide`` is in mm and increases out of the tissue; it is at 180 mm when the tip
# touches the skin. These are the parameters ``hardware.*`` of the node ``controller``.

from needle_controller import (
    Controller,
    ControllerOutput,
    ForceCommand,
    HardwareSettings,
    Measurement,
    Reading,
    Robot,
    run_controller,
)
from needle_dynamics import NeedleModel, NeedleParameters, ParameterError

settings = HardwareSettings(
    joint='slide',
    sign=-1.0,
    scale=1e-3,
    zero=180.0,
    command_topic='slide/commands',
    command_type='float64_multi_array',
)


# %%
# The simulated robot
# -------------------
# It reports its joint in mm and mm/s, and applies an effort: effort times joint velocity is force
# times needle velocity, so that an effort of 1 is a force of -1000 N here.


class SimulatedRobot:
    """Controller behind a robot with its own joint, as a law for the simulated needle."""

    def __init__(self, controller: Controller, settings: HardwareSettings, joint: str) -> None:
        self.controller, self.robot, self.joint = controller, Robot(settings), joint
        self.period, self.delay = controller.period, controller.delay
        self.positions: list[float] = []

    def command(self, measured: Measurement, load: float = 0.0) -> ControllerOutput:
        """Report the joint state, and apply the effort that the controller answers."""
        position, velocity = 180.0 - 1e3 * measured.depth, -1e3 * measured.velocity
        self.positions.append(position)
        state = Reading(
            stamp=round(1e9 * measured.time),
            frame='',
            names=('door', self.joint),
            values=((1.0, position), (0.0, velocity), ()),
        )
        answer = self.controller.command(self.robot.measurement(state), load)
        (effort,) = self.robot.command(ForceCommand(state.stamp, answer.force))
        return ControllerOutput(force=-1e3 * effort)


# %%
# Close the loop
# --------------
# From 20 mm to a depth of 60 mm.

needle = NeedleParameters.preset('phantom')
start = NeedleModel(needle).state_at(depth=0.02)
controller = Controller(needle)
controller.set_target(0.06)
robot = SimulatedRobot(controller, settings, 'slide')
run = run_controller(robot, needle, start, duration=6.0)
run.plot()
print(f'slide from {robot.positions[0]:.2f} mm to {robot.positions[-1]:.2f} mm')
print(f'depth at the end: {1e3 * run.depth[-1]:.3f} mm')

# %%
# A wrong name
# ------------
# The message lists the joints that the robot reports.

controller = Controller(needle)
controller.set_target(0.06)
try:
    run_controller(SimulatedRobot(controller, settings, 'z'), needle, start, duration=1.0)
except ParameterError as error:
    print(error)

# %%
# A driver in ROS
# ---------------
# ``examples/robot_driver.py`` is such a robot as a node; :doc:`/howto/own-robot` lists all
# settings and the check of the first motion.
