"""The contract is the one that the documentation shows, and the one that the model needs."""

from __future__ import annotations

from pathlib import Path

from needle_dynamics import NeedleModel, NeedleParameters
from needle_ros.contract import GROUND_TRUTH, ground_truth, TOPICS
from needle_ros.wire import JOINT_STATE, TYPES
import pytest

PAGE = Path(__file__).resolve().parents[2] / 'docs' / 'architecture.md'


def row(name: str) -> str:
    """Return the row of a topic as the table of the documentation has it."""
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


def test_the_documentation_has_the_table_of_topics() -> None:
    """All of them, in the order of the contract; a difference shows the rows to copy."""
    table = [row(topic.name) for topic in TOPICS]
    page = PAGE.read_text(encoding='utf-8').splitlines()
    begin = next(k for k, line in enumerate(page) if line.startswith('| topic |')) + 2
    assert page[begin : begin + len(table)] == table, '\n'.join(table)


@pytest.mark.parametrize('topic', TOPICS, ids=lambda topic: topic.name)
def test_a_topic_names_each_of_its_numbers(topic: object) -> None:
    """Its template has as many numbers, and what is not read from bytes has none."""
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
def test_the_ground_truth_has_the_coordinates_of_the_model(modes: int) -> None:
    """Positions, velocities and, if it is commanded, efforts of each."""
    model = NeedleModel(NeedleParameters(modes=modes, minimum_depth=0.1))
    names = model.coordinate_names
    for commanded in (False, True):
        topic = ground_truth(modes, commanded=commanded)
        assert [joint.name for joint in topic.joints] == list(names)
        assert len(topic.quantities) == (3 if commanded else 2) * len(names)
    assert GROUND_TRUTH.name == topic.name
