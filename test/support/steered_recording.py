# SPDX-License-Identifier: Apache-2.0
"""A bag of a steered plant, without nodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from needle_dynamics.simulated.run import Event, PlantRun, TRAJECTORY
from needle_identification.bags.writer import BagWriter


def recorded_plant(
    folder: Path, seed: int, names: Mapping[str, str] | None = None, *, twice: bool = False
) -> Path:
    """
    Record a steered plant with a moving guide and an EM tracker.

    Joints may have other names, with the opposite sign of another robot. The needle may be
    withdrawn and inserted again.
    """
    values = {
        'steered': True, 'mode': 'robot', 'needle': 'bending_35mm', 'rate': 200.0,
        'depth': 0.005, 'seed': seed, 'steering.skin_stiffness': 300.0, 'tip.noise': 1.8e-4,
        'tip.rate': 40.0, 'tip.delay': 0.03, 'tip.dropout': 0.05,
    }  # fmt: skip
    plant, path = PlantRun(values), folder / f'run_{seed}'
    joints, times = ('insertion', 'guide_x', 'guide_z'), [1.0, 5.0, 6.0, 12.0]
    positions = [[0.01, 3e-3, 0.0], [0.045, 3e-3, -2e-3], [0.05, -1e-3, -2e-3], [0.1, 0.0, 2e-3]]
    if twice:
        times += [18.0, 25.0]
        positions += [[0.005, 0.0, 0.0], [0.09, -3e-3, 2e-3]]
    course = {
        'joints': joints, 'times': times, 'positions': positions, 'efforts': [[]] * len(times),
    }  # fmt: skip
    plant.perform(Event(TRAJECTORY, course))
    topics = {
        name: replace(
            topic,
            joints=tuple(one._replace(name=(names or {}).get(one.name, one.name))
                         for one in topic.joints),
        )
        for name, topic in plant.topics.items()
    }  # fmt: skip
    with BagWriter(path) as bag:
        for name, topic in topics.items():
            bag.add_topic(f'/{name}', topic.type_name)
        for k in range(1, 5200 if twice else 2500):
            stamp = 1_700_000_000_000_000_000 + k * 5_000_000
            for name, age, numbers in plant.take(stamp):
                if name == 'joint_states' and names:
                    numbers[0] *= -1.0
                data = topics[name].template().serialize(stamp - age * 5_000_000, *numbers)
                bag.write(f'/{name}', data, stamp)
    return path
