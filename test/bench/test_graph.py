# SPDX-License-Identifier: Apache-2.0
"""Benchmark of the nodes: metrics and loss counts; times are not tested."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks import endurance
from benchmarks import graph as bench_graph
from benchmarks import pairs as bench_pairs
from benchmarks.bare import BytesSender, PERIOD, Sender, STREAMS
from benchmarks.graph import GraphPlan
from benchmarks.measure import Bar
from benchmarks.page import PageSection
from benchmarks.pairs import Figures, PAIRS
from needle_identification import BagWriter
from needle_identification.bags.messages import encode, message_type
from needle_insertion.graph.ros_graph import Graph
from needle_ros.base_node import SENSOR
import numpy as np
import pytest


@pytest.fixture(scope='module')
def found(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[GraphPlan, list[str], dict[str, list[dict[str, float]]]]:
    plan = GraphPlan(rounds=1, turn=0.2, recording=1.0, memory=1.0)
    told: list[str] = []
    folder = tmp_path_factory.mktemp('graph')
    with pytest.MonkeyPatch.context() as patch:
        # Only the presence of the metrics is tested, without settling time.
        patch.setattr(bench_pairs, '_SETTLE', 0.05)
        pairs = bench_graph.compare_pairs(folder, plan, told.append)
    return plan, told, pairs


def test_every_node_pair_has_all_metrics(
    found: tuple[GraphPlan, list[str], dict[str, list[dict[str, float]]]],
) -> None:
    plan, told, pairs = found
    assert tuple(pairs) == PAIRS
    names = list(pairs['needle'][0])
    assert len(names) == len(set(names)) == 14
    for [figures] in pairs.values():
        assert list(figures) == names
        assert all(np.isfinite(value) and value >= 0.0 for value in figures.values())
        assert figures['round trip, p50 [us]'] > 0.0
    assert 'starting: needle' in told
    section, bars = bench_graph.side_by_side(pairs, plan)
    assert [row[0] for row in section.rows] == names
    assert set(PAIRS) < set(section.heads)
    assert [bar.limit for bar in bars] == [1.3, 1.5, 1.3, 1.5, 1.5, 1.5, 1.5]
    assert all(bar.found > 0.0 and not bar.at_least for bar in bars)


def test_bare_nodes_send_equal_samples_as_objects_and_as_bytes(tmp_path: Path) -> None:
    with Graph(tmp_path) as graph:
        node = graph.node('samples')
        received: dict[str, list[Any]] = {name: [] for name in STREAMS}
        for name, kind in STREAMS.items():
            node.create_subscription(kind, name, received[name].append, SENSOR)
        objects, data = Sender(node), BytesSender(node)
        graph.spin_until(
            lambda: all(node.count_publishers(name) == 2 for name in STREAMS), 'discovery', 60.0
        )
        graph.spin_until(objects.has_readers, 'subscriptions', 60.0)
        objects.send(12_345_678_901, 0.07)
        data.send(12_345_678_901, 0.07)
        graph.spin_until(
            lambda: all(len(found) == 2 for found in received.values()), 'samples', 60.0
        )
    for first, second in received.values():
        assert first == second


def test_recorder_receives_counted_messages(tmp_path: Path) -> None:
    [section], [bar] = endurance.record(tmp_path, 1.0)
    assert 'lost' in [row[0] for row in section.rows]
    # Losses depend on the machine; most messages are recorded.
    assert 0.0 <= bar.found < 5000.0
    numbers = endurance.sample_numbers(tmp_path / 'bag')
    assert set(numbers) == {*STREAMS, 'wrench_command'}
    for found in numbers.values():
        assert 0 < found.min() < found.max()


def test_memory_growth_is_measured(tmp_path: Path) -> None:
    [section], [bar] = endurance.watch_memory(tmp_path, 1.0, lambda _stage: None)
    assert [row[0] for row in section.rows] == ['plant', 'controller', 'recorder']
    assert bar.figure.startswith('growth of memory in 1 s')


def write_bag(path: Path, numbers: list[int]) -> None:
    """Write a message of a topic, and messages of another topic with the given sample numbers."""
    time_of, header = (
        message_type(n) for n in ('builtin_interfaces/msg/Time', 'std_msgs/msg/Header')
    )
    kind = 'geometry_msgs/msg/PointStamped'
    point = message_type('geometry_msgs/msg/Point')(0.0, 0.0, 0.0)
    with BagWriter(path) as bag:
        for topic in ('/tip_deflection', '/target'):
            bag.add_topic(topic, kind)
        bag.write('/target', encode(message_type(kind)(header(time_of(0, 0), ''), point)), 1)
        for number in numbers:
            stamp = time_of(*divmod(number * PERIOD, 1_000_000_000))
            message = message_type(kind)(header(stamp, 'needle_entry'), point)
            bag.write('/tip_deflection', encode(message), 1)


def test_sample_numbers_of_bag_follow_from_stamps(tmp_path: Path) -> None:
    expected = [1, 2, 2, 5, 1234]
    write_bag(tmp_path / 'bag', expected)
    numbers = endurance.sample_numbers(tmp_path / 'bag')
    assert numbers.pop('tip_deflection').tolist() == expected
    assert all(len(others) == 0 for others in numbers.values())


def test_losses_count_missing_samples_after_first_second() -> None:
    numbers = {'a': np.array([900, 1001, 1002, 1002, 1004, 1005]), 'b': np.arange(1000, 1006)}
    assert endurance.losses(numbers, 1005) == {'a': 1, 'b': 0}


def test_ratio_is_median_over_rounds() -> None:
    ours = [{'x': 2.0}, {'x': 30.0}, {'x': 3.0}]
    theirs = [{'x': 1.0}, {'x': 10.0}, {'x': 0.0}]
    assert bench_graph.ratio(ours, theirs, 'x') == 2.5
    assert np.isnan(bench_graph.ratio(ours[2:], theirs[2:], 'x'))


def test_report_has_all_sections(
    found: tuple[GraphPlan, list[str], dict[str, list[Figures]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    parts = [
        ([PageSection(name, (), [])], [Bar(name, 1.0, limit)])
        for name, limit in (('recorder', 0.0), ('memory', 2.0))
    ]
    monkeypatch.setattr(bench_graph, 'compare_pairs', lambda *_: found[2])
    monkeypatch.setattr(bench_graph, 'record', lambda *_: parts[0])
    monkeypatch.setattr(bench_graph, 'watch_memory', lambda *_: parts[1])
    sections, bars = bench_graph.compare(lambda _stage: None, 'quick')
    assert [section.title for section in sections[1:]] == ['recorder', 'memory']
    assert [bar.missed for bar in bars[-2:]] == [True, False]
