# SPDX-License-Identifier: Apache-2.0
"""Start nodes for a person or a script, and end them with the session."""

from collections.abc import Mapping
import os
from pathlib import Path
import signal
import sys
from time import monotonic
from typing import Any, Final

from needle_controller.hardware import BY_TYPE, Robot, settings_in
from needle_insertion.graph.lockstep import activate_plant, start_nodes, WARM_UP, Witness
from needle_insertion.graph.ros_graph import Graph, GraphError, NodeProcess
from needle_insertion.live.operator import Operator
from needle_insertion.live.readings import Readings
from needle_insertion.live.screen import Screen
from needle_insertion.live.terminal import Terminal, Warnings
from needle_insertion.progress import ProgressLine
from needle_ros import contract
from needle_ros.base_node import LATCHED
from needle_ros.errors import NeedleError, ParameterError
from needle_ros.network import DOMAIN
from needle_ros.parameter_file import parameters_in
from needle_ros.wire import JOINT_STATE, WRENCH
from rclpy.node import Node
from std_msgs.msg import String

#: Folder of the parameter files, below the prefix of pip or colcon.
_SHARE: Final = Path('share/needle_insertion/config')

#: Timeout of the start of the nodes, with compilation on a busy machine [s].
_START: Final = 180.0

#: Commands of a script during which simulated time is paused, up to the first target.
_AT_REST: Final = ('', 'target', 'law', 'set', 'status', 'help')

_ENDING: Final = ('steering', 'controller', 'plant', 'recorder')  #: Order in which nodes end.


def config_file(name: str) -> Path:
    """Return the path of a parameter file of the package, or raise `ParameterError`."""
    prefixes = [Path(one) for one in os.environ.get('AMENT_PREFIX_PATH', '').split(':') if one]
    folders = [
        Path(__file__).parents[2] / 'config',
        *(prefix / _SHARE for prefix in (Path(sys.prefix), *prefixes)),
    ]
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    raise ParameterError(
        f'{name} is in none of {", ".join(map(str, folders))}; name a file with --params-file'
    )


class Session:
    """
    Nodes of `needle run`, with parameters that override a ROS parameter file.

    The keys of `nodes` are, in the order of their start: optionally `recorder` and `plant`,
    `controller`, and optionally `steering`. With `lockstep` the plant runs in lock-step, and the
    nodes in its time. `target` is that of the word `target` without a position [m].
    """

    def __init__(
        self,
        graph: Graph,
        nodes: Mapping[str, Mapping[str, Any]],
        file: Path,
        *,
        lockstep: bool,
        target: tuple[float, float, float] | None = None,
    ) -> None:
        self._graph, self._nodes, self._file, self._lockstep = graph, nodes, file, lockstep
        self._target = target
        self._node, self.screen = graph.node('operator'), Screen()
        self._check_alone(own=0, discovery=1.0)
        self._operator = Operator(self._node)
        self._warnings = Warnings(self.screen.say, robot='plant' not in nodes)

    def run(self) -> None:
        """Start the nodes, execute the commands of a person or a script, and end the nodes."""
        screen, witness = self.screen, None
        screen.say(f'starting {", ".join(self._nodes)}')
        if self._lockstep and not screen.typed:
            # The first commands of a script are always executed at the same sample: time continues
            # until all sensors have reported.
            witness = Witness(self._node, lambda sample: sample.time < WARM_UP, lockstep=True)
        processes, readings = self._bring_up(holds=witness is not None)
        terminal = Terminal(
            self._graph, self._operator, readings, screen, self._warnings, self._target
        )
        terminal.begin(self._nodes)
        screen.say(f'on domain {self._graph.domain}; `help` lists the words')
        # Suspended, the session could not stop the needle.
        signal.signal(signal.SIGTSTP, signal.SIG_IGN)
        with screen.reading():
            rests = False
            try:
                _converse(terminal, screen, witness)
                rests = terminal.rests
            finally:
                if not rests:
                    terminal.stop()
        # Nodes that move the needle end first, the recorder last: the bag is complete.
        with ProgressLine('ending the nodes', brief=True):
            for process in sorted(processes, key=lambda one: _ENDING.index(one.name)):
                process.interrupt()

    def _bring_up(self, *, holds: bool) -> tuple[list[NodeProcess], Readings]:
        """Start the nodes; the plant starts after all others have subscribed."""
        graph, node, nodes, states = self._graph, self._node, self._nodes, self._operator.states
        begin = monotonic()

        def show(name: str) -> None:
            message = f': {states[name].report.message}' if name in states else ''
            line = f'starting {name}, {monotonic() - begin:.0f} s{message}'
            self.screen.show(line.removesuffix(': '))

        processes = start_nodes(graph, node, nodes, show, self._file, lockstep=self._lockstep)
        own = 'plant' in nodes
        robot = None if own else _robot(graph, node)
        readings = Readings(Node('readings', context=graph.context), robot)
        state = (robot and robot.settings.state_topic) or contract.JOINT_STATES.name
        # The node `steering` reads the topic of the contract.
        others = own + ('steering' in nodes and state != contract.JOINT_STATES.name)

        def listen() -> bool:
            self._warnings.show(states)
            # This process subscribes, too.
            subscribed = node.count_subscribers(state) >= len(processes) + 1 + holds - others
            aimed = node.count_subscribers(contract.TARGET.name) >= len(processes) - own
            return subscribed and aimed

        what = 'the nodes' if own else f'a robot that publishes {state}, and for the nodes'
        graph.spin_until(listen, what, _START)
        self._check_alone(own=1)
        if own:
            show('plant')
            followers = [name for name in nodes if name in ('recorder', 'steering')]
            activate_plant(graph, node, states, self._lockstep * (holds + len(followers)))
        return processes, readings

    def _check_alone(self, *, own: int, discovery: float = 0.0) -> None:
        """Reject more than `own` nodes in a role, during a time for discovery [s]."""
        end = monotonic() + discovery

        def has_passed() -> bool:
            for name, topic in (
                ('plant', contract.JOINT_STATES),
                ('controller', contract.WRENCH_COMMAND),
                ('controller', contract.REFERENCE),
                ('steering', contract.TIP_EXPECTED),
                ('recorder', contract.RECORDED),
            ):
                # Without a plant of its own the session needs a robot.
                foreign = name not in self._nodes
                # The name of a node is discovered after its publishers.
                if foreign and monotonic() < end:
                    continue
                most = 1 if foreign else own
                if self._node.count_publishers(topic.name) > most:
                    if foreign:
                        found = self._node.get_publishers_info_by_topic(topic.name)
                        spaces = [(one.node_namespace.rstrip('/'), one.node_name) for one in found]
                        raise GraphError(
                            f'{len(found)} nodes publish {topic.name}: end all but one of '
                            + ', '.join(sorted(map('/'.join, spaces)))
                        )
                    raise GraphError(
                        f'another {name} is running on domain {self._graph.domain}: end it, or '
                        f'choose another {DOMAIN}'
                    )
            return monotonic() >= end

        self._graph.spin_until(has_passed, 'discovery')


def _robot(graph: Graph, node: Node) -> Robot | None:
    """Return the robot of the controller, by its configuration; None for the contract."""
    topic = contract.CONFIGURATION.name.replace('~', 'controller')
    latest = graph.latest(node, String, topic, LATCHED)
    graph.spin_until(lambda: latest.message, topic, _START)
    values, own = parameters_in(latest.message.data), {}
    # The controller has found the topics of their type.
    for name, field in ((JOINT_STATE, 'state_topic'), (WRENCH, 'wrench_topic')):
        if values.get(f'hardware.{field}') == BY_TYPE:
            read = node.get_subscriber_names_and_types_by_node('controller', node.get_namespace())
            found = [topic for topic, types in read if name in types]
            own[field] = found[0] if len(found) == 1 else ''
    return Robot(settings_in(values, **own))


def _converse(terminal: Terminal, screen: Screen, witness: Witness | None) -> None:
    """Execute one line after another, until `quit` or the end of the script."""
    for number, line in enumerate(iter(terminal.next_line, None), 1):
        word = (line.partition('#')[0].split() or [''])[0]
        if witness is not None and word not in _AT_REST:
            witness.release()
        try:
            if terminal.onecmd(line):
                return
            if witness is not None and word == 'target':
                witness.release()
        except GraphError:
            raise
        except NeedleError as error:
            if not screen.typed:
                raise type(error)(f'line {number}: {error}') from error
            screen.say(f'error: {error}')
