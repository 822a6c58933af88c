# SPDX-License-Identifier: Apache-2.0
"""Needle, tissue and limits for the page, from the configurations of the nodes."""

from collections.abc import Mapping
from math import isfinite
from typing import Any, Final

from needle_ros.documents import DocumentError, read_document

#: Nodes whose configurations are read; needle and tissue are of the first available node.
CONFIGURED: Final = ('plant', 'steering', 'controller')

#: Parameters of the limits of the controller, by their names on the page.
_LIMITS: Final = {
    'force': 'force_limit',
    'load': 'safety.axial_load',
    'speed': 'safety.speed',
    'error': 'safety.tracking_error',
    'deflection': 'safety.tip_deflection',
}


def parameters_of(text: str) -> dict[str, Any]:
    """Return the parameters in a configuration (parameter file of one node); {} if invalid."""
    try:
        document = read_document(text)
        (content,) = document.values()
        return {str(name): value for name, value in content['ros__parameters'].items()}
    except (DocumentError, AttributeError, KeyError, TypeError, ValueError):
        return {}


def scene(configurations: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """
    Return needle, tissue and limits for the page from the parameters of nodes, by node name.

    ``tissue`` or None: source node ``of``, ``length``, ``free`` length, ``layers`` (depth,
    stiffness) and ``membranes`` (depth, strength). ``limits``: force, load, speed, error,
    deflection, depths ``low`` and ``high``. ``steered``: whether a node aims the tip. SI units.
    """
    whose = next((name for name in CONFIGURED if name in configurations), None)
    return {
        'tissue': None if whose is None else _tissue(whose, configurations[whose]),
        'limits': _limits(configurations.get('controller', {})),
        'steered': 'steering' in configurations,
    }


def _number(parameters: Mapping[str, Any], name: str) -> float | None:
    value = parameters.get(name)
    real = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if real and isfinite(value) else None  # type: ignore[arg-type]


def _numbers(parameters: Mapping[str, Any], name: str) -> list[float]:
    values = parameters.get(name)
    values = values if isinstance(values, list) else []
    return [float(v) for v in values if isinstance(v, (int, float)) and isfinite(v)]


def _tissue(whose: str, parameters: Mapping[str, Any]) -> dict[str, Any]:
    depths = [0.0, *_numbers(parameters, 'model.layer_depths')]
    first = _number(parameters, 'model.tissue_stiffness') or 0.0
    stiffnesses = [first, *_numbers(parameters, 'model.layer_stiffnesses')]
    membranes = zip(
        _numbers(parameters, 'steering.membrane_depths'),
        _numbers(parameters, 'steering.membrane_strengths'),
        strict=False,
    )
    # All nodes have the parameter free length; it is valid for a steered needle only.
    steered = whose == 'steering' or parameters.get('steered') is True
    return {
        'of': whose,
        'length': _number(parameters, 'model.length'),
        'free': _number(parameters, 'steering.free_length') if steered else None,
        'layers': [list(layer) for layer in zip(depths, stiffnesses, strict=False)],
        'membranes': [list(one) for one in membranes] if steered else [],
    }


def _limits(parameters: Mapping[str, Any]) -> dict[str, float]:
    found = {name: _number(parameters, of) for name, of in _LIMITS.items()}
    # As in the controller: limited to the range of the needle.
    for name, of, model, choose in (
        ('low', 'lowest_depth', 'model.minimum_depth', max),
        ('high', 'highest_depth', 'model.length', min),
    ):
        both = [_number(parameters, of), _number(parameters, model)]
        known = [value for value in both if value is not None]
        found[name] = choose(known) if known else None
    return {name: value for name, value in found.items() if value is not None}
