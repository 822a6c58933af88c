# SPDX-License-Identifier: Apache-2.0
"""Write identified parameters to a ROS parameter file for plant, controller and steering."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from math import atan2, hypot, isfinite, log, sqrt
from pathlib import Path
from typing import Final

from needle_identification.errors import IdentificationError
from needle_identification.estimation.estimate import (
    between,
    measured,
    ParameterEstimate,
    Statistic,
    suffix,
    UNKNOWN,
)
from needle_identification.friction.estimate import FrictionSummary
from needle_identification.sensor.identify import SensorEstimate
from needle_identification.steering.estimate import SteeringEstimate
from needle_identification.stiffness.identify import StiffnessSummary
from needle_ros.files import write_whole
from needle_ros.quantities import AXES
from needle_ros.settings import number_fields
import yaml

NODES: Final = ('plant', 'controller')  #: nodes that use the result

#: Limits of the path noise of a prior [rad^2/m]: a few recordings may have none by chance, and the
#: controller considers up to 100 times as much.
_PATH_NOISE: Final = (1e-6, 1e-4)

#: Standard deviation of the logarithm of the stiffness of a layer that is not determined to a
#: factor of 2.
_UNKNOWN_LAYER: Final = log(2.0)
_WIDTH: Final = 3.92  # width of a 95 % interval over the standard deviation


def model_parameters(statistics: Iterable[Statistic]) -> dict[str, float | str]:
    """Return identified constants of the model, within their ranges, as parameters of nodes."""
    found = list(_within_ranges(statistics))
    values: dict[str, float | str] = {f'model.{one.name}': _short(value) for one, value in found}
    if 'model.breakaway_friction' in values:
        values['model.friction_law'] = 'stribeck'
    return values


def constants_of(summary: FrictionSummary | StiffnessSummary) -> Sequence[Statistic]:
    """Return the statistics that a parameter file describes."""
    if isinstance(summary, FrictionSummary):
        return summary.statistics
    return (summary.tissue_stiffness,)


def limited(statistics: Iterable[Statistic]) -> list[str]:
    """Return a sentence for each constant that is outside its range and set to the limit."""
    return [
        f'{one.symbol} = {measured(one.mean, one.error, one.unit)} is outside the range of the '
        f'model: model.{one.name} is {value:g}'
        for one, value in _within_ranges(statistics)
        if value != one.mean
    ]


def _within_ranges(statistics: Iterable[Statistic]) -> Iterator[tuple[Statistic, float]]:
    """Yield the constants of the model with their values within their ranges."""
    # Imported here: the import of the model takes longer than all other imports together.
    from needle_dynamics import NeedleParameters

    constants = number_fields(NeedleParameters)
    for one in statistics:
        item = constants.get(one.name)
        if item is not None and isfinite(one.mean):
            yield one, min(max(one.mean, item.metadata['low']), item.metadata['high'])


def result_yaml(
    friction: FrictionSummary | None, stiffness: StiffnessSummary | None = None
) -> str:
    """Return the text of a ROS parameter file with the identified parameters."""
    summaries = [summary for summary in (friction, stiffness) if summary]
    found = [one for summary in summaries for one in constants_of(summary)]
    names = [e.name for summary in summaries for e in summary.estimates]
    values = model_parameters(found)
    if not values:
        raise IdentificationError('the data determine no parameter of the model')
    sources = [f'from {" ".join(name.split())}' for name in names]
    lines = [*map(_described, found), *limited(found), *sources]
    return _file('Needle and tissue', lines, dict.fromkeys(NODES, values))


def _file(title: str, lines: Sequence[str], nodes: Mapping[str, Mapping[str, object]]) -> str:
    """Return a ROS parameter file with comments, from the parameters of each node."""
    head = [f'# {line}' for line in (f'{title}, identified by needle_identification.', *lines)]
    # Copies of lists: ROS 2 reads no aliases.
    sections = {
        f'/**/{node}': {'ros__parameters': deepcopy(dict(own))}
        for node, own in nodes.items()
        if own
    }
    return '\n'.join([*head, yaml.safe_dump(sections, sort_keys=False)])


def _described(statistic: Statistic) -> str:
    what = f'{statistic.symbol} ({statistic.name})'
    if not isfinite(statistic.mean):
        return f'{what} is {UNKNOWN}'
    scatter = '' if statistic.deviation is None else f', STD over bags {statistic.deviation:.4g}'
    value = f'{statistic.mean:.6g}{suffix(statistic.unit)}'
    return f'{what} = {value}, SE {statistic.error:.2g}{scatter}'


def write_result(
    path: Path | str, friction: FrictionSummary | None, stiffness: StiffnessSummary | None = None
) -> None:
    """
    Write a ROS parameter file for plant and controller, with errors and recordings in comments.

    Parameters
    ----------
    path : Path or str
        File to write.
    friction : FrictionSummary or None
        Friction over all recordings.
    stiffness : StiffnessSummary or None
        Stiffness over all recordings.

    Raises
    ------
    IdentificationError
        If the data determine no parameter.

    """
    write_whole(path, result_yaml(friction, stiffness).encode())


def steering_yaml(found: SteeringEstimate, needle: str | None = None) -> str:
    """Return a ROS parameter file for plant, controller and steering node, errors as comments."""
    # `needle`: name of the nominal needle, or its file. Imported here for the same reason.
    from needle_dynamics.parameters import NeedleParameters, PAPER_NEEDLE
    from needle_dynamics.steering.parameters import tissue_of

    if len(found.media) > 1:
        raise IdentificationError(
            'a parameter file describes a single medium, got '
            f'{", ".join(medium.medium for medium in found.media)}'
        )
    (medium,) = found.media
    length, layers = medium['bending_length'], medium.layers
    if not any(one.determined for one in layers or (length,)):
        what = 'stiffness of any layer' if layers else 'bending length'
        raise IdentificationError(f'the data do not determine the {what}')
    # The data determine lengths, not forces: the bending stiffness is the nominal one.
    needle = needle or PAPER_NEEDLE
    nominal = found.tissue or NeedleParameters.preset(PAPER_NEEDLE)
    stiffness = nominal.bending_stiffness
    tissue = tissue_of(stiffness, length.value)
    lines = []
    for one in (found.free_length, *medium.parameters):
        known = f'SE {one.error:.2g}' if one.determined else UNKNOWN
        lines.append(f'{one.symbol} ({one.name}) = {one.value:.6g}{suffix(one.unit)}, {known}')
    lines.append(f'E I = {stiffness:g} N m^2 of the needle {needle}')
    if medium.held_out is not None:
        lines.append(
            f'error of predicted recordings {medium.held_out.rms:.3g} m, '
            f'{between(medium.held_out.interval)}'
        )
    lines.append(
        f'path noise {medium.path_noise:.3g} rad^2/m, noise of a reading {medium.noise:.3g} m'
    )
    low, high = _PATH_NOISE
    prior: dict[str, object] = {'prior.path_noise': _short(min(max(medium.path_noise, low), high))}
    # Also if they are not determined: the bending length is for these values.
    lengths: dict[str, object] = {
        'steering.free_length': _short(found.free_length.value),
        'steering.skin_stiffness': _short(medium['skin'].value * tissue),
    }
    steering = {'steered': True, **lengths}
    if 'bevel' in found.terms:
        z, x = (medium[f'curvature_{axis}'].value for axis in 'zx')
        steering['steering.bevel_load'] = [_short(hypot(x, z) * stiffness / length.value)]
        lines.append(f'the bevel pushes along z at a roll of {-atan2(x, z):.4g} rad')
    model: dict[str, object] = {'needle': needle, 'model.tissue_stiffness': _short(tissue)}
    if layers:
        model['model.layer_depths'] = list(nominal.layer_depths)
        pairs = zip(nominal.layer_stiffnesses, layers[1:], strict=True)
        model['model.layer_stiffnesses'] = [_short(k * one.value) for k, one in pairs]
        prior['prior.layer_spread'] = [_short(_layer_spread(one)) for one in layers]
    nodes = {
        'plant': {**model, **steering},
        'controller': model,
        'steering': {**model, **lengths, **prior},
    }
    return _file('Steered needle', lines, nodes)


def _layer_spread(layer: ParameterEstimate) -> float:
    """Return the standard deviation of the logarithm of the stiffness of a layer."""
    if not layer.determined:
        return _UNKNOWN_LAYER
    low, high = layer.interval
    return log(high / low) / _WIDTH


def sensor_yaml(found: SensorEstimate, measurement_time: float, *, delayed: bool) -> str:
    """Return a ROS parameter file for the tip sensor of the plant, and the priors of steering."""
    # `measurement_time`: duration of an averaged measurement [s]; `delayed`: the times of samples
    # are those of their messages, and so is the delay.
    lines = []
    for one in found.parameters:
        text = f'{one.value:.6g}{suffix(one.unit)}, {between(one.interval)}'
        lines.append(f'{one.symbol} ({one.name}) = {text if one.determined else UNKNOWN}')
    lines.append(f'from {" ".join(found.name.split())}, {found.samples} samples')
    noise, slow = found['noise'], found['slow_noise']
    plant: dict[str, float | list[float]] = {'tip.rate': float(f'{found.rate:.4g}')}
    names = ['slow_noise', 'slow_time', 'dropout', 'dropout_time']
    # Noise that is too small to be determined is next to nothing.
    plant['tip.noise'] = _short(noise.value) if noise.determined else 0.0
    plant |= {f'tip.{name}': _short(found[name].value) for name in names if found[name].determined}
    plant['tip.offset'] = [
        _short(found[f'bias_{axis}'].value) if axis in found.axes else 0.0 for axis in AXES
    ]
    delay = found['delay']
    if delayed and delay.determined:
        plant['tip.delay'] = _short(max(delay.value, 0.0))
    prior: dict[str, float] = {}
    if noise.determined:
        readings = max(found.samples / found.duration * measurement_time, 1.0)
        prior['prior.noise'] = _short(noise.value / sqrt(readings))
    if slow.determined:
        prior['prior.drift'] = _short(slow.value)
    return _file('Tip sensor', lines, {'plant': plant, 'steering': prior})


def _short(value: float) -> float:
    return float(f'{value:.7g}')
