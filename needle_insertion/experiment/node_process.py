"""A node of the suite as a process."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
import signal
import subprocess
import sys
from typing import IO

from needle_insertion.nodes import NODES
from needle_ros.errors import JobError
import yaml


class GraphError(JobError):
    """A node did not start, ended early, or did not do what was expected in time."""


class NodeProcess:
    """
    One node of the suite as a process.

    Parameters
    ----------
    name : str
        A key of `NODES`.
    parameters : Mapping[str, object]
        Parameters by name.
    environment : Mapping[str, str]
        Environment with the domain.
    log : file
        Receives what the node prints.
    file : Path, optional
        ROS parameter file; what `parameters` says counts more.

    """

    def __init__(
        self,
        name: str,
        parameters: Mapping[str, object],
        environment: Mapping[str, str],
        log: IO[str],
        file: Path | None = None,
    ) -> None:
        self.name = name
        self.killed = False
        self._log = log
        settings = [] if file is None else ['--params-file', str(file)]
        for key, value in parameters.items():
            # One line of YAML, without the end-of-document mark of a bare scalar.
            text = yaml.safe_dump(value, default_flow_style=True, width=10_000).splitlines()[0]
            settings += ['-p', f'{key}:={text}']
        self.process = subprocess.Popen(
            [sys.executable, '-m', NODES[name], '--ros-args', *settings],
            env=dict(environment),
            stdout=log,
            stderr=subprocess.STDOUT,
        )

    def check(self) -> None:
        """
        Require that the node runs.

        Raises
        ------
        GraphError
            With its last line of output, if it has ended.

        """
        status = self.process.poll()
        if status is not None:
            raise GraphError(
                f'{self.name} ended early with status {status}: {self.last_line or "no output"}'
            )

    @property
    def last_line(self) -> str:
        """The last line that the node has printed."""
        self._log.flush()
        lines = Path(self._log.name).read_text(encoding='utf-8', errors='replace').splitlines()
        return lines[-1] if lines else ''

    def kill(self) -> None:
        """End the node at once, as a crash does, and wait for it."""
        self.killed = True
        self.process.kill()
        self.process.wait()

    def interrupt(self, timeout: float = 15.0) -> None:
        """
        End the node as Ctrl-C does, and wait for it.

        Parameters
        ----------
        timeout : float
            Longest time to wait [s].

        Raises
        ------
        GraphError
            If it does not end in time, or with an error.

        """
        self.process.send_signal(signal.SIGINT)
        try:
            status = self.process.wait(timeout)
        except subprocess.TimeoutExpired as error:
            raise GraphError(f'{self.name} did not end within {timeout:g} s') from error
        if status != 0:
            raise GraphError(f'{self.name} ended with status {status}: {self.last_line}')
