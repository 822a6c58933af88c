"""What the nodes say of needle, tissue and limits in their configurations."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any, Final

from needle_ros.documents import DocumentError, read_document

#: Nodes that know needle and tissue; the first there is counts, since a plant is what it says.
_KNOWING: Final = ('plant', 'steering', 'controller')

#: Nodes whose configurations are read.
CONFIGURED: Final = _KNOWING

#: Limits of the controller, by the name that the page has for them.
_LIMITS: Final = {
    'force': 'force_limit',
    'load': 'safety.axial_load',
    'speed': 'safety.speed',
    'error': 'safety.tracking_error',
    'deflection': 'safety.tip_deflection',
}


def parameters_of(text: str) -> dict[str, Any]:
    """
    Return the parameters that a node has published as its configuration.

    Parameters
    ----------
    text : str
        A parameter file with one node.

    Returns
    -------
    dict
        Values by name; empty if the text is something else.

    """
    try:
        document = read_document(text)
        (content,) = document.values()
        return {str(name): value for name, value in content['ros__parameters'].items()}
    except (DocumentError, AttributeError, KeyError, TypeError, ValueError):
        return {}


def scene(configurations: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """
    Return what the page needs to know of needle, tissue and limits.

    Parameters
    ----------
    configurations : mapping
        Parameters of nodes, by name of the node.

    Returns
    -------
    dict
        ``tissue``: whose configuration it is (``of``), ``length`` of the needle, ``free`` length
        between guide and skin [m], ``layers`` (depth [m] and stiffness [N/m^2] of each) and
        ``membranes`` (depth [m] and strength [N]); None if no node has told. ``limits``: of
        force, load [N], speed [m/s], error, deflection and the depths ``low`` and ``high`` [m],
        as far as the controller has told. ``steered``: whether a node aims the tip.

    """
    whose = next((name for name in _KNOWING if name in configurations), None)
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
    if not isinstance(values, list):
        return []
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
    # Every node knows the free length; only that of a needle that is steered means anything.
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
    # As the controller has them: within what the needle has.
    for name, of, model, choose in (
        ('low', 'lowest_depth', 'model.minimum_depth', max),
        ('high', 'highest_depth', 'model.length', min),
    ):
        both = [_number(parameters, of), _number(parameters, model)]
        known = [value for value in both if value is not None]
        found[name] = choose(known) if known else None
    return {name: value for name, value in found.items() if value is not None}
