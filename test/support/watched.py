# SPDX-License-Identifier: Apache-2.0
"""Bag with all topics of the page of `needle watch`, and a browser to view it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

from needle_identification import BagWriter
from needle_identification.bags.messages import encode, message_type
from needle_ros import contract
from needle_ros.status import (
    ControllerStatus,
    NodeReport,
    NodeStatus,
    PlantStatus,
    read_reports,
    SteeringStatus,
)
import numpy as np
from support.samples import EPOCH

#: Sample rate [Hz], and duration [s].
RATE: Final = 50
DURATION: Final = 4.0

#: Target of the tip [m].
TARGET: Final = (4e-3, 0.1, -2e-3)

CONFIGURATIONS: Final = {
    'plant': """/plant:
  ros__parameters:
    model.length: 0.2
    model.tissue_stiffness: 520.0
    model.layer_depths: [0.04]
    model.layer_stiffnesses: [20000.0]
    steered: true
    steering.free_length: 0.04
    steering.membrane_depths: [0.03]
    steering.membrane_strengths: [1.2]
""",
    'controller': """/controller:
  ros__parameters:
    force_limit: 15.0
    lowest_depth: 0.0
    highest_depth: 10.0
    model.length: 0.2
    model.minimum_depth: 0.001
    safety.speed: 0.1
    safety.tracking_error: 0.01
    safety.tip_deflection: 0.05
    safety.axial_load: 30.0
""",
    'steering': """/steering:
  ros__parameters:
    model.length: 0.2
""",
}


def made(type_name: str, **values: Any) -> Any:
    """Create a message."""
    return message_type(type_name)(**values)


def header(stamp: int, frame: str = 'needle_entry') -> Any:
    time = made('builtin_interfaces/msg/Time', sec=stamp // 10**9, nanosec=stamp % 10**9)
    return made('std_msgs/msg/Header', stamp=time, frame_id=frame)


def marker(name: str, points: Any, stamp: int = 0) -> Any:
    """Create a line of `needle_shape`."""
    point, color = 'geometry_msgs/msg/Point', 'std_msgs/msg/ColorRGBA'
    zero = made(point, x=0.0, y=0.0, z=0.0)
    level = made('geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=0.0, w=1.0)
    return made(
        'visualization_msgs/msg/Marker', header=header(stamp), ns=name, id=0, type=4, action=0,
        pose=made('geometry_msgs/msg/Pose', position=zero, orientation=level),
        scale=made('geometry_msgs/msg/Vector3', x=1e-3, y=0.0, z=0.0),
        color=made(color, r=0.8, g=0.8, b=0.8, a=1.0),
        lifetime=made('builtin_interfaces/msg/Duration', sec=0, nanosec=0), frame_locked=False,
        points=[made(point, x=x, y=y, z=z) for x, y, z in np.asarray(points).tolist()],
        colors=[], texture_resource='',
        texture=made(
            'sensor_msgs/msg/CompressedImage', header=header(stamp), format='',
            data=np.zeros(0, np.uint8),
        ),
        uv_coordinates=[], text='', mesh_resource='',
        mesh_file=made(
            'visualization_msgs/msg/MeshFile', filename='', data=np.zeros(0, np.uint8)
        ),
        mesh_use_embedded_materials=False,
    )  # fmt: skip


def status(name: str, message: str, typed: NodeStatus | None = None, level: int = 0) -> Any:
    """Create the DiagnosticStatus of a node."""
    values = {} if typed is None else typed.to_values()
    pairs = [
        made('diagnostic_msgs/msg/KeyValue', key=key, value=value) for key, value in values.items()
    ]
    return made(
        'diagnostic_msgs/msg/DiagnosticStatus', level=level, name=name, message=message,
        hardware_id='', values=pairs,
    )  # fmt: skip


def report(*about: Any, **more: Any) -> NodeReport:
    """Create the report of a node from its `status`."""
    [found] = read_reports(SimpleNamespace(status=[status(*about, **more)]))
    return found


def expected(x: float, z: float, deviation: float, depth: float = TARGET[1]) -> Any:
    """Create a predicted tip pose."""
    covariance = np.zeros(36)
    covariance[[0, 14]] = deviation**2
    pose = made(
        'geometry_msgs/msg/Pose',
        position=made('geometry_msgs/msg/Point', x=x, y=depth, z=z),
        orientation=made('geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=0.0, w=1.0),
    )
    return made(
        'geometry_msgs/msg/PoseWithCovarianceStamped',
        header=header(0),
        pose=made('geometry_msgs/msg/PoseWithCovariance', pose=pose, covariance=covariance),
    )


def shape(depth: float) -> Any:
    """Return points of a bent needle, shape (k, 3) [m]."""
    y = np.linspace(-0.04, depth, 60)
    inside = np.maximum(y, 0.0)
    return np.column_stack([0.4 * inside**2, y, -0.2 * inside**2])


def write_watched(path: Path, space: str = '') -> None:
    """Write the bag of a steered insertion to 8 cm."""
    with BagWriter(path) as bag:
        for node, text in CONFIGURATIONS.items():
            bag.add_topic(f'{space}/{node}/configuration', contract.CONFIGURATION.type_name)
            data = encode(made('std_msgs/msg/String', data=text))
            bag.write(f'{space}/{node}/configuration', data, EPOCH)
        states = contract.steered_states()
        streams = (
            states, contract.BASE_WRENCH, contract.TIP_DEFLECTION, contract.REFERENCE,
            contract.TRACKING_ERROR,
        )  # fmt: skip
        write = {topic.name: topic.template().serialize for topic in streams}
        for topic in (*streams, contract.NEEDLE_SHAPE, contract.TIP_EXPECTED):
            bag.add_topic(f'{space}/{topic.name}', topic.type_name)
        bag.add_topic('/diagnostics', contract.DIAGNOSTICS.type_name)
        for k in range(round(DURATION * RATE) + 1):
            time = k / RATE
            stamp, depth = EPOCH + round(time * 1e9), 0.02 * time
            x, _, z = shape(depth)[-1].tolist()
            numbers = {
                'joint_states': [depth, 1e-3, 0.0, 0.0, 0.0, 0.0, 0.02, *[0.0] * 5, *[0.0] * 6],
                'base_wrench': [0.0, 2.0 + time, 0.0, 0.0, 0.0, 0.0],
                'tip_deflection': [x, depth, z],
                'reference': [depth + 1e-4, 0.02],
                'tracking_error': [1e-4, 0.0],
            }
            for name, values in numbers.items():
                bag.write(f'{space}/{name}', write[name](stamp, *values), stamp)
            for name in ('needle', 'path'):
                line = shape(depth) if name == 'needle' else shape(depth)[20:]
                bag.write(f'{space}/needle_shape', encode(marker(name, line, stamp)), stamp)
            if k % RATE:
                continue
            said = [
                status('/plant', 'active', PlantStatus()),
                status('/controller', 'active', ControllerStatus()),
                status('/steering', 'inserts', SteeringStatus(target=TARGET), int(time > 2.5)),
            ]
            # The controller has ended earlier.
            array = made(
                'diagnostic_msgs/msg/DiagnosticArray',
                header=header(stamp),
                status=said if time < 0.5 else [said[0], said[2]],
            )
            bag.write('/diagnostics', encode(array), stamp)
            data = encode(expected(TARGET[0] + 1e-4, TARGET[2], 1e-3 / (1.0 + time)))
            bag.write(f'{space}/tip_expected', data, stamp)
