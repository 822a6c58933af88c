# SPDX-License-Identifier: Apache-2.0
"""The topic contract agrees with the documentation and the model."""

from __future__ import annotations

from pathlib import Path

from needle_dynamics import NeedleModel, NeedleParameters
from needle_ros.contract import GROUND_TRUTH, ground_truth, TOPICS
from needle_ros.wire import JOINT_STATE, TYPES
import pytest

PAGE = Path(__file__).resolve().parents[2] / 'docs' / 'architecture.md'


def row(name: str) -> str:
    """Return the row of a topic in the table of the documentation."""
    topic = next(topic for topic in TOPICS if topic.name == name)
    joints = ', '.join(
        f'`{joint.name}` [{joint.unit}], [{joint.unit}/s]'
        + (f', [{joint.effort}]' if joint.effort else '')
        for joint in topic.joints
    )
    type_name = topic.type_name.replace('/msg/', '/')
    frame = f'`{topic.frame}`' if topic.frame else ''
    meaning = f'{joints}: {topic.meaning}' if joints else topic.meaning
    return (
        f'| `{topic.name}` | `{type_name}` | {topic.publisher} | {topic.qos.name} | {frame} | '
        f'{meaning} |'
    )


def test_documented_topic_table_equals_the_contract() -> None:
    """A failure prints the rows to copy."""
    table = [row(topic.name) for topic in TOPICS]
    page = PAGE.read_text(encoding='utf-8').splitlines()
    begin = next(k for k, line in enumerate(page) if line.startswith('| topic |')) + 2
    assert page[begin : begin + len(table)] == table, '\n'.join(table)


@pytest.mark.parametrize('topic', TOPICS, ids=lambda topic: topic.name)
def test_topic_quantities_match_its_template(topic: object) -> None:
    """Topics of other types have no quantities."""
    topic = next(known for known in TOPICS if known is topic)
    assert len({known.name for known in TOPICS}) == len(TOPICS)
    if topic.type_name not in TYPES:
        assert topic.quantities == ()
        return
    template = topic.template()
    assert sum(count for _, count in template.arrays) == len(topic.quantities) > 0
    assert template.frame == topic.frame
    assert bool(topic.joints) == (topic.type_name == JOINT_STATE)


@pytest.mark.parametrize('modes', [1, 2, 5])
def test_ground_truth_has_the_coordinates_of_the_model(modes: int) -> None:
    """Positions, velocities and, if commanded, efforts."""
    model = NeedleModel(NeedleParameters(modes=modes, minimum_depth=0.1))
    names = model.coordinate_names
    for commanded in (False, True):
        topic = ground_truth(modes, commanded=commanded)
        assert [joint.name for joint in topic.joints] == list(names)
        assert len(topic.quantities) == (3 if commanded else 2) * len(names)
    assert GROUND_TRUTH.name == topic.name
