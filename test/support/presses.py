# SPDX-License-Identifier: Apache-2.0
"""Synthetic recordings of presses in a plane, from a stiffness matrix."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from needle_identification import BagWriter
import numpy as np
from numpy.typing import ArrayLike
from support.samples import EPOCH, header, STORE, WRENCH

POSE = 'geometry_msgs/msg/PoseStamped'

#: Stiffness [N/m] by force [N]: lower at the larger force, and nearly symmetric.
STIFFNESS = {
    1.1: np.array([[1260.0, -20.0], [-40.0, 1010.0]]),
    1.5: np.array([[960.0, -15.0], [-35.0, 520.0]]),
}

_RATE = 100.0


def presses(seed: int) -> tuple[Any, Any, Any]:
    """Press in eight directions with each force; return time, position and force in the plane."""
    rng = np.random.default_rng(seed)
    rise, hold, rest = np.linspace(0.0, 1.0, 11)[1:], np.ones(30), np.zeros(20)
    shape = np.concatenate([rest, rise, hold, rise[::-1], rest])
    force, position = [], []
    for level, stiffness in STIFFNESS.items():
        for angle in np.arange(8) * np.pi / 4.0:
            push = level * shape[:, np.newaxis] * [np.cos(angle), np.sin(angle)]
            force.append(push + rng.normal(0.0, 2e-3, push.shape))
            moved = np.linalg.solve(stiffness, push.T).T
            position.append(moved + rng.normal(0.0, 1e-6, push.shape))
    time = np.arange(len(shape) * 8 * len(STIFFNESS)) / _RATE
    return time, np.concatenate(position), np.concatenate(force)


def write_presses(path: Path, seed: int = 0, turn_force: ArrayLike = ((1, 0), (0, 1))) -> None:
    """Write a recording of presses, by the topics of the indenter; the force may be turned."""
    kinds = STORE.types
    point, turn = kinds['geometry_msgs/msg/Point'], kinds['geometry_msgs/msg/Quaternion']
    vector, pair = kinds['geometry_msgs/msg/Vector3'], kinds['geometry_msgs/msg/Wrench']
    with BagWriter(path) as bag:
        bag.add_topic('/base_wrench', WRENCH)
        bag.add_topic('/end_effector_pose', POSE)
        for time, (x, z), force_now in zip(*presses(seed), strict=True):
            f_x, f_z = (np.asarray(turn_force) @ force_now).tolist()
            stamp = EPOCH + round(time * 1e9)
            pose = kinds['geometry_msgs/msg/Pose'](point(x, 0.0, z), turn(0.0, 0.0, 0.0, 1.0))
            force = pair(vector(f_x, 0.0, f_z), vector(0.0, 0.0, 0.0))
            for topic, kind, content in (
                ('/end_effector_pose', POSE, pose),
                ('/base_wrench', WRENCH, force),
            ):
                message = kinds[kind](header(stamp), content)
                bag.write(topic, bytes(STORE.serialize_cdr(message, kind)), stamp)
