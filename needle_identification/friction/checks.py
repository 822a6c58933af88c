"""What speaks against an estimate of friction: errors, and warnings in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from needle_identification.errors import IdentificationError
from needle_identification.estimation.estimate import ParameterEstimate
from needle_identification.estimation.regression import Regression
from needle_identification.estimation.residual_tests import ResidualTest
from needle_identification.friction.comparison import Comparison
from needle_identification.friction.design import Design
from needle_identification.friction.filtering import FilteredSignals
from needle_identification.friction.settings import FrictionSettings
from needle_identification.friction.terms import columns_of, regressors
import numpy as np

#: Lag beyond that of usual sensor filters [s].
_UNUSUAL_LAG: Final = 0.01

_FRICTION: Final = ('coulomb_friction', 'viscous_friction')


def check_friction(parameters: Sequence[ParameterEstimate]) -> None:
    """
    Reject friction that is negative or absent.

    Parameters
    ----------
    parameters : sequence of ParameterEstimate
        Fitted parameters.

    Raises
    ------
    IdentificationError
        If a coefficient is clearly negative, or none is clearly different from zero.

    """
    friction = [parameter for parameter in parameters if parameter.name in _FRICTION]
    for parameter in friction:
        if parameter.determined and parameter.value + 2.0 * parameter.error < 0.0:
            raise IdentificationError(
                f'friction must not be negative, got {parameter.symbol} = {parameter.value:.3g} '
                f'{parameter.unit}; the force or the motion may have the wrong sign'
            )
    if friction and all(p.determined and abs(p.value) < 2.0 * p.error for p in friction):
        sizes = ', '.join(f'{p.symbol} = {p.value:.2g} ± {p.error:.2g} {p.unit}' for p in friction)
        raise IdentificationError(
            f'no friction: {sizes}; force and motion do not belong together, or the axes are wrong'
        )


def parameter_warnings(parameters: Sequence[ParameterEstimate]) -> list[str]:
    """
    Warn of parameters that are not determined.

    Parameters
    ----------
    parameters : sequence of ParameterEstimate
        Fitted parameters.

    Returns
    -------
    list of str
        Warnings.

    """
    unknown = [parameter.name for parameter in parameters if not parameter.determined]
    if not unknown:
        return []
    return [f'the data do not determine {", ".join(unknown)}: use more speeds, or fewer terms']


def lag_warnings(lag: ParameterEstimate, coarse: float, period: float) -> list[str]:
    """
    Warn of a lag that no usual filter explains, or that points to a mass.

    Parameters
    ----------
    lag : ParameterEstimate
        Lag of the force [s].
    coarse : float
        Lag that was corrected if that one is not determined [s].
    period : float
        Sampling period [s].

    Returns
    -------
    list of str
        Warnings.

    """
    if not lag.determined and coarse:
        way = 'behind' if coarse > 0.0 else 'ahead of'
        size = f'{1e3 * abs(coarse):.2g} ms'
        return [f'the force is about {size} {way} the motion (from steady strokes); corrected']
    if not lag.determined or lag.interval[0] <= 0.0 <= lag.interval[1]:
        return []
    size = f'{1e3 * abs(lag.value):.3g} ± {1e3 * lag.error:.2g} ms'
    if lag.value > max(_UNUSUAL_LAG, period):
        return [f'the force is {size} behind the motion: filters or clocks; corrected']
    if lag.value < 0.0 and -lag.value > period / 2.0:
        return [f'the force is {size} ahead of the motion: clocks, or a mass (term inertia)']
    return []


def mass_warnings(parameters: Sequence[ParameterEstimate]) -> list[str]:
    """
    Say which mass a lag of 1 ms looks like.

    Parameters
    ----------
    parameters : sequence of ParameterEstimate
        Fitted parameters.

    Returns
    -------
    list of str
        Warnings; none without the term inertia.

    """
    found = {parameter.name: parameter for parameter in parameters if parameter.determined}
    if not {'moving_mass', 'viscous_friction'} <= set(found):
        return []
    mass = 1e-3 * found['viscous_friction'].value
    return [f'a lag of the force of 1 ms looks like {-mass:.2g} kg of moving_mass']


def noise_warnings(
    signals: FilteredSignals, design: Design, settings: FrictionSettings, fit: Regression
) -> list[str]:
    """
    Warn if noise of the speed reduces mu_v by more than half its standard error.

    Parameters
    ----------
    signals : FilteredSignals
        The noise of the speed.
    design : Design
        Samples that were used.
    settings : FrictionSettings
        Terms and estimator.
    fit : Regression
        Their fit.

    Returns
    -------
    list of str
        Warnings.

    """
    names = [column.name for column in columns_of(settings.terms)]
    if settings.estimator == 'total' or 'viscous_friction' not in names:
        return []
    k = names.index('viscous_friction')
    if not fit.determined[k]:
        return []
    x = regressors(design.speed, design.acceleration, settings.terms, settings)[design.used]
    inverse = np.linalg.pinv(x.T @ x)
    bias = float(fit.values[k] * fit.samples * signals.speed_noise**2 * inverse[k, k])
    if abs(bias) <= 0.5 * fit.errors[k]:
        return []
    noise, change = f'{signals.speed_noise:.2g} m/s', f'{bias:.2g} N s/m'
    return [f'noise of {noise} in the speed reduces mu_v by {change}: choose estimator total']


def model_warnings(
    settings: FrictionSettings,
    comparisons: Sequence[Comparison],
    tests: Sequence[ResidualTest],
) -> list[str]:
    """
    Name the best missing term; if no term is missing, the residual tests that failed.

    Parameters
    ----------
    settings : FrictionSettings
        The chosen terms.
    comparisons : sequence of Comparison
        Other sets of terms.
    tests : sequence of ResidualTest
        Tests of the residuals.

    Returns
    -------
    list of str
        Warnings.

    """
    missing = [c for c in comparisons if c.supported and len(c.terms) > len(settings.terms)]
    if missing:
        best = min(missing, key=lambda c: c.difference)
        return [f'{best.words}: add the term {best.terms[-1]}']
    return [test.words for test in tests if test.failed]
