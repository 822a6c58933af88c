# SPDX-License-Identifier: Apache-2.0
"""
Sample true values of simulated needles and tissues that represent Tables 1 and 2.

The tables give mean and standard deviation over 20 experiments. The values of the repeats form a
Latin hypercube: with n repeats every quantity takes each of the quantiles (k + 1/2)/n once, in an
order of its own. Quantities that cannot be negative follow a gamma distribution, the others a
normal distribution.
"""

from itertools import count
from typing import Final

from needle_dynamics import FloatArray
from needle_insertion.report.paper_tables import TABLE_1, TABLE_2
import numpy as np
from scipy.special import gammaincinv, ndtri

_POSITIVE: Final = ('k_xx', 'k_zz')  #: Entries of the stiffness matrix that cannot be negative.


def draw_friction(repeats: int, seed: int) -> list[dict[str, float]]:
    """Sample the friction of each repeat around Table 1: values by its keys [N], [N s/m]."""
    quantiles = _hypercube(len(TABLE_1), repeats, np.random.default_rng(seed))
    drawn = [
        _positive(row, np.array(mean), np.array(deviation))
        for row, (mean, deviation) in zip(quantiles, TABLE_1.values(), strict=True)
    ]
    return [dict(zip(TABLE_1, map(float, values), strict=True)) for values in np.transpose(drawn)]


def draw_stiffness(repeats: int, seed: int) -> list[dict[str, tuple[float, ...]]]:
    """
    Sample the tissue stiffness of each place around Table 2: values at `FORCE_LEVELS` [N/m].

    A place has one quantile per entry, used at all force levels: where the tissue is stiff, it is
    stiff under any force. At every level the symmetric part must be positive definite, or the
    tissue would release energy when it is pressed. A hypercube with a place that violates this is
    replaced by the next of the sequence of generators seeded (seed, 0), (seed, 1), ...
    """
    for attempt in count():
        quantiles = _hypercube(len(TABLE_2), repeats, np.random.default_rng((seed, attempt)))
        drawn = {}
        for row, (entry, (means, deviations)) in zip(quantiles, TABLE_2.items(), strict=True):
            distribution = _positive if entry in _POSITIVE else _normal
            drawn[entry] = distribution(row[:, np.newaxis], np.array(means), np.array(deviations))
        shear = (drawn['k_xz'] + drawn['k_zx']) / 2.0
        if (drawn['k_xx'] * drawn['k_zz'] > shear**2).all():
            break
    return [
        {entry: tuple(map(float, values[place])) for entry, values in drawn.items()}
        for place in range(repeats)
    ]


def _hypercube(entries: int, repeats: int, rng: np.random.Generator) -> FloatArray:
    """Return quantiles, shape (entries, repeats): midpoints of equal strata, each row shuffled."""
    # scipy.stats.qmc does the same, but names its seed differently from release to release.
    strata = np.tile(np.arange(repeats), (entries, 1))
    return np.asarray((rng.permuted(strata, axis=1) + 0.5) / repeats)


def _normal(quantile: FloatArray, mean: FloatArray, deviation: FloatArray) -> FloatArray:
    return np.asarray(mean + deviation * ndtri(quantile))


def _positive(quantile: FloatArray, mean: FloatArray, deviation: FloatArray) -> FloatArray:
    """Return quantiles of the gamma distribution with this mean and standard deviation."""
    return np.asarray(gammaincinv((mean / deviation) ** 2, quantile) * deviation**2 / mean)
