# SPDX-License-Identifier: Apache-2.0
"""`needle run` with typed commands and with scripts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
import os
from pathlib import Path
import pty
import re
import runpy
import select
import signal
import subprocess
import sys
import time

from needle_controller.steering.insertion_plan import write_plan
from needle_dynamics.plant_node import PlantNode
from needle_identification.bags.bag import read_topic
from needle_insertion.graph.messages import State
from needle_insertion.graph.ros_graph import Graph
from needle_insertion.live.operator import Operator
from needle_insertion.live.readings import Readings
from needle_insertion.live.screen import Screen
from needle_insertion.live.terminal import Terminal, Warnings
from needle_insertion.replay.rerun import verify
from needle_ros.base_node import SENSOR
from needle_ros.status import LEVELS, NodeReport
import pytest
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from support.installed import ROOT
from support.plans import bowed_plan
from support.ros_graph import RosGraph

#: Timeout of a start or a motion on a busy machine [s].
_LONGEST = 300.0


#: Invalid or rejected lines, and the expected messages.
MISTAKES = [
    ('targte 0.05', "unknown word 'targte'; did you mean target? Valid are target, wait"),
    ('target', 'target takes DEPTH | X,Y,Z, got nothing'),
    ('target deep', "'deep' is not a length, such as 0.05 or 50mm"),
    ('target 1e400', "'1e400' is not a target: x,y,z"),
    ('target 0.001 0.05 0', 'a target off the axis needs a needle that bends: --needle bending_'),
    ('wait soon', "'soon' is not a time, such as 20 or 20s"),
    ('wait 1', 'there is no target to wait for'),
    ('law bang', "law takes one of adaptive, inverse_dynamics, pid, got 'bang'"),
    ('pause now', 'pause takes nothing, got now'),
    ('set controller force_limit', 'set takes NODE NAME VALUE, got controller force_limit'),
    ('set nobody x 1', 'nobody x = 1: no node nobody'),
    ('set controller force_limt 3', "unknown parameter 'force_limt'; did you mean 'force_limit'?"),
    ('set controller force_limit 3', 'force_limit: cannot change while configured'),
    ("target '0.05", 'no closing quotation'),
    ('set plant fault.kind "[1, {"', 'is not a value in YAML'),
]


def command(
    ros_graph: RosGraph, folder: Path, *words: str, rate: float | None = 200.0
) -> tuple[list[str], dict[str, str]]:
    """Return the command line, and the environment with the domain of the test."""
    line = [sys.executable, '-m', 'needle_insertion.cli', 'run', '-o', str(folder), *words]
    # Below the default rate, because tests run in parallel.
    nodes = ('controller',) if '--hardware' in words else ('plant', 'controller')
    for node in nodes if rate else ():
        line += ['-p', f'{node}.rate={rate}']
    return line, {**ros_graph.environment}


def told(
    ros_graph: RosGraph,
    folder: Path,
    script: Sequence[str],
    *words: str,
    rate: float | None = 200.0,
    longest: float = _LONGEST,
    home: Path | None = None,
) -> tuple[int, str, str]:
    """Run a script; return status, output and errors."""
    line, environment = command(ros_graph, folder, *words, rate=rate)
    if home is not None:
        for name in ('ROS_LOG_DIR', 'ROS_HOME'):
            environment.pop(name, None)
        environment['HOME'] = str(home)
    process = subprocess.Popen(
        line,
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdin is not None
    process.stdin.write('\n'.join(script))
    process.stdin.close()
    process.stdin = None
    begin = time.monotonic()
    # Nodes of this process continue meanwhile.
    while process.poll() is None and time.monotonic() - begin < longest:
        ros_graph.executor.spin_once(timeout_sec=0.05)
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
    said, complained = process.communicate(timeout=60.0)
    return process.returncode, said, complained


def test_script_inserts_changes_the_law_and_retracts(ros_graph: RosGraph, tmp_path: Path) -> None:
    """The recording has every sample, and can be replayed."""
    status, said, complained = told(
        ros_graph,
        tmp_path / 'run',
        [
            '# a comment',
            'set controller retract_depth 20mm',
            'target 23mm',
            'wait 60',
            'pause',
            'resume',
            'law pid',
            'target 0.025',
            'wait 60',
            'status',
            'retract',
            'wait 60',
            'stop',
            'clear',
            'help',
            'quit',
            'target 0.1',
        ],
        '-p',
        'controller.reference.speed=0.02',
    )
    assert (status, complained) == (0, ''), said
    at = [float(found) for found in re.findall(r'^depth (\S+) mm', said, re.MULTILINE)]
    # It settles within 1 s to about 0.1 mm under both laws.
    assert at == pytest.approx([23.0, 25.0, 25.0, 20.0], abs=0.3), said
    assert re.search(r'^controller +(OK|WARN) ', said, re.MULTILINE)
    assert 'needle> quit\nrecorded to' in said
    bag = tmp_path / 'run' / 'bag'
    assert [message.point.y for _, message in read_topic(bag, '/target')] == [0.023, 0.025]
    (run,) = verify(bag)
    assert run.verdict == 'identical'
    assert (tmp_path / 'run' / 'logs' / 'plant.log').is_file()


def test_session_of_the_readme_is_reproduced(ros_graph: RosGraph, tmp_path: Path) -> None:
    """
    In simulated time, at the default rate.

    The time of the target depends on the machine, and with it the noise of the measurements.
    """
    page = (ROOT / 'README.md').read_text(encoding='utf-8')
    (line,) = re.findall(r'^needle run(.*)$', page, re.MULTILINE)
    (session,) = re.findall(r'^```console\n(needle> .*?)```', page, re.MULTILINE | re.DOTALL)
    script = re.findall(r'^needle> (.*)$', session, re.MULTILINE)
    status, said, complained = told(
        ros_graph, tmp_path / 'run', script, *line.split(), rate=None, longest=800.0
    )
    assert (status, complained) == (0, ''), said

    number = r'[-+]?\d+\.\d+'

    def fixed(line: str) -> str:
        return re.sub(number, '#', line)

    # Lines of the page are wrapped with an indentation.
    shown = re.sub(r'\n +', ' ', session).splitlines()
    printed = said.splitlines()[-len(shown) - 1 : -1]
    assert [*map(fixed, printed)] == [*map(fixed, shown)]
    # Two runs differ by the stated uncertainty of both, 0.09 mm; the last depth is of one sample.
    (there,), (here,) = (
        [[float(found) for found in re.findall(number, line)] for line in lines if 'done' in line]
        for lines in (shown, printed)
    )
    assert here == pytest.approx(there, abs=2**0.5 * 0.09)


def test_first_status_is_of_active_nodes(ros_graph: RosGraph, tmp_path: Path) -> None:
    """Without warnings of nodes that wait for each other at the start."""
    status, said, complained = told(ros_graph, tmp_path / 'run', ['status'])
    assert (status, complained) == (0, '')
    assert re.search(r'^plant +OK +active$', said, re.MULTILINE), said
    assert 'not active' not in said
    assert 'no joint_states yet' not in said


def test_run_needs_no_home_folder(ros_graph: RosGraph, tmp_path: Path) -> None:
    """As for the user of a service: the logs of ROS are in the folder of the run."""
    (tmp_path / 'file').touch()
    status, said, complained = told(
        ros_graph, tmp_path / 'run', ['status'], home=tmp_path / 'file' / 'home'
    )
    assert (status, complained) == (0, '')
    assert re.search(r'^controller +OK ', said, re.MULTILINE), said
    assert [*(tmp_path / 'run' / 'logs' / 'ros').glob('*.log')]


def test_warnings_of_nodes_that_wait_are_kept_for_the_session() -> None:
    """With a plant, which starts last, they are printed once if they last beyond the start."""
    lines = list[str]()
    report = NodeReport('/controller', LEVELS.index('WARN'), 'no joint_states yet', {})
    states = {'controller': State(report, time.monotonic())}
    warnings = Warnings(lines.append, robot=False)
    warnings.show(states)
    assert lines == []
    warnings.quiet = 0.0
    for _ in range(2):
        warnings.show(states)
    assert lines == ['controller: WARN no joint_states yet']


def test_script_ends_at_a_rejected_target(ros_graph: RosGraph, tmp_path: Path) -> None:
    """No further command is executed."""
    script = ['target 5', 'target 0.03', 'wait']
    status, said, complained = told(ros_graph, tmp_path / 'run', script, '--no-recording')
    assert status == 1
    assert re.fullmatch(
        r'error: line 1: controller: target rejected: target depth must be in .*, got 5.0\n',
        complained,
    )
    assert 'needle> target 0.03' not in said
    assert not (tmp_path / 'run' / 'bag').exists()


def test_node_that_cannot_start_is_a_line(ros_graph: RosGraph, tmp_path: Path) -> None:
    """Without time and severity of its log."""
    status, _, complained = told(ros_graph, tmp_path / 'run', ['status'], '-p', 'plant.depth=5')
    assert status == 1
    assert re.fullmatch(
        'error: plant failed to start: insertion depth 5 m is outside .*\n', complained
    )


def test_robot_replaces_the_plant(ros_graph: RosGraph, tmp_path: Path) -> None:
    ros_graph.add(PlantNode, parameters={'rate': 200.0, 'depth': 0.02})
    status, said, complained = told(
        ros_graph, tmp_path / 'run', ['target 22mm', 'wait 100'], '--hardware'
    )
    assert (status, complained) == (0, ''), said
    assert 'starting recorder, controller\n' in said
    assert 'depth 22.' in said or 'depth 21.9' in said


def test_first_motion_of_a_robot_is_reported(ros_graph: RosGraph, tmp_path: Path) -> None:
    """With the file of the page its result is printed, and a refusal ends a script."""
    drivers = runpy.run_path(str(ROOT / 'examples/robot_driver.py'), run_name='drivers')
    ros_graph.add(drivers['PositionRobot'])
    page = (ROOT / 'docs/howto/own-robot.md').read_text(encoding='utf-8')
    file = tmp_path / 'robot.yaml'
    file.write_text(page.split('```yaml\n')[1].split('```')[0], encoding='utf-8')
    words = ['--params-file', str(file), '--hardware', '--no-recording']

    def answered(folder: Path) -> tuple[int, str, str]:
        """Repeat a session in which a busy machine has delayed the measurements."""
        for _ in range(5):
            ended = told(ros_graph, folder, ['target 22mm', 'wait 100'], *words)
            if 'target rejected: joint_states is stale' not in ended[2]:
                break
        return ended

    status, said, complained = answered(tmp_path / 'run')
    assert (status, complained) == (0, ''), said
    assert re.search(
        r'^controller: first motion passed: moved -0\.\d+ mm, \d+ ms late', said, re.M
    )
    # The needle is no longer where it was measured.
    status, said, complained = answered(tmp_path / 'again')
    assert status == 1
    # The robot rests within the tolerance of the control law.
    refusal = r'first motion refused: the insertion depth is 0\.02[12]\d* m, measured 0\.02 m'
    assert re.search(refusal, said + complained)


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('/**/controler:\n  ros__parameters:\n    rate: 200.0', 'no parameters for /controller'),
        ('/**/plant:\n  ros__parameters:\n    rate: 200.0', 'no parameters for /controller'),
        ('/**/controller:\n  ros_parameters:\n    rate: 200.0', "found '/**/controller', '"),
        ('controller:\n  ros__parameters:\n      rate: 200.0\n    law: pid', 'line 4, column 5'),
        ('', 'found no keys'),
    ],
)  # fmt: skip
def test_parameter_file_without_parameters_ends_before_the_start(
    ros_graph: RosGraph, tmp_path: Path, text: str, said: str
) -> None:
    """Another name of the node, a misspelled key, and a line that is indented too far."""
    file = tmp_path / 'robot.yaml'
    file.write_text(text)
    status, output, complained = told(
        ros_graph, tmp_path / 'run', [], '--params-file', str(file), '--hardware'
    )
    assert (status, output) == (2, '')
    assert re.fullmatch(f'error: {re.escape(str(file))} .*\n', complained)
    assert said in complained


def test_script_for_another_joint_states_its_wait_and_ends(
    ros_graph: RosGraph, tmp_path: Path
) -> None:
    """With the event, the longest time, and the reason of the controller."""
    drivers = runpy.run_path(str(ROOT / 'examples/robot_driver.py'), run_name='drivers')
    ros_graph.add(drivers['PositionRobot'])
    page = (ROOT / 'docs/howto/own-robot.md').read_text(encoding='utf-8')
    file = tmp_path / 'robot.yaml'
    text = page.split('```yaml\n')[1].split('```')[0]
    file.write_text(text.replace('joint: stage', 'joint: stgae'), encoding='utf-8')
    words = ['--params-file', str(file), '--hardware', '--no-recording']
    status, said, complained = told(ros_graph, tmp_path / 'run', ['status'], *words)
    assert status == 1
    assert 'waiting for a valid measurement on joint_states, 30 s at most\n' in said
    assert "joint_states has no position of the joint 'stgae'" in said
    assert 'error: timeout after 30 s: waiting for a valid measurement on joint' in complained


def test_robot_with_own_topic_and_joint(ros_graph: RosGraph, tmp_path: Path) -> None:
    """The position is read with the topic, joint and units of the controller."""
    drivers = runpy.run_path(str(ROOT / 'examples/robot_driver.py'), run_name='drivers')
    remaps = ['--ros-args', '-r', 'joint_states:=stage/states']
    stage = ros_graph.add(drivers['PositionRobot'], cli_args=remaps)
    words = [
        f'-pcontroller.{name}={value}'
        for name, value in {
            'deflection_feedback': 'none',
            'hardware.joint': 'stage',
            'hardware.state_topic': 'stage/states',
            'hardware.scale': 0.001,
            'hardware.zero': 100.0,
            'hardware.command': 'position',
            'hardware.command_topic': 'stage/joint_trajectory',
            'hardware.command_type': 'joint_trajectory',
            'hardware.commissioning.enabled': 'false',
        }.items()
    ]
    script = ['status', 'target 22mm', 'wait 100', 'status']
    status, said, complained = told(ros_graph, tmp_path / 'run', script, '--hardware', *words)
    assert (status, complained) == (0, ''), said
    before, *_, after = re.findall(r'^depth (\S+) mm', said, re.MULTILINE)
    assert float(before) == pytest.approx(20.0, abs=0.01), said
    # The stage holds the position that it had at the end of the session; a motion has ended.
    assert float(after) == pytest.approx(stage.position - 100.0, abs=0.1)
    assert float(after) == pytest.approx(22.0, abs=0.1)
    assert 'no measurements' not in said


def test_wait_ends_when_the_robot_is_silent(ros_graph: RosGraph, tmp_path: Path) -> None:
    """Its clock, which the time of `wait` counts, stands still."""
    plant = ros_graph.add(PlantNode, parameters={'rate': 200.0, 'depth': 0.02})
    node = ros_graph.node('watcher')
    states = ros_graph.listen(node, JointState, 'joint_states', SENSOR)

    def die() -> None:
        if states and states[-1].position[0] > 0.021 and plant.is_active:
            plant.trigger_deactivate()

    node.create_timer(0.02, die)
    status, said, complained = told(
        ros_graph, tmp_path / 'run', ['target 60mm', 'wait 300'], '--hardware'
    )
    assert status == 1
    assert re.search('error: line 2: no measurement for 5 s: joint_states is stale', complained), (
        said + complained
    )


def test_wrong_topic_of_a_robot_is_reported_during_the_start(
    ros_graph: RosGraph, tmp_path: Path
) -> None:
    """The session waits for the robot, and prints what the controller misses."""
    drivers = runpy.run_path(str(ROOT / 'examples/robot_driver.py'), run_name='drivers')
    remaps = ['--ros-args', '-r', 'joint_states:=stage/states']
    ros_graph.add(drivers['PositionRobot'], cli_args=remaps)
    given = {'state_topic': 'stage/other', 'joint': 'stage', 'commissioning.enabled': 'false'}
    words = [f'-pcontroller.hardware.{name}={value}' for name, value in given.items()]
    words.append('-pcontroller.deflection_feedback=none')
    line, environment = command(ros_graph, tmp_path / 'run', '--hardware', *words)
    expected = 'sensor_msgs/msg/JointState is published on /stage/states (hardware.state_topic)'
    output = tmp_path / 'output'
    with output.open('w') as file:
        session = subprocess.Popen(
            line, env=environment, stdin=subprocess.DEVNULL, stdout=file, stderr=file
        )
    begin = time.monotonic()
    try:
        while expected not in output.read_text() and time.monotonic() - begin < _LONGEST:
            ros_graph.executor.spin_once(timeout_sec=0.05)
        session.send_signal(signal.SIGINT)
        session.wait(60.0)
    finally:
        session.kill()
    assert expected in output.read_text()


def test_second_plant_is_rejected(ros_graph: RosGraph, tmp_path: Path) -> None:
    """Before any motion."""
    ros_graph.add(PlantNode, parameters={'rate': 200.0})
    status, said, complained = told(ros_graph, tmp_path / 'run', ['target 0.05'])
    assert status == 1
    domain = ros_graph.domain
    assert complained == (
        f'error: another plant is running on domain {domain}: end it, or choose another '
        'ROS_DOMAIN_ID\n'
    )
    assert 'starting' not in said
    assert 'needle> target' not in said


def test_two_robots_are_rejected_by_name(ros_graph: RosGraph, tmp_path: Path) -> None:
    """Before any motion, with the topic that both publish."""
    for namespace in ('/', '/other'):
        node = ros_graph.add(Node, f'drv{len(namespace)}', namespace=namespace)
        node.create_publisher(JointState, '/joint_states', SENSOR)
    status, _, complained = told(ros_graph, tmp_path / 'run', ['target 0.05'], '--hardware')
    assert (status, complained) == (
        1, 'error: 2 nodes publish joint_states: end all but one of /drv1, /other/drv6\n'
    )  # fmt: skip


def test_tip_is_steered_to_a_target(ros_graph: RosGraph, tmp_path: Path) -> None:
    status, said, complained = told(
        ros_graph,
        tmp_path / 'run',
        ['target 1mm,31mm,-0.5mm', 'wait', 'status', 'retract', 'wait'],
        '--needle', 'bending_35mm',
        '-p', 'steering.measurement_time=0.3',
        '-p', 'steering.patience=60',
        '-p', 'steering.measurement_timeout=5',
    )  # fmt: skip
    assert (status, complained) == (0, ''), said
    assert re.search(r'steering +OK +done: the tip is', said), said
    assert re.search(r'^steering: done: the tip is at .* from the target$', said, re.MULTILINE), (
        said
    )
    *_, end = re.findall(r'^depth (\S+) mm', said, re.MULTILINE)
    assert float(end) == pytest.approx(5.0, abs=0.3)


class Typed:
    """The command in a terminal."""

    def __init__(self, ros_graph: RosGraph, folder: Path) -> None:
        line, environment = command(ros_graph, folder)
        master, slave = pty.openpty()
        self.graph, self.master = ros_graph, master
        # A separate terminal, in which Ctrl-C is a signal.
        self.process = subprocess.Popen(
            ['/usr/bin/setsid', '--ctty', *line],
            env={**environment, 'TERM': 'xterm'},
            stdin=slave,
            stdout=slave,
            stderr=slave,
        )
        os.close(slave)
        self.seen = ''

    def __enter__(self) -> Typed:
        return self

    def __exit__(self, *raised: object) -> None:
        # Its nodes end with it.
        self.process.kill()
        self.process.wait()
        self.close()

    def close(self) -> None:
        """Close the terminal."""
        if self.master >= 0:
            os.close(self.master)
        self.master = -1

    def expect(self, pattern: str) -> None:
        """Wait for an output, and discard the output up to it."""
        begin = time.monotonic()
        while (found := re.search(pattern, self.seen)) is None:
            assert time.monotonic() - begin < _LONGEST, self.seen
            ready, _, _ = select.select([self.master], [], [], 0.1)
            if ready:
                self.seen += os.read(self.master, 65536).decode(errors='replace')
            assert ready or self.process.poll() is None, self.seen
        self.seen = self.seen[found.end() :]

    def type(self, text: str) -> None:
        os.write(self.master, text.encode())


def test_typed_commands_are_completed_and_errors_are_not_fatal(
    ros_graph: RosGraph, tmp_path: Path
) -> None:
    """Tab completes, an error is reported, Ctrl-D ends the session with a complete recording."""
    with Typed(ros_graph, tmp_path / 'run') as typed:
        typed.expect('needle> ')
        typed.type('targ\t 5\n')
        typed.expect('error: controller: target rejected')
        typed.expect('needle> ')
        typed.type('target 21mm\n')
        typed.expect('controller: on its way')
        typed.type('wait\n')
        # A line that is updated during the motion.
        typed.expect(r'\r\x1b\[Kdepth')
        typed.expect(r'depth 2[01]\.\d\d mm[^\n]*\r\n')
        typed.expect('needle> ')
        typed.type('\x04')
        typed.expect('recorded to')
        assert typed.process.wait(60.0) == 0
        assert list(read_topic(tmp_path / 'run' / 'bag', '/target'))


@pytest.mark.requirement('S-289')
def test_stop_is_typed_while_the_session_waits(ros_graph: RosGraph, tmp_path: Path) -> None:
    """It is executed at once, not after the motion."""
    with Typed(ros_graph, tmp_path / 'run') as typed:
        typed.expect('needle> ')
        typed.type('target 90mm\n')
        typed.expect('controller: on its way')
        typed.type('wait\n')
        # The prompt behind the line that is updated.
        typed.expect(r'\r\x1b\[Kdepth[^\n]*needle> ')
        typed.type('stop\n')
        typed.expect('error: the needle is not awaited any more')
        typed.expect('stopped; ~/clear_stop releases')
        typed.type('status\n')
        typed.expect(r'depth (\S+) mm')
        typed.expect(r'controller +ERROR +requested by a user')
        typed.expect('needle> ')
        typed.type('quit\n')
        typed.expect('recorded to')
        assert typed.process.wait(60.0) == 0
    *_, (_, last) = read_topic(tmp_path / 'run' / 'bag', '/joint_states')
    assert last.position[0] < 0.5 * 0.09


@pytest.mark.parametrize('closed', [False, True])
def test_ctrl_c_ends_the_session_with_a_complete_recording(
    ros_graph: RosGraph, tmp_path: Path, *, closed: bool
) -> None:
    """The exit status is 130; a closed terminal ends the session too."""
    with Typed(ros_graph, tmp_path / 'run') as typed:
        typed.expect('needle> ')
        typed.type('target 100mm\n')
        typed.expect('on its way')
        typed.type('wait\n')
        typed.expect(r'depth')
        if closed:
            typed.close()
            assert typed.process.wait(60.0) != 0
        else:
            typed.type('\x03')
            typed.expect('interrupted')
            assert typed.process.wait(60.0) == 130
        assert (tmp_path / 'run' / 'bag' / 'metadata.yaml').is_file()


def children(pid: int) -> list[int]:
    """Return the child processes of a process."""
    return [int(one) for one in Path(f'/proc/{pid}/task/{pid}/children').read_text().split()]


def words_of(pid: int) -> str:
    """Return the command line of a process."""
    return Path(f'/proc/{pid}/cmdline').read_text()


def test_killed_node_ends_the_session(ros_graph: RosGraph, tmp_path: Path) -> None:
    """With status 1 and the name of the node, also without input."""
    with Typed(ros_graph, tmp_path / 'run') as typed:
        typed.expect('needle> ')
        (pid,) = [one for one in children(typed.process.pid) if 'controller_node' in words_of(one)]
        os.kill(pid, signal.SIGKILL)
        typed.expect('error: controller ended early with status -9')
        assert typed.process.wait(60.0) == 1


def test_invalid_command_is_reported(ros_graph: RosGraph, tmp_path: Path) -> None:
    """One line has the input and the valid commands; the session continues."""
    with Typed(ros_graph, tmp_path / 'run') as typed:
        typed.expect('needle> ')
        for line, complaint in MISTAKES:
            typed.type(f'{line}\n')
            typed.expect(f'error: [^\n]*{re.escape(complaint)}')
            typed.expect('needle> ')
        typed.type('quit\n')
        assert typed.process.wait(60.0) == 0


def test_plan_is_inserted(ros_graph: RosGraph, tmp_path: Path) -> None:
    """`target` without a position sends the target of the plan, with the needle of the plan."""
    plan = bowed_plan()
    write_plan(plan, tmp_path / 'plan.yaml')
    script = ['target', 'wait', 'quit']
    words = '--plan', str(tmp_path / 'plan.yaml'), '--no-recording'
    status, output, errors = told(ros_graph, tmp_path / 'run', script, *words, rate=None)
    assert status == 0, errors
    found = re.search(r'steering: done: the tip is at .* (\d+\.\d+) mm from the target', output)
    assert found
    # The estimated tip, with the noise of the tracker and the remaining uncertainty of the tissue.
    assert float(found[1]) < 0.5


@pytest.mark.parametrize(
    ('needle', 'words', 'message'),
    [
        ('phantom', (), 'is a plan for phantom, a needle that does not bend'),
        (
            'bending_35mm',
            ('--needle', 'phantom'),
            'is a plan for the needle bending_35mm, got --n',
        ),
        (None, (), 'cannot be read: No such file or directory'),
    ],
)
def test_plan_that_cannot_be_run_is_rejected_by_a_line(
    ros_graph: RosGraph, tmp_path: Path, needle: str | None, words: Sequence[str], message: str
) -> None:
    """Before a node is started."""
    file = tmp_path / 'plan.yaml'
    if needle is not None:
        write_plan(replace(bowed_plan(), needle=needle), file)
    status, _, errors = told(ros_graph, tmp_path / 'run', [], '--plan', str(file), *words)
    assert status == 2
    assert message in errors
    assert len(errors.splitlines()) == 1


def test_status_does_not_wait_for_a_check_after_each_message(tmp_path: Path) -> None:
    """A fast clock would delay the status of nodes by seconds, until messages are lost."""
    with Graph(tmp_path) as graph:
        node, count = graph.node('operator'), 500
        status: list[Header] = []
        qos = QoSProfile(depth=count)
        node.create_subscription(Header, 'fast', lambda _: None, qos)
        node.create_subscription(Header, 'status', status.append, qos)
        fast, late = (node.create_publisher(Header, name, qos) for name in ('fast', 'status'))
        readings, screen = Readings(Node('readings', context=graph.context)), Screen()
        warnings = Warnings(screen.say, robot=False)
        terminal = Terminal(graph, Operator(node), readings, screen, warnings)
        # The executor must have installed its listeners: each message is an event of its own.
        graph.executor.spin_once(timeout_sec=0.1)
        for _ in range(count):
            fast.publish(Header())
        late.publish(Header())
        begin, checks = time.monotonic(), 0

        def has_arrived() -> bool:
            nonlocal checks
            checks += 1
            return bool(status)

        terminal._spin_until(has_arrived, 'the status', _LONGEST)
        # One check in 20 ms, and the first and last.
        assert checks <= (time.monotonic() - begin) / 0.02 + 2
