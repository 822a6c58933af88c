"""Comparison with other sets of terms: one term more, or one term less."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log, nan
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_identification.errors import IdentificationError
from needle_identification.estimation.regression import Regression, score_covariance
from needle_identification.friction.design import Design, solve
from needle_identification.friction.filtering import FilteredSignals
from needle_identification.friction.settings import FrictionSettings, TERMS
from needle_identification.friction.terms import columns_of
import numpy as np

#: Probability of a false alarm of all comparisons of one recording.
_SIGNIFICANCE: Final = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """
    Another set of terms beside the chosen one.

    Attributes
    ----------
    terms : tuple of str
        The other set: one term more or one less.
    criterion : str
        Criterion of the comparison: BIC, with the effective number of samples.
    difference : float
        BIC of the other set minus that of the chosen one; negative if the other set is better,
        nan if it is not determined.
    p_value : float
        p-value of the Wald test that the terms which differ are zero, with errors that respect
        autocorrelation. It is corrected for the number of terms tried (Holm).
    supported : bool
        Whether the data support the other set.
    words : str
        The result in words.

    """

    terms: tuple[str, ...]
    criterion: str
    difference: float
    p_value: float
    supported: bool
    words: str


def compare_terms(
    signals: FilteredSignals,
    design: Design,
    settings: FrictionSettings,
    fit: Regression,
    window: FloatArray,
) -> tuple[Comparison, ...]:
    """
    Try each term that was not chosen, and leave out each chosen one.

    Parameters
    ----------
    signals : FilteredSignals
        Filtered force and motion.
    design : Design
        Samples to use.
    settings : FrictionSettings
        The chosen terms.
    fit : Regression
        Their fit.
    window : ndarray, shape (w,)
        Window that spans the correlation of the noise.

    Returns
    -------
    tuple of Comparison
        One per set of terms that could be fitted.

    """
    chosen = settings.terms
    samples = _independent_samples(fit, window)
    tried = _tried(signals, design, settings, window)
    p_values = _holm(
        [
            other.wald(which)[1] if other.determined[which].all() else 1.0
            for _, other, which in tried
        ]
    )
    found = [
        _added((*chosen, term), other, which, _bic_difference(other, fit, samples), p_value)
        for (term, other, which), p_value in zip(tried, p_values, strict=True)
    ]
    for term in chosen:
        rest = tuple(other for other in chosen if other != term)
        if rest and not ('direction' in chosen and term in ('coulomb', 'viscous')):
            names = [column.name for column in columns_of(chosen)]
            which = [names.index(column.name) for column in columns_of([term])]
            simpler = replace(settings, terms=rest, estimator='ordinary')
            less = solve(signals, design, simpler, rest, window)
            found.append(_removed(rest, term, fit, which, _bic_difference(less, fit, samples)))
    return tuple(found)


def _tried(
    signals: FilteredSignals, design: Design, settings: FrictionSettings, window: FloatArray
) -> list[tuple[str, Regression, list[int]]]:
    """Fit each term that was not chosen; return term, fit and the positions of its columns."""
    chosen = settings.terms
    found = []
    for term in TERMS:
        if term in chosen or (term == 'inertia' and design.estimates_lag):
            continue
        if term == 'direction' and (
            settings.estimator == 'total' or not {'coulomb', 'viscous'} <= set(chosen)
        ):
            continue
        start = len(columns_of(chosen))
        which = list(range(start, start + len(columns_of([term]))))
        try:
            found.append((term, solve(signals, design, settings, (*chosen, term), window), which))
        except IdentificationError:
            # Not enough samples for one more parameter.
            continue
    return found


def _holm(p_values: Sequence[float]) -> list[float]:
    """Correct p-values for their number (Holm): the probability of any false alarm is kept."""
    corrected = np.ones(len(p_values))
    largest = 0.0
    for rank, k in enumerate(np.argsort(p_values)):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[k]))
        corrected[k] = largest
    return corrected.tolist()


def _independent_samples(fit: Regression, window: FloatArray) -> float:
    """Return the number of independent samples with the same error of the mean residual."""
    left = fit.residual[:, np.newaxis]
    number = fit.samples * float((left**2).sum() / score_covariance(left, window)[0, 0])
    return min(max(number, len(fit.values) + 1.0), float(fit.samples))


def _bic_difference(other: Regression, chosen: Regression, samples: float) -> float:
    """Return BIC of another fit minus that of the chosen one, for independent samples."""
    misfit = float(other.residual @ other.residual) / float(chosen.residual @ chosen.residual)
    return samples * log(misfit) + (len(other.values) - len(chosen.values)) * log(samples)


def _added(
    terms: tuple[str, ...], other: Regression, which: list[int], difference: float, p_value: float
) -> Comparison:
    term = terms[-1]
    if not other.determined[which].all():
        words = f'the data do not distinguish the term {term} from the others'
        return _comparison(terms, nan, 1.0, False, words)
    supported = p_value < _SIGNIFICANCE and difference < 0.0
    verdict = 'support' if supported else 'do not support'
    sizes = ' and '.join(
        f'{column.name} = {other.values[k]:.3g} ± {other.errors[k]:.2g} {column.unit}'
        for k, column in zip(which, columns_of([term]), strict=True)
    )
    words = f'the data {verdict} {term}: {sizes} (p = {p_value:.2g})'
    return _comparison(terms, difference, p_value, supported, words)


def _removed(
    terms: tuple[str, ...], term: str, fit: Regression, which: list[int], difference: float
) -> Comparison:
    if not fit.determined[which].all():
        words = f'the data do not distinguish the term {term} from the others: leave one out'
        return _comparison(terms, nan, 1.0, False, words)
    p_value = fit.wald(which)[1]
    supported = p_value >= _SIGNIFICANCE and difference < 0.0
    words = f'the data {"do not need" if supported else "need"} {term} (p = {p_value:.2g})'
    return _comparison(terms, difference, p_value, supported, words)


def _comparison(
    terms: tuple[str, ...], difference: float, p_value: float, supported: bool, words: str
) -> Comparison:
    return Comparison(
        terms=terms,
        criterion='BIC',
        difference=difference,
        p_value=p_value,
        supported=supported,
        words=words,
    )
