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


@pytest.fixture(autouse=True)
def no_shared_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """
    Let messages go over UDP: here processes are killed.

    Where one that shared memory was killed, Fast DDS 2.14 may crash in others when they end, and
    the ports it leaves behind may keep later ones of the same domain from finding each other.
    """
    monkeypatch.setenv('FASTDDS_BUILTIN_TRANSPORTS', 'UDPv4')


@pytest.fixture
def ros_graph(tmp_path: Path) -> Iterator[RosGraph]:
    """Return a graph for one test."""
    with RosGraph(tmp_path / 'logs') as graph:
        yield graph
