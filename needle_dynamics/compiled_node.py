"""Base class of the nodes that call compiled functions."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, ClassVar

from needle_dynamics.compiled.cache import prepare, reports, where_kept
from needle_ros.base_node import BaseNode
from needle_ros.preparation import imports, Progress


class CompiledNode(BaseNode):
    """
    A node that loads or compiles its kernels before it is configured.

    To compile or load a function while the node is active is an error, and logged as such:
    messages wait for it.

    Attributes
    ----------
    late : list of str
        Functions that were compiled or loaded while the node was active.
    """

    #: Numba imports these when it converts the first array.
    IMPORTS = ('numba.core.boxing', 'numba.core.runtime.context')
    #: Kernels that the node can call, in any mode and with any parameters: modules, or
    #: ``module:kernel``.
    KERNELS: ClassVar[tuple[str, ...]] = ()

    def __init__(self, name: str, **node_options: Any) -> None:
        self._compiled = 0
        self.late: list[str] = []
        super().__init__(name, **node_options)
        self._listening = reports(self._on_function)
        self._listening.__enter__()

    def preparation(self) -> Iterable[Progress]:
        """Import modules, then load or compile kernels."""
        yield from imports(self.IMPORTS)
        for step in prepare(self.KERNELS):
            yield Progress(*step)
        if self._compiled:
            self.get_logger().info(f'{self._compiled} functions compiled: {where_kept()}')

    def _on_function(self, function: str, loaded: bool, prepared: bool) -> None:
        if self.is_active:
            # Another node of this process may be prepared now.
            if not prepared:
                self.late.append(function)
                done = 'loaded' if loaded else 'compiled'
                self.get_logger().error(f'{function} is {done} while the node is active')
        elif not loaded:
            if not self._compiled:
                self.get_logger().info('compiling functions for this machine ...')
            self._compiled += 1

    def destroy_node(self) -> None:
        """Destroy the node, and end the report of compilations."""
        self._listening.__exit__(None, None, None)
        super().destroy_node()
