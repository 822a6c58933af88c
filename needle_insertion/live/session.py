"""Nodes that are brought up for a person, and ended with the session."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import os
from pathlib import Path
import sys
from time import monotonic
from typing import Any, Final

from needle_insertion.experiment.insertion import WARM_UP
from needle_insertion.experiment.node_process import GraphError, NodeProcess
from needle_insertion.experiment.ros_graph import ACTIVATE, CONFIGURE, Graph
from needle_insertion.experiment.simulated_run import IN_LOCKSTEP, Sample, Witness
from needle_insertion.live.operator import Operator
from needle_insertion.live.readings import Readings
from needle_insertion.live.screen import Screen
from needle_insertion.live.terminal import Terminal
from needle_ros import contract
from needle_ros.contract import Topic
from needle_ros.errors import NeedleError, ParameterError
from needle_ros.network import DOMAIN
from rclpy.node import Node

#: Where the parameter files are: in a clone, beside what pip installed, and where colcon puts
#: them.
_SHARE: Final = Path('share/needle_insertion/config')

#: Longest start of the nodes, with everything to compile on a busy machine [s].
_START: Final = 180.0

#: Words of a script before which time does not go on; the first target arrives before, too.
_AT_REST: Final = ('', 'target', 'law', 'set', 'status', 'help')

#: The order in which nodes end.
_ENDING: Final = ('steering', 'controller', 'plant', 'recorder')


def config_file(name: str) -> Path:
    """
    Return a parameter file of this package.

    Parameters
    ----------
    name : str
        Its name.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ParameterError
        If it is not installed.

    """
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
    """
    What to bring up.

    Attributes
    ----------
    nodes : dict
        Parameters of each node by its name: `controller`, and `plant` and `steering` if wanted.
    file : Path
        ROS parameter file of all; what `nodes` says counts more.
    folder : Path
        For the recording, ``bag``, and what the nodes print, ``logs``.
    records : bool
        Whether everything is recorded.
    lockstep : bool
        Whether the plant runs in lock-step, and the nodes in its time.

    """

    nodes: Mapping[str, Mapping[str, Any]]
    file: Path
    folder: Path
    records: bool
    lockstep: bool = False

    @property
    def names(self) -> list[str]:
        """Names of the nodes, in the order of their start."""
        return ['recorder'] * self.records + list(self.nodes)

    @property
    def bag(self) -> Path:
        """Where it is recorded to."""
        return self.folder / 'bag'


def run(session: Session) -> int:
    """
    Bring the nodes up, do what a person or a script says, and end them.

    Parameters
    ----------
    session : Session
        What to bring up.

    Returns
    -------
    int
        0.

    Raises
    ------
    NeedleError
        If a node fails; where the words are not typed but come from a script, also if one of
        them cannot be done.

    """
    screen = Screen()
    with Graph(session.folder / 'logs', shared=True) as graph:
        node = graph.node('operator')
        operator = Operator(node)
        readings = Readings(Node('readings', context=graph.context))
        screen.say(f'starting {", ".join(session.names)}')
        # What a script asks for first is asked for at the same sample every time.
        holds = session.lockstep and not screen.typed
        witness = Witness(node, _warms_up, lockstep=True) if holds else None
        processes = _bring_up(session, graph, node, operator, screen, holds=holds)
        terminal = Terminal(graph, operator, readings, screen)
        terminal.begin(session.names)
        screen.say(f'on domain {graph.domain}; `help` lists the words')
        with screen.reading():
            _converse(terminal, screen, processes, witness)
        # What moves the needle ends first, and the recorder last: the bag has the end.
        for name in _ENDING:
            for process in processes:
                if process.name == name:
                    process.interrupt()
    if session.records:
        screen.say(f'recorded to {session.bag}')
    return 0


def _warms_up(sample: Sample) -> bool:
    """Let time go on until all sensors have reported."""
    return sample.time < WARM_UP


def _bring_up(
    session: Session,
    graph: Graph,
    node: Node,
    operator: Operator,
    screen: Screen,
    *,
    holds: bool,
) -> list[NodeProcess]:
    """Start the nodes; the plant begins when all others listen: the bag holds every sample."""
    processes, begin = [], monotonic()
    for name in session.names:
        parameters = dict(session.nodes.get(name, {}))
        if name == 'recorder':
            processes.append(graph.start(name, {'path': str(session.bag)}))
            continue
        if name == 'plant':
            parameters |= {'autostart': False, 'lockstep': session.lockstep}
        elif session.lockstep:
            parameters['use_sim_time'] = True
        processes.append(graph.start(name, parameters, session.file))

    def show(name: str) -> None:
        said = operator.states[name].message if name in operator.states else ''
        screen.show(f'starting {name}, {monotonic() - begin:.0f} s' + (said and f': {said}'))

    for process in processes:
        if process.name != 'plant':
            graph.wait_active(node, process.name, show)
    own = 'plant' in session.names

    def count(topic: Topic) -> int:
        return node.count_subscribers(topic.name)

    def listen() -> bool:
        # This process listens too.
        hear = count(contract.JOINT_STATES) >= len(processes) + 1 + holds - own
        return hear and count(contract.TARGET) >= len(processes) - own

    what = 'the nodes' if own else 'a robot that publishes joint_states, and the nodes,'
    graph.spin_until(listen, what, _START)
    _check_alone(graph, node)
    if own:
        show('plant')
        number = session.lockstep * (holds + session.records + ('steering' in session.names))
        _begin_plant(graph, node, operator, number)
    return processes


def _check_alone(graph: Graph, node: Node) -> None:
    """Refuse a second plant or controller."""
    for topic, there in ((contract.JOINT_STATES, 'a plant'), (contract.WRENCH_COMMAND, 'one')):
        if (number := node.count_publishers(topic.name)) > 1:
            raise GraphError(
                f'{number} nodes publish {topic.name} on domain {graph.domain}: there is {there} '
                f'already. End it, or choose another {DOMAIN}'
            )


def _begin_plant(graph: Graph, node: Node, operator: Operator, number: int) -> None:
    """Activate the plant once it has found the nodes that its samples wait for."""
    graph.change(node, 'plant', CONFIGURE)

    def found() -> bool:
        state = operator.states.get('plant')
        return state is not None and state.values.get(IN_LOCKSTEP) == str(number)

    graph.spin_until(found, 'the nodes in lock-step')
    graph.change(node, 'plant', ACTIVATE)


def _converse(
    terminal: Terminal,
    screen: Screen,
    processes: Sequence[NodeProcess],
    witness: Witness | None,
) -> None:
    """Do one line after another, until `quit` or the end of the script."""
    while (line := terminal.next_line()) is not None:
        word = (line.partition('#')[0].split() or [''])[0]
        if witness is not None and word not in _AT_REST:
            witness.release()
            witness = None
        try:
            if not terminal.do(line):
                return
            if witness is not None and word == 'target':
                witness.release()
                witness = None
        except NeedleError as error:
            for process in processes:
                process.check()
            if not screen.typed:
                raise
            screen.say(f'error: {error}')
