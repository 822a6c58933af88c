"""The result of identification as a ROS parameter file for plant and controller."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import fields
from math import floor, inf, isfinite, log10
import os
from pathlib import Path
from typing import Final

from needle_dynamics import (
    NeedleParameters,
)
from needle_identification.errors import IdentificationError
from needle_identification.estimation.estimate import Statistic
from needle_identification.friction.fit import FrictionSummary
from needle_identification.stiffness.fit import StiffnessSummary
from needle_ros.errors import (
    ParameterError,
)
import yaml

#: What is said of a parameter that the data do not determine.
UNKNOWN: Final = 'not determined by the data'

#: Smaller errors are not written out in digits.
_LEAST_ERROR: Final = 1e-9

#: Nodes that take the result.
NODES: Final = ('plant', 'controller')

#: Constants of the model that are numbers, by name.
_CONSTANTS: Final = {
    item.name: item for item in fields(NeedleParameters) if 'unit' in item.metadata
}


def model_parameters(statistics: Iterable[Statistic]) -> dict[str, float | str]:
    """
    Return what was identified as parameters of the nodes plant and controller.

    A mean outside the range of its parameter, which can only be within its error of the range's
    end, is moved to that end. What the data do not determine is left out.

    Parameters
    ----------
    statistics : iterable of Statistic
        What was identified; what is no constant of the model is left out.

    Returns
    -------
    dict
        Values [SI] by name, such as ``model.coulomb_friction``.

    """
    values: dict[str, float | str] = {}
    for statistic in statistics:
        item = _CONSTANTS.get(statistic.name)
        if item is not None and isfinite(statistic.mean):
            low, high = item.metadata['low'], item.metadata['high']
            # More digits than any experiment gives.
            values[f'model.{item.name}'] = float(f'{min(max(statistic.mean, low), high):.7g}')
    if 'model.breakaway_friction' in values:
        values['model.friction_law'] = 'stribeck'
    return values


def result_yaml(
    friction: FrictionSummary | None, stiffness: StiffnessSummary | None = None
) -> str:
    """
    Return a ROS parameter file with what was identified.

    It applies to nodes named plant and controller in any namespace.

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
        If the data determine nothing.

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
    path: Path, friction: FrictionSummary | None, stiffness: StiffnessSummary | None = None
) -> None:
    """
    Write the parameter file of `result_yaml`.

    Raises
    ------
    ParameterError
        If the file cannot be written.

    """
    write_whole(path, result_yaml(friction, stiffness).encode())


def write_whole(path: Path, content: bytes) -> None:
    """
    Write a file so that whoever reads it sees the old content or the new, never a part.

    Parameters
    ----------
    path : Path
        File to write.
    content : bytes
        All of it.

    Raises
    ------
    ParameterError
        If it cannot be written.

    """
    if not path.name or path.is_dir():
        raise ParameterError(f'{path} cannot be written: it is not the name of a file')
    draft = path.with_name(f'{path.name}.{os.getpid()}.tmp')
    try:
        draft.write_bytes(content)
        draft.replace(path)
    except OSError as error:
        with suppress(OSError):
            draft.unlink()
        raise ParameterError(f'{path} cannot be written: {error.strerror}') from error


def measured(value: float, error: float, unit: str = '') -> str:
    """
    Return a value with its error, to the digits that the error leaves it.

    Parameters
    ----------
    value, error : float
        Estimate and standard error, or half of an interval.
    unit : str
        Unit of both.

    Returns
    -------
    str
        Such as ``0.5604 ± 0.0005 N``.

    """
    if not isfinite(value):
        return UNKNOWN
    form = _form(error)
    reach = f' ± {error:{form if form.endswith("f") else ".2g"}}' if isfinite(error) else ''
    return f'{value:{form}}{reach}{_after(unit)}'


def rounded(value: float, error: float, unit: str = '') -> str:
    """Return a value to the digits that its error leaves it."""
    return f'{value:{_form(error)}}{_after(unit)}' if isfinite(value) else UNKNOWN


def spread(deviation: float, unit: str = '') -> str:
    """Return a standard deviation to three digits."""
    return rounded(deviation, 0.1 * deviation, unit)


def between(interval: tuple[float, float]) -> str:
    """Return an interval, to the digits that its width leaves it."""
    low, high = interval
    if not (isfinite(low) and isfinite(high)):
        return UNKNOWN
    form = _form((high - low) / 4.0)
    return f'{low:{form}} to {high:{form}}'


def _form(error: float) -> str:
    """Return the format that leaves two digits of the error."""
    if not _LEAST_ERROR < error < inf:
        return '.6g'
    return f'.{max(1 - floor(log10(error)), 0)}f'


def _after(unit: str) -> str:
    return '' if unit in ('', '1') else f' {unit}'
