# SPDX-License-Identifier: Apache-2.0
"""Comparison with sets that have one term more or less, or two more."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from math import inf, log, nan, prod
from typing import Final, NamedTuple

from needle_identification.errors import IdentificationError
from needle_identification.estimation.regression import Regression, score_covariance, wald_test
from needle_identification.estimation.screening import Screening, Trial
from needle_identification.friction.design import Design
from needle_identification.friction.search import (
    speed_option,
    TRIED,
    with_decay_time,
    with_stribeck_speed,
)
from needle_identification.friction.settings import FrictionSettings, LINEAR, TERMS
from needle_identification.friction.terms import columns_of
import numpy as np
from scipy.special import chdtrc

SIGNIFICANCE: Final = 0.02  #: probability of a false alarm of all comparisons
_LIKE_MEMORY: Final = 1.5  # growth of the errors that two missing terms may explain
_SLOW: Final = 1e-4  # SIGNIFICANCE of each term beside slow noise, which may resemble it
_OTHER: Final = 1e-3  # probability of a false alarm that another Stribeck speed fits better
_FOLDS: Final = 5  # folds of the cross-validation over strokes
_POSITIVE: Final = ('inertia', 'stribeck', 'cutting')  # terms whose coefficient cannot be negative


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateFit:
    """Comparison of an alternative set of terms with the chosen set."""

    terms: tuple[str, ...]  #: alternative set: one term more or less, or two more
    #: BIC minus BIC of the chosen set, with the effective number of samples; nan: not determined.
    difference: float = nan
    #: Of the Wald test that the differing terms are zero, for the number of terms tried (Holm).
    p_value: float = 1.0
    supported: bool = False  #: by the data; an additional term must also predict better
    words: str  #: result as a sentence


def compare_terms(design: Design, fit: Regression, among: int = 1) -> tuple[CandidateFit, ...]:
    """Add each unused term, leave out each chosen term; among: number of recordings."""
    settings, screening = design.signals.settings, design.screening
    chosen = settings.terms
    samples = _independent_samples(design, fit)
    if 'decay' not in chosen:
        design = with_decay_time(design, fit.residual)
    searched = dict(TRIED)
    given = settings.stribeck_speed != FrictionSettings().stribeck_speed
    if given or settings.reversals or 'stribeck' in chosen:
        del searched['stribeck']
    else:
        design = with_stribeck_speed(design)
    comparison = _Comparison(design, fit, screening, samples, SIGNIFICANCE / among, searched)
    singles = [(term,) for term in _candidates(design)]
    found = comparison.added(singles)
    growth = 1.0 if fit.memory is None else float(fit.memory.inflation.max())
    if growth > _LIKE_MEMORY and not any(one.supported for one in found):
        # Two missing terms leave residuals that resemble autocorrelated noise.
        pairs = [(first, second) for (first,), (second,) in combinations(singles, 2)]
        found += [one for one in comparison.added(pairs) if one.supported]
    for term in chosen:
        if len(chosen) > 1 and not ('direction' in chosen and term in ('coulomb', 'viscous')):
            found.append(comparison.removed(term))
    return tuple(found)


def _candidates(design: Design) -> list[str]:
    settings = design.signals.settings
    chosen = set(settings.terms)
    # The user must give the boundaries of layers.
    excluded = chosen | {'layers'}
    if settings.reversals:
        excluded |= set(TERMS) - LINEAR
    if design.estimates_lag:
        excluded.add('inertia')
    if 'layers' in chosen:
        excluded.add('length')
    if settings.estimator == 'total' or not {'coulomb', 'viscous'} <= chosen:
        excluded.add('direction')
    return [term for term in TERMS if term not in excluded and design.reaches(term)]


def other_speed(design: Design, fit: Regression) -> str:
    """Return a warning if the term `stribeck` fits better with another speed."""
    settings = design.signals.settings
    if 'stribeck' not in settings.terms:
        return ''
    other = with_stribeck_speed(design)
    if other.signals.settings.stribeck_speed == settings.stribeck_speed:
        return ''
    with suppress(IdentificationError):
        better = other.solve(settings.terms, settings.estimator)
        gain = log(float(fit.residual @ fit.residual) / float(better.residual @ better.residual))
        ratio = max(_independent_samples(other, better) * gain, 0.0)
        # Likelihood ratio of one more parameter.
        p_value = min(TRIED['stribeck'] * float(chdtrc(1.0, ratio)), 1.0)
        if p_value < _OTHER:
            return (
                f'the term stribeck fits better with {speed_option(other.signals.settings)} '
                f'(p = {p_value:.2g}): the intervals do not hold'
            )
    return ''


class _Comparison(NamedTuple):
    """A fit, its screening, its independent samples, level, and constants tried by term."""

    design: Design
    fit: Regression
    screening: Screening
    samples: float
    level: float
    searched: dict[str, int]

    def added(self, candidates: Sequence[tuple[str, ...]]) -> list[CandidateFit]:
        """Fit additional terms; a supported term must also improve the prediction."""
        tried = [self._tried(more) for more in candidates]
        searched = [prod(self.searched.get(term, 1) for term in more) for more in candidates]
        p_values = _holm(np.multiply([trial.p_value for trial in tried], searched).tolist())
        # The residual without a missing term is no noise: samples of the best fit.
        known = [(trial.misfit, trial.samples) for trial in tried if trial.samples]
        samples = min(known)[1] if known else self.samples
        found = zip(candidates, tried, p_values, strict=True)
        return _simplest([self._judged(*one, samples) for one in found])

    def _tried(self, more: tuple[str, ...]) -> Trial:
        """Fit additional terms, with errors for autocorrelated noise if they are significant."""
        design, settings = self.design, self.design.signals.settings
        columns = design.columns(more).take(design.rows, axis=0)
        trial = self.screening.tried(columns, design.column_noise(more))
        if not trial.determined or trial.p_value >= SIGNIFICANCE:
            return trial
        which = list(range(design.terms, design.terms + len(trial.values)))
        ends = np.cumsum([len(columns_of([term], settings)) for term in more])
        # Autocorrelated noise resembles many terms. Too few samples determine no other term.
        with suppress(IdentificationError):
            other = design.solve((*settings.terms, *more), settings.estimator)
            if other.determined[which].all():
                values, errors = other.values[which], other.errors[which]
                growth = other.memory.inflation[: design.terms].max() if other.memory else 1.0
                # Two terms that explain all slow noise are missing if each of them is
                # (intersection-union test).
                parts = np.split(which, ends[:-1] if growth < _LIKE_MEMORY else [])
                p_values = [wald_test(other, part.tolist()) for part in parts]
                # Only the screening allows for noise of the velocity in the columns.
                p_value = max(trial.p_value, *p_values)
                samples = _independent_samples(design, other)
                return Trial(values, errors, True, trial.misfit, p_value, growth, samples)
        return trial._replace(determined=False, p_value=1.0)

    def _judged(
        self, more: tuple[str, ...], trial: Trial, p_value: float, samples: float
    ) -> CandidateFit:
        settings = self.design.signals.settings
        terms, name = (*settings.terms, *more), ' and '.join(more)
        if not trial.determined:
            words = f'the data do not distinguish the term {name} from the others'
            return CandidateFit(terms=terms, words=words)
        columns = columns_of(more, settings)
        difference = samples * log(trial.misfit / self.screening.misfit)
        difference += len(columns) * log(samples)
        firsts = {columns_of([term], settings)[0].name for term in more if term in _POSITIVE}
        found = list(zip(columns, trial.values, trial.errors, strict=True))
        # A mass, breakaway friction or cutting force cannot be negative.
        impossible = any(column.name in firsts and value < 0.0 for column, value, _ in found)
        level = self.level if trial.growth < _LIKE_MEMORY else min(self.level, _SLOW ** len(more))
        supported = p_value < level and difference < 0.0 and not impossible
        better = not supported or _predicts_better(self.design, more)
        verdict = 'support' if supported and better else 'do not support'
        sizes = ' and '.join(
            f'{column.name} = {value:.3g} ± {error:.2g} {column.unit}'
            for column, value, error in found
        )
        if 'decay' in more:
            sizes += f' with decay_time {settings.decay_time:.2g} s'
        if 'stribeck' in more:
            sizes += f' with {speed_option(settings)}'
        words = f'the data {verdict} {name}: {sizes} (p = {p_value:.2g})'
        if not better:
            words += ', which does not predict better'
        supported &= better
        return CandidateFit(
            terms=terms, difference=difference, p_value=p_value, supported=supported, words=words
        )

    def removed(self, term: str) -> CandidateFit:
        fit, settings = self.fit, self.design.signals.settings
        terms = tuple(other for other in settings.terms if other != term)
        names = [column.name for column in columns_of(settings.terms, settings)]
        which = [names.index(column.name) for column in columns_of([term], settings)]
        if not fit.determined[which].all():
            words = f'the data do not distinguish the term {term} from the others: leave one out'
            return CandidateFit(terms=terms, words=words)
        p_value = wald_test(fit, which)
        misfit = self.screening.misfit_without(which) / self.screening.misfit
        difference = self.samples * log(misfit) - len(which) * log(self.samples)
        supported = p_value >= SIGNIFICANCE and difference < 0.0
        words = f'the data {"do not need" if supported else "need"} {term} (p = {p_value:.2g})'
        return CandidateFit(
            terms=terms, difference=difference, p_value=p_value, supported=supported, words=words
        )


def _simplest(found: list[CandidateFit]) -> list[CandidateFit]:
    """Reject `direction` where `offset`, a linear combination of its columns, has a lower BIC."""
    differences = {frozenset(one.terms): one.difference for one in found}
    for k, one in enumerate(found):
        simpler = frozenset(one.terms) - {'direction'} | {'offset'}
        if one.supported and differences.get(simpler, inf) < one.difference:
            words = f'{one.words}, which offset explains with fewer coefficients'
            found[k] = replace(one, supported=False, words=words)
    return found


def _predicts_better(design: Design, more: tuple[str, ...]) -> bool:
    """Test whether additional terms lower the prediction error of held-out samples."""
    used, settings = design.used, design.signals.settings
    x, y = design.regressors((*settings.terms, *more))[used], design.signals.force[used]
    without = np.ones(x.shape[1], dtype=np.bool_)
    without[design.terms : design.terms + len(columns_of(more, settings))] = False
    # Consecutive strokes in a fold: fitting autocorrelated noise is no advantage.
    fold = np.unique(design.stroke[used], return_inverse=True)[1] % _FOLDS
    misfits = np.zeros(2)
    for omitted in range(int(fold.max()) + 1):
        out = fold == omitted
        for k, chosen in enumerate((without, slice(None))):
            solution = np.linalg.lstsq(x[~out][:, chosen], y[~out], rcond=None)[0]
            misfits[k] += float(np.sum((y[out] - x[out][:, chosen] @ solution) ** 2))
    return bool(misfits[1] < misfits[0])


def _holm(p_values: Sequence[float]) -> list[float]:
    """Correct p-values for multiple tests (Holm): controls the probability of any false alarm."""
    order, factors = np.argsort(p_values), np.arange(len(p_values), 0, -1)
    corrected = np.empty(len(p_values))
    smallest = np.minimum(factors * np.array(p_values)[order], 1.0)
    corrected[order] = np.maximum.accumulate(smallest)
    return corrected.tolist()


def _independent_samples(design: Design, fit: Regression) -> float:
    """Return the number of independent samples with the same error of the mean residual."""
    left = fit.residual[:, np.newaxis]
    covariance = score_covariance(left, design.signals.correlation)[0, 0]
    number = fit.samples * float((left**2).sum() / covariance)
    if fit.memory is not None:
        number /= float(np.mean(fit.memory.inflation**2))
    return min(max(number, len(fit.values) + 1.0), float(fit.samples))
