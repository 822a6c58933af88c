"""A process that runs one node."""

from __future__ import annotations

from collections.abc import Callable
import ctypes
import gc
import os
import signal
import sys
import time
from types import FrameType

from needle_ros.base_node import BaseNode
from needle_ros.errors import NeedleError
from needle_ros.parameter_files import sections, shared_names, strangers
import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.task import Future

#: Environment variable: if it is set, a node ends when the process that started it ends.
END_WITH_PARENT = 'NEEDLE_END_WITH_PARENT'

_PR_SET_PDEATHSIG = 1

#: What ends a node; SIGHUP comes when its terminal is closed.
_ENDINGS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def run(kind: Callable[[], BaseNode], arguments: list[str] | None = None) -> int:
    """
    Run one node until SIGINT, SIGTERM or SIGHUP, then deactivate it while it can still publish.

    Parameters
    ----------
    kind : callable
        Makes the node.
    arguments : list of str, optional
        Command line with ROS arguments; ``sys.argv`` if not given.

    Returns
    -------
    int
        Exit status: 0, or 2 if the node refused to start.

    """
    stopping = False

    def stop(_signal: int, _frame: FrameType | None) -> None:
        nonlocal stopping
        stopping = True

    if os.environ.get(END_WITH_PARENT):
        # Linux sends the signal when the process that started this one ends, in whatever way.
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    try:
        # Not rclpy's handlers: they end the context before the node can publish its last command.
        rclpy.init(args=arguments, signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    except RuntimeError as error:
        # rcl could not read the arguments or the parameter file.
        sys.stderr.write(f'error: {" ".join(str(error).split())}\n')
        return 2
    previous = {one: signal.signal(one, stop) for one in _ENDINGS}
    try:
        try:
            node = kind()
        except (ParameterException, NeedleError, RuntimeError) as error:
            # RuntimeError is rcl's, for a node that its security refuses.
            sys.stderr.write(f'error: {" ".join(str(error).split())}\n')
            return 2
        found, name = sections(arguments or sys.argv), node.get_fully_qualified_name()
        for line in strangers(found, name):
            node.get_logger().warning(line)
        node.shared = shared_names(found, name)
        executor: Executor = EventsExecutor()
        executor.add_node(node)
        status = 0
        if node.get_parameter('autostart').value and not node.start():
            # The reason, on /diagnostics.
            node.publish_diagnostics()
            status = 2
        # A full collection takes 0.2 s: it shall not scan what was imported.
        gc.freeze()
        while not stopping and status == 0:
            # Unlike spin_once it does not return to Python at each event.
            executor.spin_until_future_complete(Future(), timeout_sec=0.1)
        node.stop()
        # The last messages (a zero force, a latched result) are still to be sent.
        deadline = time.monotonic() + 0.1
        while time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.02)
        executor.shutdown()
        node.destroy_node()
        return status
    finally:
        rclpy.utilities.try_shutdown()
        for one, handler in previous.items():
            signal.signal(one, handler)
