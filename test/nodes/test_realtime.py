# SPDX-License-Identifier: Apache-2.0
"""Real-time scheduling of node processes."""

from __future__ import annotations

from contextlib import suppress
import ctypes
import os
from pathlib import Path
import resource
import subprocess
import sys

from needle_insertion.graph.ros_graph import ACTIVATE, CONFIGURE, DEACTIVATE
import pytest
from support.ros_graph import RosGraph

_PR_CAPBSET_DROP, _CAP_SYS_NICE = 24, 23

_SET = 'from needle_ros.process import set_priority; set_priority(7)'


_PLAN = f"""{_SET}
import os
from needle_controller.steering.planning import ThreadJob
job = ThreadJob(lambda progress: os.sched_getscheduler(0))
while not job.done:
    pass
print(job.result(), os.sched_getscheduler(0))
"""


def _forbid() -> None:
    """Remove the right to use real-time scheduling, also from root."""
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    ctypes.CDLL(None).prctl(_PR_CAPBSET_DROP, _CAP_SYS_NICE)


def _is_permitted() -> bool:
    return subprocess.run([sys.executable, '-c', _SET], check=False).returncode == 0


def _policies(process: int) -> set[tuple[int, int]]:
    """Return policy and priority of all threads of a process."""
    threads = [int(one.name) for one in Path(f'/proc/{process}/task').iterdir()]
    found = set()
    for one in threads:
        # A thread may end after the listing.
        with suppress(ProcessLookupError):
            found.add((os.sched_getscheduler(one), os.sched_getparam(one).sched_priority))
    return found


@pytest.mark.skipif(not _is_permitted(), reason='no right to use real-time scheduling')
def test_active_node_has_its_realtime_priority(ros_graph: RosGraph) -> None:
    """All threads, only while the node is active."""
    user = ros_graph.node('user')
    started = ros_graph.start('plant', {'realtime_priority': 7, 'rate': 100.0, 'autostart': False})
    found = []
    for transition in (CONFIGURE, ACTIVATE, DEACTIVATE, ACTIVATE):
        ros_graph.change(user, 'plant', transition)
        found.append(_policies(started.process.pid))
    usual, realtime = {(os.SCHED_OTHER, 0)}, {(os.SCHED_FIFO, 7)}
    assert found == [usual, realtime, usual, realtime]


@pytest.mark.skipif(not _is_permitted(), reason='no right to use real-time scheduling')
def test_plan_is_computed_with_the_usual_priority() -> None:
    """Its thread leaves the real-time scheduling of the process, which continues."""
    done = subprocess.run(
        [sys.executable, '-c', _PLAN], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == [str(os.SCHED_OTHER), str(os.SCHED_FIFO)]


def test_missing_right_to_realtime_scheduling_is_reported() -> None:
    """One line names the setting; the scheduling is unchanged."""
    done = subprocess.run(
        [sys.executable, '-c', _SET],
        preexec_fn=_forbid,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert 'realtime_priority 7 is not permitted to this user: set the limit rtprio' in done.stderr
