# SPDX-License-Identifier: Apache-2.0
"""Run a node of the suite as a process."""

from collections.abc import Mapping, Sequence
import os
from pathlib import Path
import signal
import subprocess
import sys
from typing import IO

from needle_insertion.nodes import NODES
from needle_ros.errors import JobError
from needle_ros.run_node import END_WITH_PARENT
import yaml


class GraphError(JobError):
    """A node did not start, ended early, or timed out."""


class NodeProcess:
    """
    One node of the suite, a key of `NODES`, as a process.

    `environment` selects the domain, `log` receives the output of the node, and `parameters`
    override the ROS parameter file `file`. It inherits the files `inherited`, and no terminal.
    """

    def __init__(
        self,
        name: str,
        parameters: Mapping[str, object],
        environment: Mapping[str, str],
        log: IO[str],
        file: Path | None = None,
        inherited: Sequence[int] = (),
    ) -> None:
        self.name = name
        #: Whether its end is intended or known.
        self.ended = False
        self._log = log
        settings = [] if file is None else ['--params-file', str(file)]
        for key, value in parameters.items():
            # One line of YAML, without the end-of-document mark of a bare scalar.
            text = yaml.safe_dump(value, default_flow_style=True, width=10_000).splitlines()[0]
            settings += ['-p', f'{key}:={text}']
        self.process = subprocess.Popen(
            [sys.executable, '-m', NODES[name], '--ros-args', *settings],
            env={**environment, END_WITH_PARENT: str(os.getpid())},
            stdout=log,
            stderr=subprocess.STDOUT,
            pass_fds=inherited,
            start_new_session=True,
        )

    def check(self) -> None:
        """Raise `GraphError` with the last line of output if the node has ended, once."""
        status = self.process.poll()
        if status is not None and not self.ended:
            self.ended = True
            raise GraphError(
                f'{self.name} ended early with status {status}: {self.last_line or "no output"}'
            )

    @property
    def last_line(self) -> str:
        self._log.flush()
        lines = Path(self._log.name).read_text(encoding='utf-8', errors='replace').splitlines()
        return lines[-1] if lines else ''

    def kill(self) -> None:
        self.ended = True
        self.process.kill()
        self.process.wait()

    def interrupt(self, timeout: float = 15.0) -> None:
        """End the node with SIGINT; raise `GraphError` after a timeout [s] or an error."""
        self.ended = True
        self.process.send_signal(signal.SIGINT)
        try:
            status = self.process.wait(timeout)
        except subprocess.TimeoutExpired as error:
            raise GraphError(f'{self.name} did not end within {timeout:g} s') from error
        if status != 0:
            raise GraphError(f'{self.name} ended with status {status}: {self.last_line}')
