# SPDX-License-Identifier: Apache-2.0
"""Base class of nodes that declare the constants of the needle model as parameters."""

from collections.abc import Mapping
from typing import Any

from needle_dynamics.compiled_node import CompiledNode
from needle_dynamics.needles import find_needle, NEEDLE_HELP, usable_needle
from needle_dynamics.parameters import NeedleParameters, PAPER_NEEDLE
from needle_ros.parameter_node import ParameterNode
from rcl_interfaces.msg import ParameterDescriptor


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
