# SPDX-License-Identifier: Apache-2.0
"""Settings of friction identification."""

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

from needle_identification.estimation import ESTIMATORS
from needle_ros.errors import ParameterError
from needle_ros.settings import check_choice, check_constants, choice, constant, flag, positive

#: Terms of the friction force, by name; their equations are in `terms`.
TERMS: Final = (
    'coulomb', 'viscous', 'offset', 'drift', 'inertia', 'direction', 'stribeck', 'length',
    'layers', 'cutting', 'spring', 'decay',
)  # fmt: skip

#: Terms that remain linear within the filter window of a reversal.
LINEAR: Final = frozenset(TERMS) - {'direction', 'stribeck', 'cutting'}

#: Terms whose columns change with the velocity; the others depend on its sign at most.
OF_VELOCITY: Final = frozenset({'viscous', 'direction', 'stribeck'})

AUTO: Final = 'auto'  #: automatic choice of the estimator


@dataclass(frozen=True, slots=True, kw_only=True)
class FrictionSettings:
    """
    Settings of `identify_friction`; fields describe meaning and unit.

    The default terms are equation (15). The estimator ``weighted`` estimates the noise in each
    stroke, ``total`` accounts for velocity noise; ``auto`` is ``total`` if velocity noise is
    relevant, otherwise ``ordinary``.
    """

    cutoff: float = positive(30.0, 'Hz', 'zero-phase low-pass filter of force and motion')
    moving_speed: float = positive(1e-5, 'm/s', 'speed above which the needle counts as moving')
    largest_acceleration: float = positive(
        0.2, 'm/s^2', 'acceleration up to which samples are used without inertia'
    )
    stribeck_speed: float = positive(1e-3, 'm/s', 'speed over which the breakaway friction decays')
    decay_time: float = positive(10.0, 's', 'time constant of the term decay')
    layers: tuple[float, ...] = constant(
        (), 'm', 'insertion depths at which layers begin, for the term layers', low=-10.0
    )
    reversals: bool = flag(
        False, 'use the samples at reversals, too, if friction is known to change its sign at once'
    )
    terms: tuple[str, ...] = field(
        default=('coulomb', 'viscous'), metadata={'description': f'of {", ".join(TERMS)}'}
    )
    estimator: str = choice(AUTO, (AUTO, *ESTIMATORS))

    @property
    def allows_total(self) -> bool:
        """Whether velocity noise affects a single column, as the estimator total requires."""
        return 'viscous' in self.terms and 'direction' not in self.terms

    def __post_init__(self) -> None:
        check_constants(self)
        object.__setattr__(self, 'terms', tuple(self.terms))
        if any(low >= high for low, high in pairwise(self.layers)):
            raise ParameterError(f'layers must increase, got {list(self.layers)}')
        if bool(self.layers) != ('layers' in self.terms):
            raise ParameterError(
                f'the term layers and the setting layers need each other, got the terms '
                f'{", ".join(self.terms)} and layers {list(self.layers)}'
            )
        if {'length', 'layers'} <= set(self.terms):
            raise ParameterError('the term layers takes the place of the term length')
        if not self.terms or len(set(self.terms)) < len(self.terms):
            raise ParameterError(f'terms must be distinct, at least one, got {list(self.terms)}')
        for term in self.terms:
            check_choice('terms', term, TERMS)
        if self.reversals and not {'inertia'} <= set(self.terms) <= LINEAR:
            raise ParameterError(
                f'reversals needs the term inertia, and none of '
                f'{", ".join(sorted(set(TERMS) - LINEAR))}, got {", ".join(self.terms)}'
            )
        if 'direction' in self.terms and not {'coulomb', 'viscous'} <= set(self.terms):
            raise ParameterError('the term direction needs the terms coulomb and viscous')
        if self.estimator == 'total' and not self.allows_total:
            raise ParameterError(
                'the estimator total needs the term viscous and does not work with direction: '
                'velocity noise must affect a single column'
            )
