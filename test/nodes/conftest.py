"""Real nodes over real DDS inside a test: own context, own domain, errors fail the test."""

from __future__ import annotations

from collections.abc import Iterator
import gc
from pathlib import Path

import pytest
from support.ros_graph import RosGraph


@pytest.fixture(scope='session', autouse=True)
def quick_collection() -> None:
    """Keep what was imported out of the collections at the end of each graph."""
    gc.freeze()


@pytest.fixture
def ros_graph(tmp_path: Path) -> Iterator[RosGraph]:
    """Return a graph for one test."""
    with RosGraph(tmp_path / 'logs') as graph:
        yield graph
