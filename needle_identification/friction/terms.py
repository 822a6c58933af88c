# SPDX-License-Identifier: Apache-2.0
r"""
Terms of the friction force and their regressors.

Equation (15) of the paper contains the first two terms; the others are optional:

.. math::

   f_y = \mu_s \operatorname{sgn}(\dot s) + \mu_v \dot s + b + c t + m \ddot s
   + (\Delta\mu_s \operatorname{sgn}(\dot s) + \Delta\mu_v \dot s)_{\dot s < 0}
   + (\mu_b - \mu_s) \operatorname{sgn}(\dot s) \, e^{-(\dot s / v_s)^2}
   + \operatorname{sgn}(\dot s) \sum_i c_i \ell_i(s) + f_c \, [\text{the tip is in new tissue}]
   + k (s - s_0) + b_0 e^{-t / T}

with :math:`\ell_i` the length of the needle in layer i; for the term ``length``, :math:`s - s_0`,
the depth since the start. To add a friction law, add a term to `TERMS` and its columns here.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import inf
from typing import Final, NamedTuple

from needle_dynamics.arrays import BoolArray, FloatArray
from needle_identification.friction.settings import FrictionSettings
import numpy as np


class NeedleMotion(NamedTuple):
    """Motion of the needle, (n,) each, positive into the tissue."""

    velocity: FloatArray  # [m/s]
    acceleration: FloatArray  # [m/s^2]
    time: FloatArray  # since the start of the recording [s]
    depth: FloatArray  # insertion depth [m]
    fresh: BoolArray  # at the largest insertion depth so far
    sign: FloatArray  # of the velocity, or filtered as the force


@dataclass(frozen=True, slots=True)
class Regressor:
    """Regressor ``of`` the motion and the settings, shape (n,), and its coefficient."""

    name: str
    symbol: str
    unit: str
    of: Callable[[NeedleMotion, FrictionSettings], FloatArray]


_COLUMNS: Final[Mapping[str, tuple[Regressor, ...]]] = {
    'coulomb': (Regressor('coulomb_friction', 'mu_s', 'N', lambda x, _: x.sign),),
    'viscous': (Regressor('viscous_friction', 'mu_v', 'N s/m', lambda x, _: x.velocity),),
    'offset': (Regressor('offset', 'b', 'N', lambda x, _: np.ones_like(x.velocity)),),
    # Drift of sensor or tissue since the start of the recording.
    'drift': (Regressor('force_drift', 'c', 'N/s', lambda x, _: x.time),),
    'inertia': (Regressor('moving_mass', 'm', 'kg', lambda x, _: x.acceleration),),
    # Additional Coulomb and viscous friction on withdrawal.
    'direction': (
        Regressor('withdrawal_coulomb', 'd mu_s', 'N', lambda x, _: np.minimum(x.sign, 0)),
        Regressor('withdrawal_viscous', 'd mu_v', 'N s/m', lambda x, _: np.minimum(x.velocity, 0)),
    ),
    # Excess of the breakaway friction over mu_s.
    'stribeck': (
        Regressor(
            'stribeck_friction', 'mu_b - mu_s', 'N',
            lambda x, s: x.sign * np.exp(-((x.velocity / s.stribeck_speed) ** 2)),
        ),
    ),
    'length': (
        Regressor('length_friction', 'c', 'N/m', lambda x, _: x.sign * (x.depth - x.depth[0])),
    ),
    'cutting': (
        Regressor(
            'cutting_force', 'f_c', 'N',
            lambda x, _: np.where(x.fresh & (x.velocity > 0.0), 1.0, 0.0),
        ),
    ),
    # Weight, or tissue that follows the needle; and the zero of a sensor that settles.
    'spring': (Regressor('spring_stiffness', 'k', 'N/m', lambda x, _: x.depth - x.depth[0]),),
    'decay': (Regressor('decay', 'b_0', 'N', lambda x, s: np.exp(-x.time / s.decay_time)),),
}  # fmt: skip


def _layers(boundaries: Sequence[float]) -> list[Regressor]:
    """Return a column per layer; the last layer is unbounded."""

    def column(number: int, low: float, end: float) -> Regressor:
        return Regressor(
            f'layer_{number}_friction', f'c_{number}', 'N/m',
            lambda x, _: x.sign * np.clip(x.depth - low, 0.0, end - low),
        )  # fmt: skip

    return [column(k, *span) for k, span in enumerate(pairwise([*boundaries, inf]), 1)]


def columns_of(terms: Sequence[str], settings: FrictionSettings) -> list[Regressor]:
    return [
        column
        for term in terms
        for column in (_layers(settings.layers) if term == 'layers' else _COLUMNS[term])
    ]


def regressors(
    motion: NeedleMotion, terms: Sequence[str], settings: FrictionSettings
) -> FloatArray:
    """Return the regressors of terms, shape (n, k), with the columns of `columns_of`."""
    return np.column_stack([c.of(motion, settings) for c in columns_of(terms, settings)])
