"""ROS parameter file of an identified steered needle."""

from __future__ import annotations

from math import atan2, hypot, isfinite
from typing import Final

from needle_dynamics.parameters import DEFAULT_PRESET, NeedleParameters
from needle_dynamics.steering.parameters import tissue_of
from needle_identification.errors import IdentificationError
from needle_identification.estimation.formatting import UNKNOWN
from needle_identification.steering.estimate import SteeringEstimate
import yaml

#: Written digits, above the accuracy of experiments.
_DIGITS: Final = '.7g'


def steering_yaml(found: SteeringEstimate) -> str:
    """
    Return a ROS parameter file for plant, controller and steering node, errors as comments.

    The data determine lengths, not forces: the bending stiffness is the default.
    """
    if len(found.media) > 1:
        raise IdentificationError(
            'a parameter file describes a single medium, got '
            f'{", ".join(medium.medium for medium in found.media)}'
        )
    (medium,) = found.media
    length = medium['bending_length']
    if not length.determined:
        raise IdentificationError('the data do not determine the bending length')
    stiffness = NeedleParameters.preset(DEFAULT_PRESET).bending_stiffness
    tissue = tissue_of(stiffness, length.value)
    lines = ['# Steered needle, identified by needle_identification.']
    for one in (found.free_length, *medium.parameters):
        unit = '' if one.unit == '1' else f' {one.unit}'
        value = f'{one.value:.6g}{unit}, SE {one.error:.2g}' if one.determined else UNKNOWN
        lines.append(f'# {one.symbol} ({one.name}) = {value}')
    lines.append(f'# E I = {stiffness:g} N m^2 of the preset {DEFAULT_PRESET}')
    lengths: dict[str, object] = {}
    if found.free_length.determined and isfinite(found.free_length.value):
        lengths['steering.free_length'] = _short(found.free_length.value)
    if medium['skin'].determined:
        lengths['steering.skin_stiffness'] = _short(max(0.0, medium['skin'].value) * tissue)
    steering = {'steered': True, **lengths}
    if 'bevel' in found.terms:
        z, x = (medium[f'curvature_{axis}'].value for axis in 'zx')
        steering['steering.bevel_load'] = [_short(hypot(x, z) * stiffness / length.value)]
        lines.append(f'# the bevel pushes along z at a roll of {-atan2(x, z):.4g} rad')
    model = {'model.preset': DEFAULT_PRESET, 'model.tissue_stiffness': _short(tissue)}
    sections = {
        '/**/plant': {'ros__parameters': {**model, **steering}},
        '/**/controller': {'ros__parameters': model},
        '/**/steering': {'ros__parameters': {**model, **lengths}},
    }
    return '\n'.join([*lines, yaml.safe_dump(sections, sort_keys=False)])


def _short(value: float) -> float:
    return float(format(value, _DIGITS))
