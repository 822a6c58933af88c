# SPDX-License-Identifier: Apache-2.0
"""One session of `needle run` per domain, and the end of a session: the needle stops first."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
import os
from pathlib import Path
import re
import resource
import signal
import subprocess
import sys
from time import monotonic, time_ns
from typing import Any, NamedTuple

from needle_identification.bags.bag import read_topic
from needle_ros.base_node import SENSOR
from needle_ros.contract import INSERTION
from needle_ros.errors import JobError
from needle_ros.network import claim, is_claimed
from needle_ros.run_node import END_WITH_PARENT
import pytest
from sensor_msgs.msg import JointState
from support.ros_graph import RosGraph

#: Timeout of a start or a motion on a busy machine [s].
LONGEST = 120.0

#: Default velocity of the reference [m/s], and braking distance from it (docs/safety.md) [m].
SPEED, BRAKING = 0.01, 1e-3

#: Time from the cause to the stop [s]: a check of the session (0.05 s), a service call, the
#: timeout of the plant for a controller that is killed (0.1 s); 0.2 s on a machine without load.
REACTION = 0.2

#: Velocity at rest [m/s].
REST = 1e-4

#: Below the default rate, because tests run in parallel.
RATE = 200.0


class Sample(NamedTuple):
    """A measurement of the needle: stamp [ns], depth [m], velocity [m/s]."""

    stamp: int
    depth: float
    velocity: float


def read(message: JointState) -> Sample:
    at = message.name.index(INSERTION)
    stamp = message.header.stamp
    return Sample(stamp.sec * 10**9 + stamp.nanosec, message.position[at], message.velocity[at])


class Watcher:
    """Subscriber of the needle position that outlives all sessions of a domain."""

    def __init__(self, graph: RosGraph) -> None:
        self.graph = graph
        self.samples: list[Sample] = []
        graph.node('watcher').create_subscription(
            JointState, 'joint_states', lambda message: self.samples.append(read(message)), SENSOR
        )

    def until(self, condition: Callable[[], Any], what: str) -> None:
        self.graph.spin_until(condition, what, LONGEST, period=0.02)

    def until_it_moves(self) -> None:
        """Wait for the full velocity of the reference."""
        self.until(lambda: self.samples and self.samples[-1].velocity > 0.98 * SPEED, 'motion')

    def watch(self, duration: float) -> None:
        """Receive samples for a time [s]."""
        end = monotonic() + duration
        self.until(lambda: monotonic() > end, 'the end of a wait')


def motion(samples: list[Sample], cause: int) -> float:
    """Return the motion into the tissue [m] after a time [ns]; it fails for no sample before."""
    before = [one.depth for one in samples if one.stamp <= cause][-1]
    return max([0.0, *(one.depth - before for one in samples if one.stamp > cause)])


def assert_needle_brakes(watcher: Watcher, cause: int) -> None:
    """Check that the needle rests, after the braking distance and the reaction time."""
    samples = watcher.samples
    moved = motion(samples, cause)
    # A process gets a part of a processor if more processes than processors are ready.
    share = min(max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1)), 4.0)
    allowed = BRAKING + SPEED * REACTION * share
    sys.stdout.write(f'{1e3 * moved:.2f} mm after the cause, allowed {1e3 * allowed:.2f} mm\n')
    assert moved < allowed
    assert samples[-1].velocity == pytest.approx(0.0, abs=REST)


@dataclass
class Session:
    """A running `needle run`, its folder and its output."""

    process: subprocess.Popen[str]
    folder: Path
    output: Path

    @property
    def said(self) -> str:
        return self.output.read_text()

    @property
    def last_line(self) -> str:
        return self.said.splitlines()[-1]

    def say(self, *lines: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.writelines(f'{line}\n' for line in lines)
        self.process.stdin.flush()

    @property
    def nodes(self) -> dict[str, int]:
        """Process IDs of the nodes by name."""
        pid = self.process.pid
        found = {}
        for child in Path(f'/proc/{pid}/task/{pid}/children').read_text().split():
            words = Path(f'/proc/{child}/cmdline').read_text()
            if name := re.search(r'\.(\w+)_node', words):
                found[name[1]] = int(child)
        return found

    def log(self, node: str) -> str:
        return (self.folder / 'logs' / f'{node}.log').read_text()

    @property
    def positions(self) -> list[Sample]:
        """Recorded positions of the needle."""
        bag = self.folder / 'bag'
        return [read(message) for _, message in read_topic(bag, '/joint_states')]


@contextmanager
def session(
    graph: RosGraph, folder: Path, *words: str, mode: str = '--realtime'
) -> Iterator[Session]:
    """Start a session whose commands come from a pipe."""
    line = [sys.executable, '-m', 'needle_insertion.cli', 'run', '-o', str(folder), *words]
    # A loaded machine is late.
    line += ['-p', 'controller.measurement_timeout=5']
    nodes = ['controller'] if mode == '--hardware' else ['controller', 'plant']
    line += [word for node in nodes for word in ('-p', f'{node}.rate={RATE}')]
    line.append(mode)
    output = folder.with_suffix('.txt')
    with output.open('w') as out:
        process = subprocess.Popen(
            line,
            env=graph.environment,
            stdin=subprocess.PIPE,
            stdout=out,
            stderr=subprocess.STDOUT,
            text=True,
        )
    try:
        yield Session(process, folder, output)
    finally:
        process.kill()
        process.wait()
        assert process.stdin is not None
        process.stdin.close()
        # pytest shows it if the test fails.
        sys.stdout.write(output.read_text())


def insert(watcher: Watcher, running: Session, *target: str) -> None:
    """Begin an insertion, and wait for its full velocity."""
    running.say(f'target {" ".join(target or ["150mm"])}')
    watcher.until(
        lambda: 'on its way' in running.said or running.process.poll() is not None, 'the target'
    )
    assert running.process.poll() is None, running.said
    watcher.until_it_moves()


def ends(watcher: Watcher, running: Session) -> int:
    """Wait for the end of a session; return its status."""
    watcher.until(lambda: running.process.poll() is not None, f'the end: {running.said}')
    watcher.watch(0.5)
    return running.process.returncode


# One session per domain.


@pytest.mark.requirement('S-194')
def test_second_session_does_not_disturb_the_first(ros_graph: RosGraph, tmp_path: Path) -> None:
    """It ends before it starts a node, with a line; the insertion of the first continues."""
    watcher = Watcher(ros_graph)
    with session(ros_graph, tmp_path / 'first') as first:
        insert(watcher, first, '60mm')
        nodes = first.nodes
        with session(ros_graph, tmp_path / 'second') as second:
            assert ends(watcher, second) == 1
            assert second.last_line == (
                f'error: another session is running on domain {ros_graph.domain}: end it, or '
                'choose another ROS_DOMAIN_ID'
            )
        assert not (tmp_path / 'second').exists()
        assert first.nodes == nodes
        first.say('wait 60', 'quit')
        assert ends(watcher, first) == 0, first.said
        assert 'ERROR' not in first.said
        for name in nodes:
            assert 'is not valid in state' not in first.log(name)
        assert first.positions[-1].depth == pytest.approx(0.06, abs=3e-4)


@pytest.mark.requirement('S-196')
def test_session_rejects_nodes_that_it_has_not_started(
    ros_graph: RosGraph, tmp_path: Path
) -> None:
    """Nodes of a launch file or of another machine, which have no claim, are not disturbed."""
    watcher = Watcher(ros_graph)
    for name in ('plant', 'controller'):
        ros_graph.start(name, {'rate': RATE})
    watcher.until(lambda: watcher.samples, 'the plant')
    with session(ros_graph, tmp_path / 'run') as second:
        assert ends(watcher, second) == 1
        assert re.fullmatch(
            r'error: another (plant|controller) is running on domain \d+: end it, or choose '
            r'another ROS_DOMAIN_ID',
            second.last_line,
        )
        assert not (tmp_path / 'run').exists()
    count = len(watcher.samples)
    watcher.until(lambda: len(watcher.samples) > count, 'further samples')
    for name in ('plant', 'controller'):
        assert 'nodes publish' not in (tmp_path / 'logs' / f'{name}.log').read_text()


#: Claims a domain, reports the result, and starts a process that holds the claim, too.
CLAIMS = """
import subprocess, sys
from needle_ros.errors import JobError
from needle_ros.network import claim
input()
try:
    held = claim(int(sys.argv[1]))
except JobError:
    print('refused', flush=True)
else:
    quiet = subprocess.DEVNULL
    child = subprocess.Popen(['/bin/sleep', '60'], pass_fds=[held.fileno()], stdout=quiet)
    print(child.pid, flush=True)
input()
"""


@pytest.mark.requirement('S-192', 'S-193')
def test_claim_is_atomic_and_ends_with_the_last_process(ros_graph: RosGraph) -> None:
    """Of processes that claim a domain at the same time one has it, until its nodes end."""
    domain = ros_graph.domain
    claimants = [
        subprocess.Popen(
            [sys.executable, '-c', CLAIMS, str(domain)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(4)
    ]
    node = 0
    try:
        for one in claimants:
            assert one.stdin is not None
            one.stdin.write('\n')
            one.stdin.flush()
        answers = [one.stdout.readline().strip() for one in claimants if one.stdout is not None]
        assert sorted(answers)[1:] == 3 * ['refused'], answers
        node = int(next(one for one in answers if one != 'refused'))
        for one in claimants:
            one.kill()
            one.communicate()
        assert is_claimed(domain)
        with pytest.raises(JobError, match=f'another session is running on domain {domain}:'):
            claim(domain)
    finally:
        for one in claimants:
            one.kill()
            one.communicate()
        if node:
            os.kill(node, signal.SIGKILL)
    # It is a child of no process of the test.
    ros_graph.spin_until(lambda: not is_claimed(domain), 'the release')
    claim(domain).close()


@pytest.mark.requirement('S-195')
def test_private_graph_avoids_the_domain_of_a_session(tmp_path: Path) -> None:
    """A demo or a test during a session is on another domain."""
    with RosGraph(tmp_path / 'first') as graph:
        domain = graph.domain
    with claim(domain), RosGraph(tmp_path / 'second') as graph:
        assert graph.domain != domain


# The end of a session.


def kill(node: str, number: int = signal.SIGKILL) -> Callable[[Session], None]:
    return lambda running: os.kill(running.nodes[node], number)


def send(number: int) -> Callable[[Session], None]:
    return lambda running: running.process.send_signal(number)


def suspend_and_quit(running: Session) -> None:
    running.process.send_signal(signal.SIGTSTP)
    running.say('quit')


def fill_disk(running: Session) -> None:
    """Let no file of the recorder grow."""
    resource.prlimit(running.nodes['recorder'], resource.RLIMIT_FSIZE, (1000, 1000))


#: Cause of the end of a session, exit status, and last line.
CAUSES: Mapping[str, tuple[Callable[[Session], object], int, str]] = {
    'SIGINT': (send(signal.SIGINT), 130, 'interrupted'),
    'SIGTERM': (send(signal.SIGTERM), 143, 'interrupted'),
    'SIGHUP': (send(signal.SIGHUP), 129, 'interrupted'),
    'error in the script': (
        lambda running: running.say('wait now'),
        2,
        r"error: line 2: 'now' is not a time, such as 20 or 20s",
    ),
    'quit': (lambda running: running.say('quit'), 0, r'recorded to .*'),
    'quit after Ctrl-Z': (suspend_and_quit, 0, r'recorded to .*'),
    'killed controller': (
        kill('controller'),
        1,
        r'error: controller ended early with status -9.*',
    ),
    'ended controller': (
        kill('controller', signal.SIGTERM),
        1,
        r'error: controller ended early with status 0.*',
    ),
    'killed plant': (kill('plant'), 1, r'error: plant ended early with status -9.*'),
    'killed recorder': (kill('recorder'), 1, r'error: recorder ended early with status -9.*'),
    'full disk': (fill_disk, 1, r'error: recorder: recording to .* stopped: File too large'),
}


@pytest.mark.requirement('S-197', 'S-198', 'S-199', 'S-200', 'S-201', 'S-206', 'S-207')
@pytest.mark.parametrize('cause', CAUSES)
def test_needle_stops_before_the_nodes_end(
    ros_graph: RosGraph, tmp_path: Path, cause: str
) -> None:
    """It moves by at most its braking distance, and rests while the nodes still run."""
    act, status, line = CAUSES[cause]
    watcher = Watcher(ros_graph)
    with session(ros_graph, tmp_path / 'run') as running:
        insert(watcher, running)
        begin = time_ns()
        act(running)
        assert ends(watcher, running) == status, running.said
        assert re.fullmatch(line, running.last_line), running.said
        if cause == 'full disk':
            # The recorder detects it at its next write.
            begin = stopped(running)
        if cause == 'killed plant':
            # The simulated needle ends with it.
            return
        assert_needle_brakes(watcher, begin)
        if 'recorder' not in cause and cause != 'full disk':
            # The recording is complete and ends after the motion.
            assert (running.folder / 'bag' / 'metadata.yaml').is_file()
            assert running.positions[-1].velocity == pytest.approx(0.0, abs=REST)


def stopped(running: Session) -> int:
    """Return the time of the log line of the recorder about its failure [ns]."""
    found = re.search(r'\[ERROR\] \[(\d+)\.(\d+)\] \[recorder\]', running.log('recorder'))
    assert found, running.log('recorder')
    return int(found[1] + found[2])


@pytest.mark.requirement('S-202', 'S-203')
def test_killed_session_stops_a_robot_that_continues(ros_graph: RosGraph, tmp_path: Path) -> None:
    """Its nodes end with it; the domain is free for the next session, which is not disturbed."""
    watcher = Watcher(ros_graph)
    ros_graph.start('plant', {'rate': RATE, 'depth': 0.02})
    with session(ros_graph, tmp_path / 'first', mode='--hardware') as first:
        insert(watcher, first)
        nodes = first.nodes
        assert nodes.keys() == {'controller', 'recorder'}
        begin = time_ns()
        first.process.kill()
        watcher.until(lambda: abs(watcher.samples[-1].velocity) < REST, 'rest')
        watcher.watch(1.0)
        assert_needle_brakes(watcher, begin)
        watcher.until(lambda: not any(map(alive, nodes.values())), 'the end of the nodes')
        assert (first.folder / 'bag' / 'metadata.yaml').is_file()
    with session(ros_graph, tmp_path / 'next', mode='--hardware') as second:
        watcher.samples.clear()
        insert(watcher, second)
        begin = time_ns()
        kill('controller')(second)
        assert ends(watcher, second) == 1
        assert_needle_brakes(watcher, begin)


def alive(pid: int) -> bool:
    """Return whether a process runs; a zombie does not."""
    try:
        return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] != 'Z'
    except FileNotFoundError:
        return False


@pytest.mark.requirement('S-205')
def test_killed_steering_stops_the_needle_within_its_step(
    ros_graph: RosGraph, tmp_path: Path
) -> None:
    """The other nodes stop the needle; a step would end up to 30 mm later."""
    watcher = Watcher(ros_graph)
    options = [
        'steering.step_length=0.03',
        'steering.speed=0.01',
        'steering.measurement_timeout=30',
    ]
    words = [word for one in options for word in ('-p', one)]
    with session(ros_graph, tmp_path / 'run', '--needle', 'bending_35mm', *words) as running:
        insert(watcher, running, '0', '70mm', '0')
        begin = time_ns()
        kill('steering')(running)
        assert ends(watcher, running) == 1
        assert 'error: steering ended early with status -9' in running.said
        assert_needle_brakes(watcher, begin)


@pytest.mark.requirement('S-204')
def test_node_ends_if_its_parent_ended_before(ros_graph: RosGraph) -> None:
    """Also if the session is killed before the node requests a signal at its end."""
    line = [sys.executable, '-m', 'needle_dynamics.plant_node']
    # The process ID of a parent that has ended.
    ended = subprocess.Popen(['/bin/true'])
    ended.wait()
    environment = {**ros_graph.environment, END_WITH_PARENT: str(ended.pid)}
    done = subprocess.run(line, env=environment, capture_output=True, timeout=LONGEST, check=False)
    assert (done.returncode, done.stderr) == (0, b'')
