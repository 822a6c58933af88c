# SPDX-License-Identifier: Apache-2.0
"""Checks of a steering law, which may be code of the user, for the node and for simulations."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from math import inf, isfinite
from reprlib import repr as shortened
from typing import Final, NamedTuple

from needle_controller.steering.law import (
    checked_tip,
    failed_law,
    GuideSetpoint,
    law_name,
    SteeringFaultError,
    SteeringLaw,
    TipEstimate,
)
from needle_controller.steering.settings import SteeringLimits
from needle_dynamics.arrays import FloatArray
from needle_ros.errors import NeedleError

_ROUNDING: Final = 1e-6  #: Tolerance of a setpoint beyond its limit [m].


class LawReport(NamedTuple):
    """Members of a law after a measurement, a plan or a change of its target."""

    target: FloatArray  #: x and z [m]
    warning: str
    status: Mapping[str, float]


@contextmanager
def guarded(law: SteeringLaw) -> Iterator[None]:
    """Convert any exception of a law to a `LawError`, also a `SystemExit`."""
    try:
        yield
    except NeedleError:
        raise
    except (Exception, SystemExit) as error:
        raise failed_law(law, repr(error)) from error


def report_of(law: SteeringLaw) -> LawReport:
    """Return target, warning and status of a law."""
    with guarded(law):
        status = {name: float(value) for name, value in law.status().items()}
        return LawReport(checked_tip(law.target, 'the target of a law'), law.warning, status)


def expected_of(law: SteeringLaw) -> TipEstimate | None:
    """Return the tip at the last depth as predicted by a law."""
    with guarded(law):
        found = law.expected()
    if found is not None and not isinstance(found, TipEstimate):
        raise failed_law(
            law, f'expected must return a TipEstimate or None, got {shortened(found)}'
        )
    return found


class CheckedPlans:
    """
    Plan the steps of a law, and check each setpoint.

    Parameters
    ----------
    law : SteeringLaw
        Law to plan with, before its first plan.
    steps : int
        Number of its steps.
    limits : SteeringLimits, optional
        Limits of guide and turns; without them only the form of a setpoint is checked.
    roll : float, optional
        Roll of the needle at the start [rad], by default that of the first setpoint.

    """

    def __init__(
        self,
        law: SteeringLaw,
        steps: int,
        limits: SteeringLimits | None,
        roll: float | None = None,
    ) -> None:
        self._law, self._steps, self._limits, self._roll = law, steps, limits, roll
        self.step = 0  #: number of plans so far
        self.turns = 0  #: number of turns of the needle so far
        self.setpoint = GuideSetpoint(0.0, 0.0, roll or 0.0)  #: last setpoint of guide and roll

    def plan(self) -> GuideSetpoint:
        """Plan the next step; raise `SteeringFaultError` for a setpoint outside the limits."""
        law, after = self._law, self.step + 1
        with guarded(law):
            found = law.plan()
            step = law.step
        try:
            to = GuideSetpoint(*map(float, found))
        except (TypeError, ValueError) as error:
            said = f'plan must return a GuideSetpoint, got {shortened(found)}'
            raise failed_law(law, said) from error
        if after <= self._steps and step != after:
            raise failed_law(law, f'step must be {after} after plan {after}, got {step!r}')
        if self._roll is None:
            self._roll = to.roll
        self.turns += to.roll != self._roll
        self._check(to)
        self.step, self.setpoint, self._roll = after, to, to.roll
        return to

    def _check(self, to: GuideSetpoint) -> None:
        limits, before, name = self._limits, self.setpoint, law_name(self._law)
        limit = inf if limits is None else limits.guide_limit
        # False for nan.
        if not (max(abs(to.x), abs(to.z)) <= limit + _ROUNDING and all(map(isfinite, to))):
            raise SteeringFaultError(
                f'the steering law {name} requests the guide at x = {1e3 * to.x:.3f} mm, z = '
                f'{1e3 * to.z:.3f} mm and a roll of {to.roll:.3f} rad; the limit is '
                f'{1e3 * limit:g} mm'
            )
        if limits is None:
            return
        widest = limits.guide_step + _ROUNDING
        change = max(abs(to.x - before.x), abs(to.z - before.z))
        if change > widest:
            raise SteeringFaultError(
                f'the steering law {name} requests a guide motion of {1e3 * change:.3f} mm in a '
                f'step, at most {1e3 * widest:.3f} mm are possible'
            )
        if self.turns > limits.turns:
            raise SteeringFaultError(
                f'the steering law {name} requests turn {self.turns} of the needle, to a roll of '
                f'{to.roll:.3f} rad; turns is {limits.turns}'
            )
