# SPDX-License-Identifier: Apache-2.0
"""Main function of a node process."""

import argparse
from collections.abc import Callable, Collection, Sequence
import ctypes
import gc
import inspect
import os
from pathlib import Path
import re
import signal
import sys
import textwrap
import time
from types import FrameType
from typing import Final

from needle_ros.base_node import BaseNode, steady_timer
from needle_ros.errors import NeedleError
from needle_ros.network import check_security, LOCAL, RANGE, stay_local
from needle_ros.parameter_node import sections, shared_names, unmatched_files
from needle_ros.process import ENDINGS
import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

#: Environment variable: a node ends with its parent process, of this process ID (1: any parent).
END_WITH_PARENT = 'NEEDLE_END_WITH_PARENT'

INVALID_INPUT: Final = 2  #: Exit status of a node that rejects its parameters or arguments.

_SIGNALS, _HOUR = 0.02, 3600.0  #: Period of the check for signals, and longest spin [s].

_PR_SET_PDEATHSIG, _M_ARENA_MAX, _M_MMAP_THRESHOLD = 1, -8, -3

_USAGE = '%(prog)s [-h] [--ros-args [-p NAME:=VALUE ...] [--params-file FILE] ...]'
_WIDTH, _DEEP = 99, 6 * ' '


def run(kind: Callable[[], BaseNode]) -> int:
    """
    Run one node until SIGINT, SIGTERM or SIGHUP, then deactivate it while it can still publish.

    Return the exit status: 0, 1 if the node `failed`, or 2 if it refused to start. An error in a
    callback deactivates the node, ends the process and is raised.
    """
    stopping = spinning = False

    def stop(_number: int, _frame: FrameType | None) -> None:
        nonlocal stopping
        stopping = True
        if not spinning:
            # No command has been sent yet. An exception would appear as a compiler error.
            os._exit(0)

    if parent := os.environ.get(END_WITH_PARENT):
        _end_with_parent(parent)
    for one in ENDINGS:
        signal.signal(one, stop)
    stay_local(os.environ)
    # Memory that a thread of glibc has freed serves all threads, or the system from 0.5 MB on.
    if hasattr(libc := ctypes.CDLL(None), 'mallopt'):
        libc.mallopt(_M_ARENA_MAX, 1)
        libc.mallopt(_M_MMAP_THRESHOLD, 2**19)
    try:
        try:
            check_security(os.environ)
            _check_words(kind, sys.argv)
            # The handlers of rclpy end the context before the node can publish its last command.
            rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
            node = kind()
        except (ParameterException, NeedleError, RuntimeError) as error:
            # rcl raises RuntimeError for invalid arguments or parameter files, and for a node that
            # SROS2 rejects.
            words = _explained(error)
            if 'initialize logging' in words:
                words += '; set ROS_LOG_DIR to a folder that can be written'
            sys.stderr.write(f'error: {words}\n')
            return INVALID_INPUT
        _read_files(node)
        spinning = True
        status = _spin(node, lambda: stopping)
        del node
        return status
    finally:
        # The threads of DDS end with the last object of the node. While the interpreter ends they
        # would use freed memory.
        gc.unfreeze()
        gc.collect()
        rclpy.utilities.try_shutdown()
        # A second Ctrl-C must not change the exit status.
        for one in ENDINGS:
            signal.signal(one, signal.SIG_IGN)


def _explained(error: Exception) -> str:
    """Return the message of an error; for a parameter file, what is wrong in it."""
    if 'parse params file' in str(error):
        try:
            sections(sys.argv)
        except NeedleError as own:
            error = own
    # Without the source files of rcl.
    return re.sub(r' ?, at /\S+:\d+', '', ' '.join(str(error).split()))


def _spin(node: BaseNode, stopping: Callable[[], bool]) -> int:
    """Spin a node until it is to stop or refused to start; return the exit status."""
    executor: Executor = EventsExecutor()
    executor.add_node(node)
    status, ended = 0, Future()

    def refuse() -> None:
        nonlocal status
        # Publish the reason on /diagnostics.
        node.publish_diagnostics()
        status = INVALID_INPUT
        ended.set_result(None)

    # A signal is handled at the next callback.
    steady_timer(node, _SIGNALS, lambda: ended.set_result(None) if stopping() else None)
    try:
        if node.get_parameter('autostart').value:
            node.begin(refuse)
        while not ended.done():
            # Unlike spin_once, this call does not return to Python at each event. Each call loses
            # an object, and without a timeout no signal is handled.
            executor.spin_until_future_complete(ended, timeout_sec=_HOUR)
    finally:
        # Command zero force also after an error.
        node.stop()
    # Send the last messages (zero force, latched result).
    deadline = time.monotonic() + 0.1
    while time.monotonic() < deadline:
        executor.spin_once(timeout_sec=0.02)
    if node.is_preparing:
        # No command has been sent, and a compiler thread cannot be stopped otherwise.
        sys.stderr.flush()
        os._exit(status)
    end(executor, [node])
    return status or int(node.failed)


def end(executor: Executor, nodes: Collection[Node]) -> None:
    """Shut an executor down, and destroy its nodes; life cycle services end with the object."""
    try:
        # EventsExecutor never frees a queued task, nor its node: execute them, and their tasks. An
        # event of a node that is already removed would be freed without the lock of Python.
        for _ in range(2):
            done = Future()
            executor.create_task(done.set_result, None)
            executor.spin_until_future_complete(done, timeout_sec=1.0)
    finally:
        executor.shutdown()
        for node in nodes:
            node.destroy_node()


def _end_with_parent(parent: str) -> None:
    # Linux sends the signal when the parent process ends for any reason.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if parent not in ('1', str(os.getppid())):
        # It ended before this call.
        os._exit(0)


def _read_files(node: BaseNode) -> None:
    """Set the shared parameters of a node, and warn of files without a section for it."""
    found, name = sections(sys.argv), node.get_fully_qualified_name()
    for line in unmatched_files(found, name):
        node.get_logger().warning(line)
    node.shared = shared_names(found, name)


def _check_words(kind: Callable[[], BaseNode], words: Sequence[str]) -> None:
    program, *others = remove_ros_args(list(words))
    parser = argparse.ArgumentParser(Path(program).name, usage=_USAGE, add_help=False)
    parser.add_argument('-h', '--help', action='store_true')
    known, unknown = parser.parse_known_args(others)
    if known.help:
        parser.print_usage()
        sys.stdout.write('\n'.join(_described(kind)) + '\n')
        parser.exit()
    if unknown:
        parser.error(
            f'unknown: {" ".join(unknown)}; set parameters with --ros-args -p NAME:=VALUE'
        )


def _described(kind: Callable[[], BaseNode]) -> list[str]:
    """Return the help text: class summary and parameters of a node."""
    # Hidden from other nodes, which would report a duplicate node.
    os.environ.update({**LOCAL, RANGE: 'OFF'})
    os.environ.pop('ROS_STATIC_PEERS', None)
    rclpy.init(args=[])
    try:
        node = kind()
        summary, *_ = inspect.cleandoc(type(node).__doc__ or '').split('\n\n')
        lines = [summary, '', 'Parameters and defaults:']
        for name, value in node.values().items():
            lines.append(f'  {name}: {value}')
            meaning = node.describe_parameter(name).description
            lines += textwrap.wrap(meaning, _WIDTH, initial_indent=_DEEP, subsequent_indent=_DEEP)
        return lines
    finally:
        rclpy.utilities.try_shutdown()
