"""Results as named values, as /diagnostics has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from needle_identification.estimation.estimate import Statistic
from needle_identification.estimation.formatting import measured
from needle_identification.friction.estimate import FrictionEstimate
from needle_identification.friction.summary import FrictionSummary
from needle_identification.stiffness.estimate import StiffnessEstimate
from needle_identification.stiffness.summary import StiffnessSummary


class Status(NamedTuple):
    """
    A result in words and values.

    Attributes
    ----------
    name : str
        Parameter or recording.
    message : str
        The result in words.
    values : mapping
        Values by name; None for one that does not apply.
    is_determined : bool
        Whether the data determine it.
    source : str
        Where it comes from: ``recordings`` or ``live``.

    """

    name: str
    message: str
    values: Mapping[str, object]
    is_determined: bool = True
    source: str = ''


def of_statistic(
    one: Statistic, *, level: str = '', samples: int | None = None, source: str = 'recordings'
) -> Status:
    """
    Report a parameter.

    Parameters
    ----------
    one : Statistic
        The parameter.
    level : str
        Force level of a stiffness; follows the name.
    samples : int, optional
        Number of samples it comes from.
    source : str
        ``recordings`` or ``live``.

    Returns
    -------
    Status
        Estimate, interval, unit and numbers of recordings and samples.

    """
    values = {
        'estimate': one.mean,
        'interval_low': one.interval[0],
        'interval_high': one.interval[1],
        'unit': one.unit,
        'standard_error': one.error,
        'standard_deviation': one.deviation,
        'recordings': one.count,
        'samples': samples,
    }
    message = measured(one.mean, one.error, one.unit)
    return Status(f'{one.name}{level}', message, values, one.count > 0, source)


def of_friction(summary: FrictionSummary) -> list[Status]:
    """
    Report the friction over recordings.

    Parameters
    ----------
    summary : FrictionSummary
        The friction.

    Returns
    -------
    list of Status
        One per parameter, then one per recording.

    """
    samples = sum(one.samples for one in summary.estimates)
    return [
        *(of_statistic(one, samples=samples) for one in summary.statistics),
        *map(_of_friction_estimate, summary.estimates),
    ]


def _of_friction_estimate(estimate: FrictionEstimate) -> Status:
    others = (one for one in (estimate.breakaway, estimate.lag) if one is not None)
    values = {
        **{
            one.name: measured(one.value, one.error, one.unit)
            for one in (*estimate.parameters, *others)
        },
        'samples': estimate.samples,
        'residual': estimate.residual,
        'determination': estimate.determination,
        'condition': estimate.condition,
    }
    return Status(estimate.name, f'R^2 = {estimate.determination:.4f}', values)


def of_stiffness(summary: StiffnessSummary) -> list[Status]:
    """
    Report the stiffness over places.

    Parameters
    ----------
    summary : StiffnessSummary
        The stiffness.

    Returns
    -------
    list of Status
        k_a, then one per entry and force level, then one per recording.

    """
    return [
        of_statistic(summary.tissue_stiffness),
        *(
            of_statistic(one, level=f' at {level.force:.2f} N')
            for level in summary.levels
            for one in level.statistics
        ),
        *map(_of_stiffness_estimate, summary.estimates),
    ]


def _of_stiffness_estimate(estimate: StiffnessEstimate) -> Status:
    worst = min(level.determination for level in estimate.levels)
    values = {
        'presses': sum(level.presses for level in estimate.levels),
        'determination': worst,
        'condition': max(level.condition for level in estimate.levels),
        'off_plane': estimate.off_plane,
        **{f'at {level.force:.2f} N': level.words for level in estimate.levels},
    }
    return Status(estimate.name, f'R^2 >= {worst:.4f}', values)


def sentence(found: Sequence[Statistic]) -> str:
    """
    Write parameters in one line.

    Parameters
    ----------
    found : sequence of Statistic
        Parameters.

    Returns
    -------
    str
        Such as ``mu_s = 0.5600 ± 0.0083 N, mu_v = 300.0 ± 9.9 N s/m``.

    """
    return ', '.join(f'{one.symbol} = {measured(one.mean, one.error, one.unit)}' for one in found)
