"""One sample of a study, computed again into a bag."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from needle_dynamics import SteeredNeedle
from needle_identification import BagWriter
from needle_insertion.study.engine import Results
from needle_insertion.study.summary import column
from needle_ros import contract
from needle_ros.errors import JobError, ParameterError
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import JOINT_STATE, Template
import numpy as np

#: Velocity by which the depths of the looks become times [m/s].
_SPEED: Final = 0.01


def replay(results: Results, number: int, bag: Path) -> bool:
    """
    Compute a sample again, and write what a robot and a tracker would have seen of it.

    Parameters
    ----------
    results : Results
        The study; if its table is complete, the sample is compared with it.
    number : int
        Number of the sample.
    bag : Path
        Bag to write, with `joint_states`, `tip_deflection` and `target`: a message after each
        step. They are stamped as if the needle had gone in at 1 cm/s.

    Returns
    -------
    bool
        Whether there was a table to compare with.

    Raises
    ------
    ParameterError
        If there is no such sample.
    JobError
        If the table has other numbers.

    """
    study = results.study
    if not 0 <= number < study.samples:
        raise ParameterError(
            f'--replay must be from 0 to {study.samples - 1}, the samples of the study, got '
            f'{number}'
        )
    row = study.rows(number, 1)
    if compared := results.table.exists():
        for name, values in row.items():
            recorded = column(results.table, name)[number]
            if not np.array_equal(values, [recorded], equal_nan=True):
                raise JobError(
                    f'sample {number} differs from {results.table}: {name} was {recorded!r}, '
                    f'and is {values[0]!r}'
                )
    joints = [contract.INSERTION, *(joint.name for joint in contract.STEERING_JOINTS)]
    states = Template(JOINT_STATE, names=joints, counts=(len(joints), len(joints), 0))
    tips, targets = contract.TIP_DEFLECTION.template(), contract.TARGET.template()
    drawn = {name: float(row[name][0]) for name in study.population}
    tilt = [drawn.get(name, 0.0) for name in ('tilt_x', 'tilt_z')]
    frame = np.array([drawn.get(name, 0.0) for name in ('frame_x', 'frame_z')])
    with BagWriter(bag) as writer:
        for topic in (contract.JOINT_STATES, contract.TIP_DEFLECTION, contract.TARGET):
            writer.add_topic(f'/{topic.name}', topic.type_name)

        def watch(one: SteeredNeedle) -> None:
            stamp = round(one.depth / _SPEED * NANOSECONDS)
            at = (one.depth, *one.guide, *tilt, one.roll)
            rest = np.zeros(len(joints)).tolist()
            writer.write('/joint_states', states.serialize(stamp, *at, *rest), stamp)
            x, z = (one.tip[[0, 2]] + frame * one.depth).tolist()
            writer.write('/tip_deflection', tips.serialize(stamp, x, one.depth, z), stamp)

        target = study.protocol.replay(drawn, study.rng(number, 1), watch)
        writer.write('/target', targets.serialize(0, *target.tolist()), 0)
    return compared
