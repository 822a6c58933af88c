# SPDX-License-Identifier: Apache-2.0
"""Execution of a joint trajectory by a controller."""

from needle_controller.controller import Controller
from needle_ros.contract import INSERTION
from needle_ros.trajectories import joint_values, JointPath


def follow_path(path: JointPath, controller: Controller, elapsed: float) -> None:
    """Follow the insertion in a path, at a time after its start [s]; without points, stop."""
    path = path.after(elapsed)
    if path.stops:
        if path.joints:
            joint_values(INSERTION, path.joints, ())
        controller.stop_motion()
        return
    depths, rates = (
        [one for one in joint_values(INSERTION, path.joints, values) if one is not None]
        for values in (path.positions, path.velocities)
    )
    controller.follow(path.times, depths, rates or None)
