# SPDX-License-Identifier: Apache-2.0
"""Start nodes for a person or a script, and end them with the session."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
import os
from pathlib import Path
import signal
import sys
from time import monotonic
from typing import Any, Final

from needle_controller.hardware import BY_TYPE, HardwareSettings, Robot
from needle_insertion.graph.lockstep import activate_plant, start_nodes, WARM_UP, Witness
from needle_insertion.graph.node_process import GraphError, NodeProcess
from needle_insertion.graph.ros_graph import Graph
from needle_insertion.live.operator import Operator
from needle_insertion.live.readings import Readings
from needle_insertion.live.screen import Screen
from needle_insertion.live.terminal import Terminal, Warnings
from needle_insertion.progress import ProgressLine
from needle_ros import contract
from needle_ros.base_node import LATCHED
from needle_ros.errors import NeedleError, ParameterError
from needle_ros.network import DOMAIN
from needle_ros.settings import from_values
from needle_ros.wire import JOINT_STATE, WRENCH
from rclpy.node import Node
from std_msgs.msg import String
import yaml

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


@dataclass(frozen=True)
class Session:
    """Nodes, parameters and folders of `needle run`."""

    #: Parameters by node, in the order of their start: `controller`, and optionally `recorder`,
    #: `plant` and `steering`.
    nodes: Mapping[str, Mapping[str, Any]]
    file: Path  #: ROS parameter file of all nodes; `nodes` overrides it.
    logs: Path  #: Folder of the node output.
    lockstep: bool = False  #: Whether the plant runs in lock-step, and the nodes in its time.


def run(session: Session) -> int:
    """Start the nodes, execute the commands of a person or a script, and end the nodes."""
    screen = Screen()
    with Graph(session.logs, shared=True) as graph:
        node = graph.node('operator')
        _check_alone(session, graph, node, own=0, discovery=1.0)
        operator = Operator(node)
        screen.say(f'starting {", ".join(session.nodes)}')
        # The first commands of a script are always executed at the same sample: time continues
        # until all sensors have reported.
        holds = session.lockstep and not screen.typed
        witness = (
            Witness(node, lambda sample: sample.time < WARM_UP, lockstep=True) if holds else None
        )
        warnings = Warnings(screen.say)
        processes, readings = _bring_up(
            session, graph, node, operator, screen, warnings, holds=holds
        )
        terminal = Terminal(graph, operator, readings, screen, warnings)
        terminal.begin(session.nodes)
        screen.say(f'on domain {graph.domain}; `help` lists the words')
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
    if 'recorder' in session.nodes:
        screen.say(f'recorded to {session.nodes["recorder"]["path"]}')
    return 0


def _bring_up(
    session: Session,
    graph: Graph,
    node: Node,
    operator: Operator,
    screen: Screen,
    warnings: Warnings,
    *,
    holds: bool,
) -> tuple[list[NodeProcess], Readings]:
    """Start the nodes; the plant starts after all others have subscribed, for a complete bag."""
    begin = monotonic()

    def show(name: str) -> None:
        message = operator.states[name].message if name in operator.states else ''
        screen.show(f'starting {name}, {monotonic() - begin:.0f} s' + (message and f': {message}'))

    processes = start_nodes(
        graph, node, session.nodes, show, session.file, lockstep=session.lockstep
    )
    own = 'plant' in session.nodes
    robot = None if own else _robot(graph, node)
    readings = Readings(Node('readings', context=graph.context), robot)
    state = (robot and robot.settings.state_topic) or contract.JOINT_STATES.name
    # The node `steering` reads the topic of the contract.
    others = own + ('steering' in session.nodes and state != contract.JOINT_STATES.name)

    def listen() -> bool:
        warnings.show(operator.states)
        # This process subscribes, too.
        subscribed = node.count_subscribers(state) >= len(processes) + 1 + holds - others
        aimed = node.count_subscribers(contract.TARGET.name) >= len(processes) - own
        return subscribed and aimed

    what = 'the nodes' if own else f'a robot that publishes {state}, and for the nodes'
    graph.spin_until(listen, what, _START)
    _check_alone(session, graph, node, own=1)
    if own:
        show('plant')
        followers = [name for name in session.nodes if name in ('recorder', 'steering')]
        number = session.lockstep * (holds + len(followers))
        activate_plant(graph, node, operator.states, number)
    return processes, readings


def _robot(graph: Graph, node: Node) -> Robot | None:
    """Return the robot of the controller, by its configuration; None for the contract."""
    topic = contract.CONFIGURATION.name.replace('~', 'controller')
    latest = graph.latest(node, String, topic, LATCHED)
    graph.spin_until(lambda: latest.message, topic, _START)
    (document,) = yaml.safe_load(latest.message.data).values()
    values, prefix = document['ros__parameters'], 'hardware.'
    own = {item.name: values[f'{prefix}{item.name}'] for item in fields(HardwareSettings)}
    # The controller has found the topics of their type.
    for name, field in ((JOINT_STATE, 'state_topic'), (WRENCH, 'wrench_topic')):
        if own[field] == BY_TYPE:
            read = node.get_subscriber_names_and_types_by_node('controller', node.get_namespace())
            found = [topic for topic, types in read if name in types]
            own[field] = found[0] if len(found) == 1 else ''
    return Robot(from_values(HardwareSettings, own, prefix))


def _check_alone(
    session: Session, graph: Graph, node: Node, *, own: int, discovery: float = 0.0
) -> None:
    """Reject more than `own` nodes in a role of the session, during a time for discovery [s]."""
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
            if node.count_publishers(topic.name) > (own if name in session.nodes else 1):
                raise GraphError(
                    f'another {name} is running on domain {graph.domain}: end it, or choose '
                    f'another {DOMAIN}'
                )
        return monotonic() >= end

    graph.spin_until(has_passed, 'discovery')


def _converse(terminal: Terminal, screen: Screen, witness: Witness | None) -> None:
    """Execute one line after another, until `quit` or the end of the script."""
    for number, line in enumerate(iter(terminal.next_line, None), 1):
        word = (line.partition('#')[0].split() or [''])[0]
        if witness is not None and word not in _AT_REST:
            witness.release()
            witness = None
        try:
            if terminal.onecmd(line):
                return
            if witness is not None and word == 'target':
                witness.release()
                witness = None
        except GraphError:
            raise
        except NeedleError as error:
            if not screen.typed:
                raise type(error)(f'line {number}: {error}') from error
            screen.say(f'error: {error}')
