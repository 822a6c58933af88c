# SPDX-License-Identifier: Apache-2.0
"""Identification results as messages."""

from collections.abc import Mapping, Sequence

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from needle_identification.estimation.estimate import Statistic
from needle_identification.estimation.formatting import measured
from needle_identification.friction.estimate import FrictionEstimate, FrictionSummary
from needle_identification.stiffness.estimate import StiffnessEstimate, StiffnessSummary


def live_statuses(found: Sequence[Statistic], samples: int) -> list[DiagnosticStatus]:
    return [_of_statistic(one, samples=samples, source='live') for one in found]


def summary_statuses(summary: FrictionSummary | StiffnessSummary) -> list[DiagnosticStatus]:
    """Return one status per parameter and force level, then one per recording."""
    if isinstance(summary, FrictionSummary):
        samples = sum(one.samples for one in summary.estimates)
        statuses = [_of_statistic(one, samples=samples) for one in summary.statistics]
        return [*statuses, *map(_of_friction, summary.estimates)]
    statuses = [_of_statistic(summary.tissue_stiffness)]
    for level in summary.levels:
        at = f' at {level.force:.2f} N'
        statuses += [_of_statistic(one, level=at) for one in level.statistics]
    return [*statuses, *map(_of_stiffness, summary.estimates)]


def _of_statistic(
    one: Statistic, *, level: str = '', samples: int | None = None, source: str = 'recordings'
) -> DiagnosticStatus:
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
    status = _status(f'{one.name}{level}', message, values, source)
    status.level = DiagnosticStatus.OK if one.count else DiagnosticStatus.WARN
    return status


def _of_friction(estimate: FrictionEstimate) -> DiagnosticStatus:
    parameters = (*estimate.parameters, estimate.breakaway, estimate.lag)
    values = {
        **{p.name: measured(p.value, p.error, p.unit) for p in parameters if p is not None},
        'samples': estimate.samples,
        'residual': estimate.residual,
        'determination': estimate.determination,
        'condition': estimate.condition,
    }
    return _status(estimate.name, f'R^2 = {estimate.determination:.4f}', values)


def _of_stiffness(estimate: StiffnessEstimate) -> DiagnosticStatus:
    worst = min(level.determination for level in estimate.levels)
    values = {
        'presses': sum(level.presses for level in estimate.levels),
        'determination': worst,
        'condition': max(level.condition for level in estimate.levels),
        'off_plane': estimate.off_plane,
        **{f'at {level.force:.2f} N': level.words for level in estimate.levels},
    }
    return _status(estimate.name, f'R^2 >= {worst:.4f}', values)


def _status(
    name: str, message: str, values: Mapping[str, object], source: str = ''
) -> DiagnosticStatus:
    """Return a status, without values that are None."""
    return DiagnosticStatus(
        name=name,
        message=message,
        hardware_id=source,
        values=[KeyValue(key=k, value=str(v)) for k, v in values.items() if v is not None],
    )


def sentence(found: Sequence[Statistic]) -> str:
    """Format parameters in one line, such as ``mu_s = 0.5600 ± 0.0083 N, mu_v = ...``."""
    return ', '.join(f'{one.symbol} = {measured(one.mean, one.error, one.unit)}' for one in found)
