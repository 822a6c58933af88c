# SPDX-License-Identifier: Apache-2.0
"""Friction estimate of a recording, and summary over several recordings, as in Table 1."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import log
from sys import float_info

from needle_dynamics.arrays import BoolArray, FloatArray
from needle_dynamics.display import Displayed
from needle_identification.errors import IdentificationError
from needle_identification.estimation.estimate import (
    DisplayedEstimate,
    EstimateRows,
    named,
    ParameterEstimate,
    Statistic,
    statistic,
)
from needle_identification.estimation.prediction import Moments, predicted, RecordingPrediction
from needle_identification.estimation.residual_tests import ResidualTest
from needle_identification.friction.comparison import CandidateFit, SIGNIFICANCE
from needle_identification.friction.punctures import Puncture
from scipy.special import chdtrc


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Fit(Displayed):
    """Filtered signals and fitted force, for plots; shape (n,) each."""

    time: FloatArray  #: evenly spaced, on the clock of the recording [s]
    velocity: FloatArray  #: filtered [m/s], delayed by the lag of the force
    force: FloatArray  #: filtered [N]
    model: FloatArray  #: fitted force [N]; nan for samples that were not used
    used: BoolArray  #: whether the sample was used
    moments: Moments  #: for the prediction of other recordings

    def __repr__(self) -> str:
        return f'<Fit: {self.used.sum()} of {len(self.time)} samples used>'

    def columns(self) -> dict[str, FloatArray]:
        return {
            'time [s]': self.time,
            'velocity [m/s]': self.velocity,
            'force_measured [N]': self.force,
            'force_fitted [N]': self.model,
        }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class FrictionEstimate(DisplayedEstimate):
    """Friction estimate of a recording; ``estimate[name]`` is a parameter."""

    name: str  #: name of the recording
    terms: tuple[str, ...]  #: terms of the force
    estimator: str  #: one of `ESTIMATORS`
    #: Coefficients of the terms, then derived ratios: ``withdrawal_friction`` (friction on
    #: withdrawal over friction on insertion, at the mean speed) and ``breakaway_friction``
    #: (friction at rest over mu_s).
    parameters: tuple[ParameterEstimate, ...]
    #: Force at which the needle began to move after rests with a rising force [N], without the
    #: offset if that is a term; None if there is no such rest.
    breakaway: ParameterEstimate | None
    #: Corrected lag of the force behind the motion [s]. Not determined if the velocity changes
    #: only in steps. An unmodeled mass m reduces it by m / mu_v. None if inertia is a term, which
    #: resembles a lag, or if only positions were recorded.
    lag: ParameterEstimate | None
    punctures: tuple[Puncture, ...]  #: drops of the force while the needle enters new tissue
    samples: int  #: number of samples used
    residual: float  #: root mean square of the residual of the filtered force [N]
    determination: float  #: coefficient of determination R^2
    condition: float  #: condition number of the regressors, each scaled to unit norm
    tests: tuple[ResidualTest, ...]  #: tests of the residuals
    comparison: tuple[CandidateFit, ...]  #: comparisons with alternative sets of terms
    warnings: tuple[str, ...]  #: warnings about the validity of the estimate
    fit: Fit  #: signals for plots

    def __getitem__(self, name: str) -> ParameterEstimate:
        return named(self.parameters, name)

    def rows(self) -> EstimateRows:
        return ((self.name, one) for one in self.parameters)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class FrictionSummary(DisplayedEstimate):
    """Friction over several recordings; ``summary[name]`` is a statistic."""

    statistics: tuple[Statistic, ...]  #: one per parameter
    estimates: tuple[FrictionEstimate, ...]  #: one per recording
    prediction: RecordingPrediction | None = None  #: error of recordings predicted from the others
    warnings: tuple[str, ...] = ()  #: warnings that only all recordings together support

    def __getitem__(self, name: str) -> Statistic:
        return named(self.statistics, name)

    def rows(self) -> EstimateRows:
        return ((f'{len(self.estimates)} recordings', one) for one in self.statistics)


def summarize(estimates: Sequence[FrictionEstimate]) -> FrictionSummary:
    """
    Combine the estimates of several recordings, as in Table 1.

    Parameters
    ----------
    estimates : sequence of FrictionEstimate
        One per recording.

    Returns
    -------
    FrictionSummary
        One `statistic` per parameter, then breakaway force and lag if any recording has them.

    """
    if not estimates:
        raise IdentificationError('no recordings to identify from')
    found: dict[str, list[ParameterEstimate]] = {}
    for estimate in estimates:
        for parameter in (*estimate.parameters, estimate.breakaway, estimate.lag):
            if parameter is not None:
                found.setdefault(parameter.name, []).append(parameter)
    same = len({one.terms for one in estimates}) == 1
    prediction = predicted([one.fit.moments for one in estimates]) if same else None
    worse = prediction.warning if prediction else ''
    return FrictionSummary(
        statistics=tuple(statistic(parameters) for parameters in found.values()),
        estimates=tuple(estimates),
        prediction=prediction,
        warnings=(*_together(estimates), *([worse] if worse else [])),
    )


def _together(estimates: Sequence[FrictionEstimate]) -> Iterator[str]:
    """Warn of a term that the recordings support only together, by Fisher's test."""
    tried: dict[str, list[CandidateFit]] = {}
    for estimate in estimates:
        for one in estimate.comparison:
            if len(one.terms) == len(estimate.terms) + 1:
                tried.setdefault(one.terms[-1], []).append(one)
    if any(one.supported for ones in tried.values() for one in ones):
        return
    found = {}
    for term, ones in tried.items():
        if len(ones) > 1:
            logs = sum(log(max(one.p_value, float_info.min)) for one in ones)
            found[term] = float(chdtrc(2.0 * len(ones), -2.0 * logs))
    term = min(found, key=lambda term: found[term], default='')
    if term and found[term] * len(found) < SIGNIFICANCE:
        yield (
            f'together the {len(tried[term])} recordings support {term} '
            f'(p = {found[term] * len(found):.2g}): add the term {term}'
        )
