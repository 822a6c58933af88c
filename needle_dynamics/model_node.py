"""Base class of nodes that declare the constants of the needle model as parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from needle_dynamics.compiled_node import CompiledNode
from needle_dynamics.parameters import DEFAULT_PRESET, NeedleParameters
from needle_dynamics.steering.parameters import NEEDLES
from rcl_interfaces.msg import ParameterDescriptor


class ModelNode(CompiledNode):
    """Node whose parameters ``model.*`` are the constants of needle and tissue."""

    def declare_model(self) -> None:
        """Declare ``model.preset`` and, with the defaults of the preset, every model constant."""
        # Read-only: the defaults of the other parameters depend on it.
        self.declare_parameter(
            'model.preset',
            DEFAULT_PRESET,
            ParameterDescriptor(description=f'one of {", ".join(NEEDLES)}', read_only=True),
        )
        preset = self.get_parameter('model.preset').value
        self.declare_settings('model.', NEEDLES.get(preset, NeedleParameters()))

    def model_parameters(self, changes: Mapping[str, Any] | None = None) -> NeedleParameters:
        """Read the model constants; ``changes`` overrides parameters by name."""
        self.text('model.preset', tuple(NEEDLES))
        return self.settings('model.', NeedleParameters, changes)
