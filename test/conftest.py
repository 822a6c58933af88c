# SPDX-License-Identifier: Apache-2.0
"""Common test configuration: settings, time limits, and test distribution (``pytest -n``)."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Generator
from datetime import datetime, timezone
import faulthandler
import os
import signal
import time
from typing import Any, Final

from hypothesis import settings
import psutil
import pytest
from tools.safety_file import RESULTS

# No deadline per example: tests run in parallel. The same examples in each run; others with
# ``--hypothesis-profile=random``.
settings.register_profile('tests', deadline=None, derandomize=True)
settings.register_profile('random', deadline=None, derandomize=False)
settings.load_profile('tests')

#: Files whose tests share expensive fixtures, or need most of a machine, and their groups: each
#: group runs in one process. The runs of the reproduction are computed once.
WHOLE: Final = {
    'test/bench/test_calibration.py': 'calibration',
    'test/bench/test_graph.py': 'graph',
    'test/composition/test_claims.py': 'reproduction',
    'test/composition/test_experiment.py': 'experiment',
    'test/composition/test_figures.py': 'reproduction',
    'test/composition/test_mismatch.py': 'reproduction',
    'test/composition/test_plan_page.py': 'plan_page',
    'test/composition/test_reproduce.py': 'reproduction',
    'test/nodes/test_package.py': 'package',
    'test/nodes/test_strangers.py': 'strangers',
    'test/test_layouts.py': 'layouts',
}


#: Multiple of the time limit after which the process of a hanging test is killed.
LAST: Final = 1.5

#: Time for a test process to end after its last test [s].
ENDING: Final = 120.0

#: Time for child processes to print their stacks [s].
PRINTING: Final = 5.0

#: Outcomes of the tests that name a requirement, and outcomes in the order of their severity.
OUTCOMES: dict[str, str] = {}
SEVERITIES: Final = '', 'passed', 'skipped', 'failed'

#: A copy of standard error outside the capture of pytest, and the time limit of a test [s].
STDERR, LIMIT = pytest.StashKey[int](), pytest.StashKey[float]()

# Python processes started by tests print the stacks of their threads on SIGABRT.
os.environ['PYTHONFAULTHANDLER'] = '1'
# The largest width of tables; a worker of pytest-xdist states 80 columns.
os.environ['COLUMNS'] = '100'

# Deprecated: rcl warns about it on standard error, and ignores other settings.
os.environ.pop('ROS_LOCALHOST_ONLY', None)


def pytest_configure(config: pytest.Config) -> None:
    config.stash[STDERR] = os.dup(2)
    # A shell starts background jobs with SIGINT ignored, and all child processes inherit that.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(wrapper=True)
def pytest_timeout_set_timer(item: pytest.Item, settings: Any) -> Generator[None, object, object]:
    """At the time limit print the stacks of all processes, and end the child processes."""
    done = yield
    fail: Any = signal.getsignal(signal.SIGALRM)

    def expired(number: int, frame: object) -> None:
        faulthandler.dump_traceback(file=2)
        abort_children()
        fail(number, frame)

    signal.signal(signal.SIGALRM, expired)
    item.stash[LIMIT] = settings.timeout
    end_later(item)
    return done


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    """Limit the time of the teardown: pytest-timeout stops its timer after a failed test."""
    end_later(item)


@pytest.hookimpl(wrapper=True)
def pytest_timeout_cancel_timer() -> Generator[None, object, object]:
    faulthandler.cancel_dump_traceback_later()
    return (yield)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Limit the shutdown time of this process."""
    faulthandler.dump_traceback_later(ENDING, exit=True, file=session.config.stash[STDERR])


def end_later(item: pytest.Item) -> None:
    """Kill this process some time after the limit, even if its threads are blocked."""
    if limit := item.stash.get(LIMIT, 0.0):
        stderr = item.config.stash[STDERR]
        faulthandler.dump_traceback_later(LAST * limit, exit=True, file=stderr)


def abort_children() -> None:
    """End all descendant processes, and make them print their stacks."""
    # The resource tracker of multiprocessing also serves the following tests.
    children = [
        one
        for one in psutil.Process().children(recursive=True)
        if 'resource_tracker' not in ' '.join(one.cmdline())
    ]
    for one in children:
        one.send_signal(signal.SIGABRT)
    limit = time.monotonic() + PRINTING
    while time.monotonic() < limit and any(map(runs, children)):
        time.sleep(0.01)


def runs(process: psutil.Process) -> bool:
    """Return whether a process is running; its parent reaps it."""
    return process.is_running() and process.status() != psutil.STATUS_ZOMBIE


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Collect the outcome of the tests that name a requirement, the worst of all parameters."""
    name = report.nodeid.partition('[')[0]
    if 'requirement' in report.keywords and (report.when == 'call' or not report.passed):
        worse = max(OUTCOMES.get(name, ''), report.outcome, key=SEVERITIES.index)
        OUTCOMES[name] = worse


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config: pytest.Config) -> None:
    """Keep the outcomes for the safety file, see tools/safety_file.py."""
    cache = getattr(config, 'cache', None)
    if OUTCOMES and cache is not None and not hasattr(config, 'workerinput'):
        today = f'{datetime.now(timezone.utc):%Y-%m-%d}'
        found = {name: {'outcome': one, 'date': today} for name, one in OUTCOMES.items()}
        cache.set(RESULTS, {**cache.get(RESULTS, {}), **found})


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Return the number of processes of ``-n auto``; node tests mostly wait."""
    return min(8, (os.cpu_count() or 1) + 1)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Assign whole files (`WHOLE`) or single tests to idle processes."""
    from xdist.scheduler.loadscope import LoadScopeScheduling

    class Scheduling(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return WHOLE.get(nodeid.partition('::')[0], nodeid)

        def schedule(self) -> None:
            """Assign two units to each process: a test starts only with the next one queued."""
            # LoadScopeScheduling assigns one unit to a replacement process, which would wait.
            super().schedule()
            for node in self.nodes:
                self._reschedule(node)

        def remove_node(self, node: Any) -> str | None:
            """Reassign the tests of a lost process, except the running test."""
            # LoadScopeScheduling repeats the running test, and hangs on complete units.
            units = self.assigned_work.pop(node).items()
            left = {
                scope: [test for test, done in unit.items() if not done] for scope, unit in units
            }
            running = next((tests.pop(0) for tests in left.values() if tests), None)
            for scope, tests in left.items():
                if tests:
                    self.workqueue[scope] = OrderedDict.fromkeys(tests, False)
            for other in self.assigned_work:
                self._reschedule(other)
            return running

    return Scheduling(config, log)
