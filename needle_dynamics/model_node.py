# SPDX-License-Identifier: Apache-2.0
"""Base classes of nodes that call compiled functions, and that have the needle model."""

from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from typing import Any, ClassVar

from needle_dynamics.compiled.cache import other_compilations, prepare, reports, where_kept
from needle_dynamics.needles import find_needle, NEEDLE_HELP, usable_needle
from needle_dynamics.parameters import NeedleParameters, PAPER_NEEDLE
from needle_ros.base_node import BaseNode
from needle_ros.life_cycle_node import imports, PreparationProgress
from needle_ros.parameter_node import ParameterNode
from rcl_interfaces.msg import ParameterDescriptor


class CompiledNode(BaseNode):
    """
    Node that loads or compiles its kernels before it is configured.

    Compiling or loading a function while the node is active is an error and is logged as such,
    because messages wait during that time.
    """

    #: Modules that numba imports at the conversion of the first array.
    IMPORTS = ('numba.core.boxing', 'numba.core.runtime.context')
    #: Kernels that the node can call in any mode and with any parameters: modules or
    #: ``module:kernel``.
    KERNELS: ClassVar[tuple[str, ...]] = ()

    def __init__(self, name: str, **node_options: Any) -> None:
        self._compiled = 0
        #: Functions that were compiled or loaded while the node was active.
        self.late: list[str] = []
        super().__init__(name, **node_options)
        self._listening = ExitStack()
        self._listening.enter_context(reports(self._on_function))

    def preparation(self) -> Iterable[PreparationProgress]:
        """Import modules, then load or compile kernels."""
        yield from imports(self.IMPORTS)
        self._listening.enter_context(other_compilations(self._on_other_function))
        for step in prepare(self.KERNELS):
            yield PreparationProgress(*step)
        if self._compiled:
            self.get_logger().info(f'{self._compiled} functions compiled: {where_kept()}')

    def _on_function(self, function: str, loaded: bool, prepared: bool) -> None:
        if self.is_active:
            # Another node of this process may be preparing now.
            if not prepared:
                self.late.append(function)
                done = 'loaded' if loaded else 'compiled'
                self.get_logger().error(f'{function} is {done} while the node is active')
        elif not loaded:
            if not self._compiled:
                self.get_logger().info('compiling functions for this machine ...')
            self._compiled += 1

    def _on_other_function(self, function: str, loaded: bool, prepared: bool) -> None:
        """Report a function of the user; before activation Numba compiles its own, too."""
        if self.is_active:
            self._on_function(function, loaded, prepared)

    def destroy_node(self) -> None:
        """Destroy the node and stop listening to compilations."""
        self._listening.close()
        super().destroy_node()


def declare_needle(node: ParameterNode, default: str) -> str:
    """Declare the parameter ``needle`` of a node, and return its value if usable."""
    # Read-only: the defaults of the other parameters depend on it.
    meaning = ParameterDescriptor(
        description=NEEDLE_HELP, additional_constraints=NEEDLE_HELP, read_only=True
    )
    node.declare_parameter('needle', default, meaning)
    return usable_needle(node.text('needle'))


class ModelNode(CompiledNode):
    """Node whose parameters ``model.*`` are the constants of needle and tissue."""

    def declare_model(self) -> None:
        """Declare ``needle`` and, with its constants as defaults, every model constant."""
        self.declare_settings('model.', find_needle(declare_needle(self, PAPER_NEEDLE)).needle)

    def model_parameters(self, changes: Mapping[str, Any] | None = None) -> NeedleParameters:
        """Read the model constants; ``changes`` overrides parameters by name."""
        find_needle(self.text('needle'))
        return self.settings('model.', NeedleParameters, changes)
