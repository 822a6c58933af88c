r"""
Terms of the friction force and their regressors.

Equation (15) of the paper has the first two; the others are optional:

.. math::

   f_y = \mu_s \operatorname{sgn}(\dot s) + \mu_v \dot s + b + c t + m \ddot s
   + (\Delta\mu_s \operatorname{sgn}(\dot s) + \Delta\mu_v \dot s)_{\dot s < 0}
   + (\mu_b - \mu_s) \operatorname{sgn}(\dot s) \, e^{-(\dot s / v_s)^2}

To add a friction law, add a term to `TERMS` and its columns here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_identification.friction.settings import FrictionSettings
import numpy as np


@dataclass(frozen=True, slots=True)
class Column:
    """
    A regressor and its coefficient.

    Attributes
    ----------
    name, symbol, unit : str
        Coefficient: name, symbol in text and unit.
    of : callable
        Regressor from speed [m/s], acceleration [m/s^2] and time [s], each of shape (n,), and the
        settings.

    """

    name: str
    symbol: str
    unit: str
    of: Callable[[FloatArray, FloatArray, FloatArray, FrictionSettings], FloatArray]


_COLUMNS: Final[Mapping[str, tuple[Column, ...]]] = {
    'coulomb': (Column('coulomb_friction', 'mu_s', 'N', lambda v, _a, _t, _s: np.sign(v)),),
    'viscous': (Column('viscous_friction', 'mu_v', 'N s/m', lambda v, _a, _t, _s: v),),
    'offset': (Column('offset', 'b', 'N', lambda v, _a, _t, _s: np.ones_like(v)),),
    # Of the sensor, or of the tissue: since the recording began.
    'drift': (Column('force_drift', 'c', 'N/s', lambda _v, _a, t, _s: t),),
    'inertia': (Column('moving_mass', 'm', 'kg', lambda _v, a, _t, _s: a),),
    # What Coulomb and viscous friction are more on withdrawal than on insertion.
    'direction': (
        Column(
            'withdrawal_coulomb', 'd mu_s', 'N', lambda v, _a, _t, _s: np.minimum(np.sign(v), 0)
        ),
        Column('withdrawal_viscous', 'd mu_v', 'N s/m', lambda v, _a, _t, _s: np.minimum(v, 0.0)),
    ),
    # What the breakaway friction is more than mu_s.
    'stribeck': (
        Column(
            'stribeck_friction',
            'mu_b - mu_s',
            'N',
            lambda v, _a, _t, s: np.sign(v) * np.exp(-((v / s.stribeck_speed) ** 2)),
        ),
    ),
}


def columns_of(terms: Sequence[str]) -> list[Column]:
    """
    Return the columns of terms.

    Parameters
    ----------
    terms : sequence of str
        Terms, of `TERMS`.

    Returns
    -------
    list of Column
        Their columns, in order.

    """
    return [column for term in terms for column in _COLUMNS[term]]


def regressors(
    speed: FloatArray,
    acceleration: FloatArray,
    time: FloatArray,
    terms: Sequence[str],
    settings: FrictionSettings,
) -> FloatArray:
    """
    Return the regressors of terms.

    Parameters
    ----------
    speed, acceleration : ndarray, shape (n,)
        Insertion speed [m/s] and acceleration [m/s^2], positive into the tissue.
    time : ndarray, shape (n,)
        Time since the recording began [s].
    terms : sequence of str
        Terms, of `TERMS`.
    settings : FrictionSettings
        Constants of the terms.

    Returns
    -------
    ndarray, shape (n, k)
        One column per coefficient, as in `columns_of`.

    """
    columns = columns_of(terms)
    return np.column_stack([c.of(speed, acceleration, time, settings) for c in columns])
