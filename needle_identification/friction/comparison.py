"""Comparison with other sets of terms: one term more, or one term less."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import log, nan
from typing import Final

from needle_identification.errors import IdentificationError
from needle_identification.estimation.regression import Regression, score_covariance
from needle_identification.friction.design import Design
from needle_identification.friction.settings import TERMS
from needle_identification.friction.terms import columns_of
import numpy as np

#: Probability of a false alarm of all comparisons.
SIGNIFICANCE: Final = 0.02


#: Parts of the strokes that are held out in turn.
_FOLDS: Final = 5

#: Terms whose coefficient cannot be negative.
_POSITIVE: Final = ('inertia', 'stribeck')


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
        Whether the data support the other set; a further term must also predict samples better
        that were held out.
    words : str
        The result in words.

    """

    terms: tuple[str, ...]
    criterion: str = 'BIC'
    difference: float = nan
    p_value: float = 1.0
    supported: bool = False
    words: str


def compare_terms(design: Design, fit: Regression, among: int = 1) -> tuple[Comparison, ...]:
    """
    Try each term that was not chosen, and leave out each chosen one.

    Parameters
    ----------
    design : Design
        Samples to use, and the chosen terms.
    fit : Regression
        The fit of the chosen terms.
    among : int
        Number of recordings over which the probability of a false alarm is kept.

    Returns
    -------
    tuple of Comparison
        One per set of terms that could be fitted.

    """
    chosen = design.signals.settings.terms
    samples = _independent_samples(design, fit)
    level = SIGNIFICANCE / among
    tried = _tried(design)
    p_values = _holm(
        [
            other.wald(which)[1] if other.determined[which].all() else 1.0
            for _, other, which in tried
        ]
    )
    found = [
        _added((*chosen, term), other, which, _bic_difference(other, fit, samples), p_value, level)
        for (term, other, which), p_value in zip(tried, p_values, strict=True)
    ]
    found = [
        replace(one, supported=False, words=f'{one.words}, but it does not predict better')
        if one.supported and not _predicts_better(design, one.terms)
        else one
        for one in found
    ]
    for term in chosen:
        rest = tuple(other for other in chosen if other != term)
        if rest and not ('direction' in chosen and term in ('coulomb', 'viscous')):
            names = [column.name for column in columns_of(chosen)]
            which = [names.index(column.name) for column in columns_of([term])]
            less = design.solve(rest, 'ordinary', colored=False)
            found.append(_removed(rest, term, fit, which, _bic_difference(less, fit, samples)))
    return tuple(found)


def _tried(design: Design) -> list[tuple[str, Regression, list[int]]]:
    """Fit each term that was not chosen; return term, fit and the positions of its columns."""
    settings = design.signals.settings
    chosen = settings.terms
    found = []
    for term in TERMS:
        if term in chosen or (term == 'inertia' and design.estimates_lag):
            continue
        if not design.reaches(term):
            continue
        if term == 'direction' and (
            settings.estimator == 'total' or not {'coulomb', 'viscous'} <= set(chosen)
        ):
            continue
        start = len(columns_of(chosen))
        which = list(range(start, start + len(columns_of([term]))))
        # Too few samples for one more parameter are no fault of the chosen terms.
        with suppress(IdentificationError):
            other = design.solve((*chosen, term), settings.estimator, colored=False)
            if other.determined[which].all() and other.wald(which)[1] < SIGNIFICANCE:
                # Noise with a memory looks like many a term.
                other = design.solve((*chosen, term), settings.estimator)
            found.append((term, other, which))
    return found


def _predicts_better(design: Design, terms: tuple[str, ...]) -> bool:
    """
    Tell whether the last term lowers the error of predictions of samples that were held out.

    The samples are held out in turn by strokes and rests that follow each other, so that what a
    term learns of noise with a memory does not help it.
    """
    used = design.used
    x, y = design.regressors(terms)[used], design.signals.force[used]
    without = np.ones(x.shape[1], dtype=np.bool_)
    start = len(columns_of(terms[:-1]))
    without[start : start + len(columns_of(terms[-1:]))] = False
    fold = np.unique(design.stroke[used], return_inverse=True)[1] % _FOLDS
    misfits = np.zeros(2)
    for held in range(int(fold.max()) + 1):
        out = fold == held
        for k, chosen in enumerate((without, slice(None))):
            solution = np.linalg.lstsq(x[~out][:, chosen], y[~out], rcond=None)[0]
            misfits[k] += float(np.sum((y[out] - x[out][:, chosen] @ solution) ** 2))
    return bool(misfits[1] < misfits[0])


def _holm(p_values: Sequence[float]) -> list[float]:
    """Correct p-values for their number (Holm): the probability of any false alarm is kept."""
    corrected = np.ones(len(p_values))
    largest = 0.0
    for rank, k in enumerate(np.argsort(p_values)):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[k]))
        corrected[k] = largest
    return corrected.tolist()


def _independent_samples(design: Design, fit: Regression) -> float:
    """Return the number of independent samples with the same error of the mean residual."""
    left = fit.residual[:, np.newaxis]
    covariance = score_covariance(left, design.signals.correlation)[0, 0]
    number = fit.samples * float((left**2).sum() / covariance)
    if fit.memory is not None:
        number /= float(np.mean(fit.memory.inflation**2))
    return min(max(number, len(fit.values) + 1.0), float(fit.samples))


def _bic_difference(other: Regression, chosen: Regression, samples: float) -> float:
    """Return BIC of another fit minus that of the chosen one, for independent samples."""
    misfit = float(other.residual @ other.residual) / float(chosen.residual @ chosen.residual)
    return samples * log(misfit) + (len(other.values) - len(chosen.values)) * log(samples)


def _added(
    terms: tuple[str, ...],
    other: Regression,
    which: list[int],
    difference: float,
    p_value: float,
    level: float,
) -> Comparison:
    term = terms[-1]
    if not other.determined[which].all():
        words = f'the data do not distinguish the term {term} from the others'
        return Comparison(terms=terms, words=words)
    # Neither a mass nor what breaks away is less than nothing.
    impossible = term in _POSITIVE and other.values[which[0]] < 0.0
    supported = p_value < level and difference < 0.0 and not impossible
    verdict = 'support' if supported else 'do not support'
    sizes = ' and '.join(
        f'{column.name} = {other.values[k]:.3g} ± {other.errors[k]:.2g} {column.unit}'
        for k, column in zip(which, columns_of([term]), strict=True)
    )
    words = f'the data {verdict} {term}: {sizes} (p = {p_value:.2g})'
    return Comparison(
        terms=terms, difference=difference, p_value=p_value, supported=supported, words=words
    )


def _removed(
    terms: tuple[str, ...], term: str, fit: Regression, which: list[int], difference: float
) -> Comparison:
    if not fit.determined[which].all():
        words = f'the data do not distinguish the term {term} from the others: leave one out'
        return Comparison(terms=terms, words=words)
    p_value = fit.wald(which)[1]
    supported = p_value >= SIGNIFICANCE and difference < 0.0
    words = f'the data {"do not need" if supported else "need"} {term} (p = {p_value:.2g})'
    return Comparison(
        terms=terms, difference=difference, p_value=p_value, supported=supported, words=words
    )
