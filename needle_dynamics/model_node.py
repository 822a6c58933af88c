"""Base class of the nodes that hold the constants of the needle model as parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from needle_dynamics.compiled_node import CompiledNode
from needle_dynamics.parameters import DEFAULT_PRESET, NeedleParameters
from needle_dynamics.steering.parameters import NEEDLES
from rcl_interfaces.msg import ParameterDescriptor


class ModelNode(CompiledNode):
    """A node whose parameters ``model.*`` are the constants of the needle and its tissue."""

    def declare_model(self) -> None:
        """Declare ``model.preset`` and, with its values as defaults, every model constant."""
        # Fixed at start: the other defaults follow from it.
        self.declare_parameter(
            'model.preset',
            DEFAULT_PRESET,
            ParameterDescriptor(description=f'one of {", ".join(NEEDLES)}', read_only=True),
        )
        preset = self.get_parameter('model.preset').value
        self.declare_settings('model.', NEEDLES.get(preset, NeedleParameters()))

    def model_parameters(self, changes: Mapping[str, Any] | None = None) -> NeedleParameters:
        """
        Read the model constants.

        Parameters
        ----------
        changes : Mapping[str, Any], optional
            Values to take instead of the parameters' own, by parameter name.

        Returns
        -------
        NeedleParameters
            The constants.

        Raises
        ------
        ParameterError
            If a constant is not valid; the message names the parameter.

        """
        self.text('model.preset', tuple(NEEDLES))
        return self.settings('model.', NeedleParameters, changes)
