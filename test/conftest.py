"""What all tests share: settings, time limits, and their distribution (``pytest -n``)."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Generator
import faulthandler
import os
import signal
import time
from typing import Any, Final

from hypothesis import settings
import psutil
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


#: A test that has not ended by itself at this multiple of its time limit ends with its process.
LAST: Final = 1.5

#: Time for a process of tests to end after its last test [s].
ENDING: Final = 120.0

#: Time for child processes to print their stacks [s].
PRINTING: Final = 5.0

#: A copy of standard error that pytest does not capture, and the time limit of a test [s].
STDERR, LIMIT = pytest.StashKey[int](), pytest.StashKey[float]()

# Each Python process that a test starts prints the stacks of its threads on SIGABRT.
os.environ['PYTHONFAULTHANDLER'] = '1'


def pytest_configure(config: pytest.Config) -> None:
    config.stash[STDERR] = os.dup(2)
    # A shell starts background jobs with SIGINT ignored, and all child processes inherit that.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(wrapper=True)
def pytest_timeout_set_timer(item: pytest.Item, settings: Any) -> Generator[None, object, object]:
    """At the time limit print the stacks of all processes, and end the children of this one."""
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
    """Limit the time of the teardown: a failed test has no timer any more."""
    end_later(item)


@pytest.hookimpl(wrapper=True)
def pytest_timeout_cancel_timer() -> Generator[None, object, object]:
    faulthandler.cancel_dump_traceback_later()
    return (yield)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Limit the time in which this process ends."""
    faulthandler.dump_traceback_later(ENDING, exit=True, file=session.config.stash[STDERR])


def end_later(item: pytest.Item) -> None:
    """End this process some time after the limit, also where its threads cannot run."""
    if limit := item.stash.get(LIMIT, 0.0):
        stderr = item.config.stash[STDERR]
        faulthandler.dump_traceback_later(LAST * limit, exit=True, file=stderr)


def abort_children() -> None:
    """End all processes that descend from this one, each with its stacks."""
    # The process of multiprocessing that cleans up serves the tests that follow, too.
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
    """Whether a process has not ended. It is not waited for: its parent does that."""
    return process.is_running() and process.status() != psutil.STATUS_ZOMBIE


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

        def schedule(self) -> None:
            """Give each process two units: it begins a test when it has the next one."""
            # LoadScopeScheduling gives one to a process that replaces a lost one: it would wait.
            super().schedule()
            for node in self.nodes:
                self._reschedule(node)

        def remove_node(self, node: Any) -> str | None:
            """Give the tests of a lost process to others, but not the one that was running."""
            # LoadScopeScheduling repeats that one, and hangs on units that are complete.
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
