"""Friction of one recording."""

from __future__ import annotations

from dataclasses import dataclass

from needle_dynamics.arrays import BoolArray, FloatArray
from needle_identification.estimation.estimate import Named, ParameterEstimate
from needle_identification.estimation.formatting import measured
from needle_identification.estimation.residual_tests import ResidualTest
from needle_identification.friction.comparison import Comparison
from needle_identification.friction.punctures import Puncture


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Fit:
    """
    Filtered signals and fitted force, for plots; shape (n,) each.

    Attributes
    ----------
    time : ndarray
        Even time on the clock of the recording [s].
    speed : ndarray
        Filtered speed [m/s], delayed by the lag of the force.
    force, model : ndarray
        Filtered and fitted force [N]; the fitted one is nan where the sample was not used.
    used : ndarray of bool
        Whether the sample was used.

    """

    time: FloatArray
    speed: FloatArray
    force: FloatArray
    model: FloatArray
    used: BoolArray

    def __repr__(self) -> str:
        return f'<Fit: {self.used.sum()} of {len(self.time)} samples used>'


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class FrictionEstimate(Named[ParameterEstimate]):
    """
    Friction of one recording.

    Attributes
    ----------
    name : str
        The recording.
    terms : tuple of str
        Terms of the force.
    estimator : str
        Estimator.
    parameters : tuple of ParameterEstimate
        Coefficients of the terms, then ratios that follow from them: ``withdrawal_friction``
        (friction on withdrawal over friction on insertion, at the mean speed) and
        ``breakaway_friction`` (friction at rest over mu_s). ``estimate[name]`` gives one.
    breakaway : ParameterEstimate or None
        Force at which the needle began to move after rests with a rising force [N], without the
        offset if that is a term; None if there is no such rest.
    lag : ParameterEstimate or None
        Lag of the force behind the motion [s]; it was corrected. Not determined where the speed
        only jumps. A mass m beside viscous friction reduces it by m / mu_v. None if inertia is a
        term, which looks like a lag, or if only positions were recorded.
    punctures : tuple of Puncture
        Where the force dropped while the needle went into new tissue.
    samples : int
        Number of samples used.
    residual : float
        Root mean square of the residual of the filtered force [N].
    determination : float
        Coefficient of determination R^2.
    condition : float
        Condition number of the regressors, each scaled to unit norm.
    tests : tuple of ResidualTest
        Tests of the residuals.
    comparison : tuple of Comparison
        Whether the data support one term more, or one less.
    warnings : tuple of str
        What to know before using the numbers, in words.
    fit : Fit
        Signals for plots.

    """

    name: str
    terms: tuple[str, ...]
    estimator: str
    parameters: tuple[ParameterEstimate, ...]
    breakaway: ParameterEstimate | None
    lag: ParameterEstimate | None
    punctures: tuple[Puncture, ...]
    samples: int
    residual: float
    determination: float
    condition: float
    tests: tuple[ResidualTest, ...]
    comparison: tuple[Comparison, ...]
    warnings: tuple[str, ...]
    fit: Fit

    def _named(self) -> tuple[ParameterEstimate, ...]:
        return self.parameters

    def __repr__(self) -> str:
        found = ', '.join(
            f'{p.symbol} = {measured(p.value, p.error, p.unit)}' for p in self.parameters
        )
        return f'<FrictionEstimate of {self.name}: {found}>'
