# SPDX-License-Identifier: Apache-2.0
"""Simulated recordings for identification, and their bags."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from needle_dynamics import Integrator, NeedleParameters
from needle_dynamics.simulated.force_sensor import ForceSensor, ForceSensorParameters
from needle_identification import BagWriter, Recording
import numpy as np
from rosbags.typesys import get_typestore, Stores

WRENCH = 'geometry_msgs/msg/WrenchStamped'
MOTION = 'sensor_msgs/msg/JointState'
TEXT = 'std_msgs/msg/String'
#: Start of the recordings [ns], not representable by float64 seconds.
EPOCH = 1_700_000_000_123_456_789
STORE = get_typestore(Stores.ROS2_JAZZY)
TRUTH = NeedleParameters.preset('paper_mm')
IDEAL = ForceSensorParameters(
    force_noise=0.0, torque_noise=0.0, force_resolution=0.0, torque_resolution=0.0, filter=0
)
NOISY = ForceSensorParameters(filter=3)
#: Velocities [m/s] of strokes in both directions, each followed by its duration [s].
THERE_AND_BACK = tuple(
    leg
    for speed in (2e-3, 4e-3, 6e-3, 8e-3)
    for leg in ((0.0, 0.3), (speed, 1.2), (0.0, 0.3), (-speed, 1.2))
)


def header(stamp_ns: int) -> Any:
    stamp = STORE.types['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 10**9))
    return STORE.types['std_msgs/msg/Header'](stamp, 'needle_base')


def wrench(stamp_ns: int, force: float) -> bytes:
    vector = STORE.types['geometry_msgs/msg/Vector3']
    pair = STORE.types['geometry_msgs/msg/Wrench'](vector(0.0, force, 0.0), vector(0.0, 0.0, 0.0))
    return bytes(STORE.serialize_cdr(STORE.types[WRENCH](header(stamp_ns), pair), WRENCH))


def joint_states(
    stamp_ns: int, depth: float, velocity: float | None, names: Sequence[str] = ('insertion',)
) -> bytes:
    message = STORE.types[MOTION](
        header(stamp_ns),
        list(names),
        np.array([depth] * len(names)),
        np.array([] if velocity is None else [velocity] * len(names)),
        np.array([]),
    )
    return bytes(STORE.serialize_cdr(message, MOTION))


def text(data: str) -> bytes:
    return bytes(STORE.serialize_cdr(STORE.types[TEXT](data), TEXT))


@lru_cache(maxsize=8)
def motion(
    legs: tuple[tuple[float, float], ...], rate: float, acceleration: float = 0.1
) -> tuple[Any, Any, Any]:
    """Move the base of the simulated needle; return depth, velocity and true axial force."""
    integrator = Integrator(TRUTH, [0.17, 0, 0, 0, 0, 0, 0, 0], step=1e-3)
    rows = []
    for velocity, duration in legs:
        ramp = max(1, round(abs(velocity - integrator.velocity) / acceleration * rate))
        rise = np.linspace(integrator.velocity, velocity, ramp + 1)[1:]
        for target in [*rise, *[velocity] * round(duration * rate)]:
            force = integrator.advance_moved(1.0 / rate, target).axial_force
            rows.append((integrator.depth, integrator.velocity, force))
    depth, velocities, force = np.array(rows).T
    return depth, velocities, force


def simulated(
    legs: tuple[tuple[float, float], ...] = THERE_AND_BACK,
    *,
    sensor: ForceSensorParameters = IDEAL,
    rate: float = 250.0,
    seed: int = 0,
) -> Recording:
    """Record the simulated needle with a simulated sensor."""
    depth, velocity, force = motion(legs, rate)
    device = ForceSensor(sensor, rate, seed)
    true = np.zeros((len(force), 6))
    true[:, 1] = force
    return Recording(
        name=f'simulated {seed}',
        time=np.arange(len(force)) / rate,
        depth=depth,
        velocity=velocity,
        force=np.array([device.measure(row)[1] for row in true]),
    )


def write_bag(path: Path, recording: Recording, configuration: str = '') -> None:
    """Write a recording with the topics of the plant."""
    assert recording.velocity is not None
    with BagWriter(path) as bag:
        bag.add_topic('/base_wrench', WRENCH)
        bag.add_topic('/wrench_command', WRENCH)
        bag.add_topic('/joint_states', MOTION)
        bag.add_topic('/ground_truth', MOTION)
        bag.add_topic('/plant/configuration', TEXT)
        if configuration:
            bag.write('/plant/configuration', text(configuration), EPOCH)
        for time, depth, velocity, force in zip(
            recording.time, recording.depth, recording.velocity, recording.force, strict=True
        ):
            stamp = EPOCH + round(time * 1e9)
            bag.write('/base_wrench', wrench(stamp, force), stamp)
            bag.write('/wrench_command', wrench(stamp, 0.0), stamp)
            bag.write('/joint_states', joint_states(stamp, depth, velocity), stamp)
            bag.write('/ground_truth', joint_states(stamp, 0.0, 0.0), stamp)


def grid(
    count: int = 11, step: int = 10
) -> tuple[list[tuple[int, float]], list[tuple[int, float, float]]]:
    """Return forces, and depths with velocities, with times at equal steps [ns]."""
    return [(i * step, float(i)) for i in range(count)], [
        (i * step, 0.1 + 0.001 * i, 0.1) for i in range(count)
    ]
