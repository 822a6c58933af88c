# SPDX-License-Identifier: Apache-2.0
"""Graph of real nodes over DDS for each test: own context and domain, node errors fail it."""

from __future__ import annotations

from collections.abc import Iterator
import gc
from pathlib import Path

import pytest
from support.ros_graph import RosGraph


@pytest.fixture(scope='session', autouse=True)
def quick_collection() -> None:
    """Exclude imported objects from the garbage collection at the end of each graph."""
    gc.freeze()


@pytest.fixture
def ros_graph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RosGraph]:
    # Files of the nodes, such as the record of an insertion.
    monkeypatch.setenv('ROS_HOME', str(tmp_path / 'ros'))
    with RosGraph(tmp_path / 'logs') as graph:
        yield graph
