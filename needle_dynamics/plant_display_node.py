# SPDX-License-Identifier: Apache-2.0
"""Visualization messages of the node `plant`: shape, path, poses and transform."""

from typing import Any, Final

from builtin_interfaces.msg import Time as TimeMessage
from geometry_msgs.msg import Point, Pose, PoseArray, Quaternion, TransformStamped, Vector3
from needle_dynamics.simulated.measured import MeasuredShape, SimulatedPlant
from needle_ros import contract
from needle_ros.base_node import BaseNode
from needle_ros.errors import MessageError, ParameterError
from needle_ros.timing import NANOSECONDS
from rclpy.publisher import Publisher
from visualization_msgs.msg import Marker

#: Line widths of needle and path [m].
_WIDTH: Final = 1e-3
_PATH_WIDTH: Final = 5e-4

_RATE: Final = 30.0  #: rate of the messages [Hz]


def time_message(stamp: int) -> TimeMessage:
    return TimeMessage(sec=stamp // NANOSECONDS, nanosec=stamp % NANOSECONDS)


def _line(name: str, width: float, shade: float) -> Marker:
    line = Marker(ns=name, type=Marker.LINE_STRIP)
    line.pose.orientation.w = 1.0
    line.scale.x = width
    line.color.r = line.color.g = line.color.b = shade
    line.color.a = 1.0
    return line


def _transform(shape: MeasuredShape, stamp: int, prefix: str) -> TransformStamped:
    (x, y, z), (i, j, k, w) = shape.tip
    made = TransformStamped(child_frame_id=prefix + contract.TIP)
    made.header.frame_id, made.header.stamp = prefix + contract.BASE, time_message(stamp)
    made.transform.translation = Vector3(x=x, y=y, z=z)
    made.transform.rotation = Quaternion(x=i, y=j, z=k, w=w)
    return made


class PlantDisplay:
    """Publishers for displays: ``needle_shape``, ``needle_poses`` and `/tf`."""

    def __init__(self, node: BaseNode) -> None:
        self._node = node
        self._needle_shape = node.publisher(contract.NEEDLE_SHAPE)
        self._needle_poses = node.publisher(contract.NEEDLE_POSES)
        self._tf: Publisher | None = None
        self._shape = _line('needle', _WIDTH, 0.8)
        self._path = _line('path', _PATH_WIDTH, 0.4)
        self._poses = PoseArray()
        self._prefix = ''

    def begin(self, rate: float) -> None:
        """Restart the count of samples, of which there are ``rate`` per second [Hz]."""
        self._samples, self._every = 0, max(1, round(rate / _RATE))

    def use_frames(self, prefix: str) -> None:
        """Set the prefix of all frames, or raise ParameterError."""
        if prefix.startswith('/'):
            raise ParameterError(f'frame_prefix must not begin with a slash, got {prefix!r}')
        self._prefix = prefix
        for drawn in (self._shape, self._path, self._poses):
            drawn.header.frame_id = prefix + contract.ENTRY

    def offer_transform(self, mode: str) -> None:
        """Create the publisher of transforms, or raise ParameterError if that is not possible."""
        try:
            if mode == 'indenter':
                raise MessageError('there is no needle in mode indenter')
            self._tf = self._node.publisher(contract.TF)
        except MessageError as error:
            raise ParameterError(f'publish_tf must be false: {error}') from error

    def publish(self, plant: SimulatedPlant, stamp: int) -> None:
        """Publish the shape of the needle from base to tip, and the path that it cut, if due."""
        self._samples += 1
        if self._samples % self._every:
            return
        lines = self._needle_shape.get_subscription_count()
        poses = self._needle_poses.get_subscription_count()
        wanted = lines or poses or self._tf is not None
        shape = plant.outline() if wanted else None
        if shape is None:
            return
        if self._tf is not None:
            kind: Any = self._tf.msg_type
            self._tf.publish(kind(transforms=[_transform(shape, stamp, self._prefix)]))
        if lines:
            self._publish_line(self._shape, [shape.base.tolist(), *shape.points.tolist()], stamp)
            if len(shape.path):
                self._publish_line(self._path, shape.path.tolist(), stamp)
        if poses:
            self._poses.header.stamp = time_message(stamp)
            self._poses.poses = [
                Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=i, y=j, z=k, w=w))
                for (x, y, z), (i, j, k, w) in zip(
                    shape.points.tolist(), shape.turns.tolist(), strict=True
                )
            ]
            self._needle_poses.publish(self._poses)

    def _publish_line(self, line: Marker, points: list[list[float]], stamp: int) -> None:
        line.header.stamp = time_message(stamp)
        line.points = [Point(x=x, y=y, z=z) for x, y, z in points]
        self._needle_shape.publish(line)
