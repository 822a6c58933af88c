"""The result of identification as a ROS parameter file for plant and controller."""

from __future__ import annotations

from pathlib import Path

from needle_identification.errors import IdentificationError
from needle_identification.friction import FrictionSummary, Statistic


def result_yaml(summary: FrictionSummary) -> str:
    """
    Return a ROS parameter file with the identified friction.

    It applies to nodes named plant and controller in any namespace; a mean below zero, which
    can only be zero within its error, is written as zero.

    Parameters
    ----------
    summary : FrictionSummary
        What was identified.

    Returns
    -------
    str
        YAML, with the errors and the recordings in comments.

    """
    lines = [
        '# Needle/tissue friction, equation (15), identified by needle_identification.',
        f'# mu_s = {_described(summary.coulomb, "N")}',
        f'# mu_v = {_described(summary.viscous, "N s/m")}',
        *(f'# from {estimate.name}' for estimate in summary.estimates),
    ]
    for node in ('plant', 'controller'):
        lines += [
            f'/**/{node}:',
            '  ros__parameters:',
            f'    model.coulomb_friction: {max(summary.coulomb.mean, 0.0):.6f}',
            f'    model.viscous_friction: {max(summary.viscous.mean, 0.0):.6f}',
        ]
    return '\n'.join(lines) + '\n'


def _described(statistic: Statistic, unit: str) -> str:
    scatter = '' if statistic.deviation is None else f', STD over bags {statistic.deviation:.4g}'
    return f'{statistic.mean:.6g} {unit}, SE {statistic.error:.2g}{scatter}'


def write_result(path: Path, summary: FrictionSummary) -> None:
    """
    Write the parameter file; whoever reads it sees the old text or the new, never a part.

    Raises
    ------
    IdentificationError
        If the file cannot be written.

    """
    if not path.name or path.is_dir():
        raise IdentificationError(f'cannot write {path}: it is not the name of a file')
    draft = path.with_name(f'{path.name}.tmp')
    try:
        draft.write_text(result_yaml(summary), encoding='utf-8')
        draft.replace(path)
    except OSError as error:
        draft.unlink(missing_ok=True)
        raise IdentificationError(f'cannot write {path}: {error.strerror}') from error
