"""Write identified parameters to a ROS parameter file for plant and controller."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from math import isfinite
from pathlib import Path
from typing import Final

from needle_identification.errors import IdentificationError
from needle_identification.estimation.estimate import Statistic
from needle_identification.estimation.formatting import UNKNOWN
from needle_identification.friction.estimate import FrictionSummary
from needle_identification.stiffness.estimate import StiffnessSummary
from needle_ros.files import write_whole
import yaml

#: Nodes that use the result.
NODES: Final = ('plant', 'controller')


def model_parameters(statistics: Iterable[Statistic]) -> dict[str, float | str]:
    """
    Return identified constants of the model as parameters of plant and controller, in SI units.

    A mean outside the range of its parameter, by less than its error, is set to the limit.
    """
    # Imported here: the import of the model takes longer than all other imports together.
    from needle_dynamics import NeedleParameters

    constants = {item.name: item for item in fields(NeedleParameters) if 'unit' in item.metadata}
    values: dict[str, float | str] = {}
    for statistic in statistics:
        item = constants.get(statistic.name)
        if item is not None and isfinite(statistic.mean):
            low, high = item.metadata['low'], item.metadata['high']
            # More digits than the accuracy of any experiment.
            values[f'model.{item.name}'] = float(f'{min(max(statistic.mean, low), high):.7g}')
    if 'model.breakaway_friction' in values:
        values['model.friction_law'] = 'stribeck'
    return values


def result_yaml(
    friction: FrictionSummary | None, stiffness: StiffnessSummary | None = None
) -> str:
    """
    Return the text of a ROS parameter file with the identified parameters.

    The parameters apply to nodes named plant and controller in any namespace.

    Parameters
    ----------
    friction : FrictionSummary or None
        Friction over all recordings.
    stiffness : StiffnessSummary or None
        Stiffness over all recordings.

    Returns
    -------
    str
        YAML, with the errors and the recordings in comments.

    Raises
    ------
    IdentificationError
        If the data determine no parameter.

    Examples
    --------
    >>> from needle_identification import identify_friction, read_friction_recording
    >>> from needle_identification import result_yaml, summarize
    >>> estimate = identify_friction(read_friction_recording('bags/friction_01'))
    >>> text = result_yaml(summarize([estimate]))
    >>> print(text.partition('/**/controller')[2])
    :
      ros__parameters:
        model.coulomb_friction: 0.561...
        model.viscous_friction: 238.18...
    <BLANKLINE>

    """
    found = [
        *(friction.statistics if friction else ()),
        *([stiffness.tissue_stiffness] if stiffness else ()),
    ]
    names = [e.name for summary in (friction, stiffness) if summary for e in summary.estimates]
    lines = [
        '# Needle and tissue, identified by needle_identification.',
        *(f'# {_described(statistic)}' for statistic in found),
        *(f'# from {" ".join(name.split())}' for name in names),
    ]
    values = model_parameters(found)
    if not values:
        raise IdentificationError('the data determine no parameter of the model')
    sections = {f'/**/{node}': {'ros__parameters': dict(values)} for node in NODES}
    return '\n'.join([*lines, yaml.safe_dump(sections, sort_keys=False)])


def _described(statistic: Statistic) -> str:
    what = f'{statistic.symbol} ({statistic.name})'
    if not isfinite(statistic.mean):
        return f'{what} is {UNKNOWN}'
    scatter = '' if statistic.deviation is None else f', STD over bags {statistic.deviation:.4g}'
    unit = '' if statistic.unit == '1' else f' {statistic.unit}'
    return f'{what} = {statistic.mean:.6g}{unit}, SE {statistic.error:.2g}{scatter}'


def write_result(
    path: Path | str, friction: FrictionSummary | None, stiffness: StiffnessSummary | None = None
) -> None:
    """
    Write the parameters to a ROS parameter file, the text of `result_yaml`.

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
    ParameterError
        If the file cannot be written.

    """
    write_whole(path, result_yaml(friction, stiffness).encode())
