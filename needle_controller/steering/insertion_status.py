# SPDX-License-Identifier: Apache-2.0
"""Status of a steered insertion: phase, law, expected tip and last measurement."""

from math import isfinite, nan
from typing import Final

from needle_controller.steering.insertion import SteppedInsertion
from needle_dynamics.arrays import FloatArray
from needle_ros.event_log import Severity
from needle_ros.status import SteeringPhase as Phase
from needle_ros.status import SteeringStatus
from needle_ros.system_state import Mode

#: Descriptions of the phases for the user.
_DESCRIPTIONS: Final = {
    Phase.IDLE: 'waits for a target',
    Phase.PLANNING: 'computes the plan',
    Phase.GUIDING: 'the guide moves',
    Phase.INSERTING: 'the needle is inserted',
    Phase.MEASURING: 'measures the tip',
    Phase.RETRACTING: 'the needle is being withdrawn',
}
_SCATTERED: Final = 3.0  #: Multiple of the configured noise of a measurement that is reported.


def describe(
    insertion: SteppedInsertion | None, goal: FloatArray, noise: float, *, active: bool
) -> SteeringStatus:
    """
    Return the status of an insertion, with its warning.

    ``goal`` are the goals of the joints [m, rad], ``noise`` is the configured noise of a tip
    measurement [m], and a law has no warning unless ``active``.
    """
    if insertion is None:
        return SteeringStatus()
    guarded = insertion.law
    report = guarded.report
    expected, measured = guarded.expected, guarded.measured
    x, z = report.target.tolist()
    _, guide_x, guide_z = goal[:3].tolist()
    warning = report.warning if active else ''
    if not warning and measured is not None and measured.error > _SCATTERED * noise:
        warning = (
            f'noise of the tip measurement is {1e3 * measured.error:.2f} mm, above the '
            f'configured {1e3 * noise:.2f} mm (prior.noise)'
        )
    values = dict(report.status)
    turns = values.pop('turns_left', nan)
    return SteeringStatus(
        target=(x, float(guarded.depths[-1]), z),
        step=min(guarded.step, guarded.steps),
        steps=guarded.steps,
        guide_setpoint=(guide_x, guide_z),
        turns_left=int(turns) if isfinite(turns) else None,
        hit_probability=values.pop('hit_probability', None),
        bending_length_ratio=values.pop('bending_length_ratio', None),
        law=values,
        expected_tip=tuple(expected.mean.tolist()) if expected else None,
        expected_tip_half_width=tuple(expected.half_width.tolist()) if expected else None,
        last_measurement_readings=measured and measured.readings,
        last_measurement_error=measured and measured.error,
        warning=warning,
    )


def summarize(
    status: SteeringStatus, insertion: SteppedInsertion | None, failure: str, advice: str
) -> tuple[Severity, str]:
    """
    Return severity and state in one line.

    It has the failure, such as a stop while nothing moves, or the advice, if not empty.
    """
    if status.phase is Phase.STOPPED:
        return Severity.ERROR, f'stopped: {status.fault}'
    if failure and status.phase in (Phase.IDLE, Phase.DONE):
        return Severity.ERROR, failure
    if status.warning:
        return Severity.WARNING, status.warning
    paused = '; paused' if status.system is Mode.PAUSED else ''
    if insertion is not None and status.phase is Phase.DONE:
        line, severity = insertion.law.outcome()
        return severity, f'done: {line}{paused}'
    words = _DESCRIPTIONS[status.phase]
    if status.planned_fraction is not None:
        return Severity.INFO, f'{words}: {status.planned_fraction:.0%}'
    return Severity.INFO, f'{words}{paused}{advice if status.phase is Phase.IDLE else ""}'
