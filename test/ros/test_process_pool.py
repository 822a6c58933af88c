# SPDX-License-Identifier: Apache-2.0
"""Process pool: results, errors, and killed workers."""

from __future__ import annotations

from concurrent.futures import FIRST_COMPLETED, wait
import os
from pathlib import Path
import signal
import subprocess
import sys
from threading import Event, Thread
import time
from typing import Any

from benchmarks.kills import kill_worker, workers
from needle_ros.errors import JobError, ParameterError
from needle_ros.process_pool import processes
import numpy as np
import psutil
import pytest
from support.jobs import die, divide, kill_once, LARGE, refuse, wait_for_ever

#: Size of a result larger than a pipe buffer [bytes].
SIZE = 4_000_000


def test_results_are_ordered_and_errors_keep_type_and_traceback() -> None:
    before = len(workers(os.getpid()))
    with processes(2) as pool:
        assert list(pool.map(divide, range(6), [2.0] * 6)) == [0.0, 0.5, 1.0, 1.5, 2.0, 2.5]
        with pytest.raises(ZeroDivisionError) as raised:
            pool.submit(divide, 1.0, 0.0).result()
        assert 'return a / b' in str(raised.value.__cause__)
        with pytest.raises(ParameterError, match=r'^value must be > 0, got -1$'):
            pool.submit(refuse, -1.0).result()
        # Neither object can be pickled; the worker continues.
        with pytest.raises((AttributeError, TypeError), match='pickle'):
            pool.submit(lambda: 0).result()
        with pytest.raises((AttributeError, TypeError), match='pickle'):
            pool.submit(Event).result()
        assert pool.submit(abs, -3).result() == 3
        assert len(workers(os.getpid())) - before <= 2
    assert len(workers(os.getpid())) == before


@pytest.mark.parametrize('delay', [0.0, 0.02, 0.04, 0.08])
def test_job_of_a_killed_worker_is_repeated(tmp_path: Path, delay: float) -> None:
    """Also after a partly sent result."""
    with processes(2) as pool:
        others = pool.map(abs, range(20))
        assert pool.submit(kill_once, str(tmp_path / 'once'), delay).result() == bytes(LARGE)
        assert list(others) == list(range(20))


def test_job_that_always_kills_its_worker_fails() -> None:
    """The job fails with a one-line error; other jobs are not affected."""
    with processes(2) as pool:
        lost, other = pool.submit(die), pool.submit(abs, -3)
        with pytest.raises(
            JobError, match=r'^10 worker processes ended in a row without a result'
        ):
            lost.result()
        assert other.result() == 3


def test_results_are_complete_despite_random_kills() -> None:
    """A third of the kills hits a starting worker; no job can lose ten workers."""
    rng, ended, ages = np.random.default_rng(1), Event(), list[float]()

    def kill() -> None:
        # Random times: there is no condition to wait for.
        while len(ages) < 9 and not ended.wait(rng.uniform(0.0, rng.choice([0.05, 1.0, 1.0]))):
            age = kill_worker(os.getpid(), rng, youngest=True)
            if age is not None:
                ages.append(age)

    killer = Thread(target=kill)
    with processes(2) as pool:
        killer.start()
        try:
            for _ in range(1000):
                jobs = [pool.submit(bytes, SIZE) for _ in range(4)]
                for done in wait(jobs).done:
                    assert done.result() == bytes(SIZE)
                if not killer.is_alive():
                    break
        finally:
            ended.set()
            killer.join()
    assert len(ages) == 9


def test_leaving_the_context_ends_running_jobs(tmp_path: Path) -> None:
    marker = tmp_path / 'runs'
    with processes(1) as pool:
        running, waiting = pool.submit(wait_for_ever, str(marker)), pool.submit(abs, -3)
        limit = time.monotonic() + 60.0
        while not (marker.exists() and marker.read_text()) and time.monotonic() < limit:
            wait([running], timeout=0.02, return_when=FIRST_COMPLETED)
    assert not psutil.pid_exists(int(marker.read_text()))
    assert waiting.cancelled()
    with pytest.raises(JobError, match='the pool of worker processes has ended'):
        running.result(timeout=0.0)


@pytest.mark.parametrize('number', [signal.SIGKILL, signal.SIGINT])
def test_workers_end_with_a_killed_parent(tmp_path: Path, number: int) -> None:
    """SIGINT to the process group ends the parent, and the parent its workers, without output."""
    marker = tmp_path / 'runs'
    script = (
        'from needle_ros.process_pool import processes\n'
        'from support.jobs import wait_for_ever\n'
        'if __name__ == "__main__":\n'
        '    with processes(2) as pool:\n'
        '        pool.submit(abs, -1).result()\n'
        f'        pool.submit(wait_for_ever, {str(marker)!r}).result()\n'
    )
    (tmp_path / 'script.py').write_text(script)
    parent = subprocess.Popen(
        [sys.executable, tmp_path / 'script.py'],
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    with parent:
        limit = time.monotonic() + 60.0
        while not (marker.exists() and marker.read_text()) and time.monotonic() < limit:
            time.sleep(0.02)
        children: list[Any] = psutil.Process(parent.pid).children(recursive=True)
        if number == signal.SIGINT:
            os.killpg(parent.pid, number)
        else:
            parent.kill()
        _, alive = psutil.wait_procs(children, timeout=30.0)
        assert [one for one in alive if one.status() != psutil.STATUS_ZOMBIE] == []
        _, said = parent.communicate(timeout=30.0)
    assert said.count('Traceback') == (number == signal.SIGINT)
