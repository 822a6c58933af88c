# SPDX-License-Identifier: Apache-2.0
"""`needle run`: start the nodes of an insertion, execute commands of a person or a script."""

import argparse
from collections.abc import Collection
from datetime import datetime
from pathlib import Path
from typing import Any

from needle_insertion.commands.common import add_flag, add_needle, check_folder
from needle_insertion.progress import ProgressLine
from needle_ros.errors import ParameterError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_flag(parser, '--hardware', 'start no plant: a robot publishes joint_states')
    add_needle(parser, None, 'from the parameter file; the tip of a needle that bends is steered')
    add_flag(
        parser,
        '--realtime',
        'run the plant in real time instead of lock-step: it does not wait for nodes that a busy '
        'machine delays',
    )
    parser.add_argument(
        '--plan',
        type=Path,
        metavar='FILE',
        help='plan of `needle plan -o`, which `target` without a position inserts along',
    )
    parser.add_argument('--law', help='control law (default: from the parameter file)')
    parser.add_argument(
        '--params-file',
        type=Path,
        metavar='FILE',
        help='ROS parameter file (default insertion.yaml or steering.yaml of this package)',
    )
    parser.add_argument(
        '-p',
        action='append',
        default=[],
        dest='parameters',
        metavar='NODE.NAME=VALUE',
        help='any parameter, such as controller.force_limit=5; repeatable',
    )
    parser.add_argument(
        '-o',
        '--output',
        type=Path,
        help='folder for recording and logs (default needle_runs/ and the time)',
    )
    add_flag(parser, '--no-recording', 'do not record')


def run(options: argparse.Namespace) -> int:
    # Imported here: rclpy takes a second.
    with ProgressLine('needle run', brief=True):
        from needle_dynamics import find_needle
        from needle_insertion.commands.compile import compile_nodes
        from needle_insertion.graph.ros_graph import Graph
        from needle_insertion.live.session import config_file, Session

    if options.output is None:
        options.output = Path('needle_runs') / f'{datetime.now().astimezone():%Y-%m-%d_%H-%M-%S}'
    if options.output.exists():
        raise ParameterError(f'{options.output} exists; name another folder')
    check_folder(options.output)
    plan = _plan(options)
    steers = options.needle is not None and find_needle(options.needle).bends
    file = options.params_file or config_file('steering.yaml' if steers else 'insertion.yaml')
    if not file.is_file():
        raise ParameterError(f'--params-file {file} does not exist')
    nodes = _nodes(options, steers=steers)
    _check_file(file, ['controller'] if options.hardware else nodes)
    if not options.no_recording:
        nodes = {'recorder': {'path': str(options.output / 'bag')}, **nodes}
    compile_nodes()
    lockstep = not (options.hardware or options.realtime)
    with Graph(options.output / 'logs', shared=True) as graph:
        session = Session(graph, nodes, file, lockstep=lockstep, target=plan)
        session.run()
    if not options.no_recording:
        session.screen.say(f'recorded to {options.output / "bag"}')
    return 0


def _check_file(file: Path, nodes: Collection[str]) -> None:
    """Reject a file without parameters for any of the nodes: they would start with defaults."""
    # Imported here: rclpy takes a second.
    from needle_ros.parameter_node import sections, unmatched_files

    found = sections(['--params-file', str(file)])
    lines = [unmatched_files(found, f'/{name}') for name in nodes]
    if all(lines):
        raise ParameterError(lines[0][0])


def _plan(options: argparse.Namespace) -> tuple[float, float, float] | None:
    """Read the plan and use its needle; return its target in the frame of the guide [m]."""
    if options.plan is None:
        return None
    from needle_dynamics import find_needle
    from needle_planning import read_plan

    plan = read_plan(options.plan)
    if options.needle not in (None, plan.needle):
        raise ParameterError(
            f'{options.plan} is a plan for the needle {plan.needle}, got --needle {options.needle}'
        )
    if not find_needle(plan.needle).bends:
        raise ParameterError(
            f'{options.plan} is a plan for {plan.needle}, a needle that does not bend'
        )
    options.needle = plan.needle
    x, y, z = ((plan.target - plan.entry) @ plan.axes.T).tolist()
    return x, y, z


def _nodes(options: argparse.Namespace, *, steers: bool) -> dict[str, dict[str, Any]]:
    steered = {'steered': True} if steers else {}
    nodes: dict[str, dict[str, Any]] = {} if options.hardware else {'plant': {**steered}}
    nodes['controller'] = {**steered}
    if steers:
        nodes['steering'] = {}
        if options.plan is not None:
            nodes['steering']['plan'] = str(options.plan.resolve())
    if options.needle is not None:
        for values in nodes.values():
            values['needle'] = options.needle
    if options.law:
        nodes['controller']['law'] = options.law
    for word in options.parameters:
        node, name, value = _parameter(word)
        if node not in nodes:
            raise ParameterError(f'-p {word}: the nodes are {", ".join(nodes)}, got {node!r}')
        if name in ('lockstep', 'use_sim_time'):
            raise ParameterError(f'-p {word}: this parameter is set by --realtime')
        nodes[node][name] = value
    return nodes


def _parameter(word: str) -> tuple[str, str, Any]:
    # Imported here: the help does not need it.
    from needle_ros.files import read_value

    name, sign, text = word.partition('=')
    node, dot, name = name.partition('.')
    if not (sign and dot and name and text):
        raise ParameterError(f'-p takes NODE.NAME=VALUE, got {word!r}')
    return node, name, read_value(text)
