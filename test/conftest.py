"""What all tests share: settings, and how they are spread over processes (``pytest -n``)."""

from __future__ import annotations

import os
from typing import Any

from hypothesis import settings
import pytest

# An example may take long where other tests run beside it.
settings.register_profile('tests', deadline=None)
settings.load_profile('tests')

#: Files whose tests share what takes long to make: each file runs in one process.
WHOLE = {
    'test/bench/test_graph.py',
    'test/bench/test_calibration.py',
    'test/composition/test_claims.py',
    'test/composition/test_experiment.py',
    'test/composition/test_reproduce.py',
    'test/nodes/test_package.py',
    'test/test_layouts.py',
}


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Return how many processes ``-n auto`` means: tests of nodes wait more than they compute."""
    return min(8, (os.cpu_count() or 1) + 1)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give each process whole files, those named above, or single tests, as it gets free."""
    from xdist.scheduler.loadscope import LoadScopeScheduling

    class Scheduling(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.partition('::')[0]
            return file if file in WHOLE else nodeid

    return Scheduling(config, log)
