# SPDX-License-Identifier: Apache-2.0
"""Compute one sample of a study again and record it to a bag."""

from pathlib import Path

from needle_identification import BagWriter
from needle_ros.errors import JobError
from needle_ros.wire import Template
from needle_study.engine import Results
from needle_study.summary import picked
import numpy as np


def replay_sample(results: Results, number: int, bag: Path) -> bool:
    """Record a sample to a bag; return whether it was compared with a table of the study."""
    study = results.study
    row = study.rows(number, 1)
    if compared := results.table.exists():
        for name, values in row.items():
            (recorded,) = picked(results.table, name, [number])
            if not np.array_equal(values, [recorded], equal_nan=True):
                raise JobError(
                    f'sample {number} differs from {results.table}: {name} was {recorded!r}, '
                    f'and is {values[0]!r}'
                )
    drawn = {name: float(row[name][0]) for name in study.population}
    templates: dict[str, Template] = {}
    with BagWriter(bag) as writer:
        for message in study.scenario.replay(drawn, study.design.noise(number)):
            name = f'/{message.topic.name}'
            if name not in templates:
                templates[name] = message.topic.template()
                writer.add_topic(name, message.topic.type_name)
            data = templates[name].serialize(message.stamp, *message.values)
            writer.write(name, data, message.stamp)
    return compared
