"""
Parameters of the stand-ins, drawn so that few repeats represent the paper's Tables 1 and 2.

The tables give mean and standard deviation over 20 experiments. Each repeat takes its values from
a Latin hypercube: with n repeats every quantity takes each of the quantiles (k + 1/2)/n once, in
an order of its own. Quantities that cannot be negative follow a gamma distribution, the others a
normal one.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import count
from typing import Final

from needle_dynamics import FloatArray
import numpy as np
from scipy.special import gammaincinv, ndtri

#: Table 1: mean and standard deviation of mu_s [N] and mu_v [N s/m], 0.3 read as N s/mm.
TABLE_1: Final[Mapping[str, tuple[float, float]]] = {
    'coulomb_friction': (0.56, 0.0374),
    'viscous_friction': (300.0, 44.7),
}

#: Force levels of Table 2 [N].
FORCE_LEVELS: Final = (1.1, 1.2, 1.3, 1.4, 1.5)

#: Table 2: means and standard deviations by entry, at each force level [N/m].
TABLE_2: Final[Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]]] = {
    'k_xx': ((1260.0, 820.0, 1100.0, 1030.0, 960.0), (80.0, 540.0, 110.0, 120.0, 120.0)),
    'k_xz': ((40.0, 40.0, 10.0, 1.0, -5.0), (80.0, 70.0, 90.0, 80.0, 80.0)),
    'k_zx': ((-100.0, -100.0, -110.0, -110.0, -110.0), (60.0, 100.0, 90.0, 90.0, 90.0)),
    'k_zz': ((1010.0, 810.0, 690.0, 600.0, 520.0), (110.0, 150.0, 180.0, 190.0, 180.0)),
}

#: Entries that cannot be negative.
_POSITIVE: Final = ('k_xx', 'k_zz')


def draw_friction(repeats: int, seed: int) -> list[dict[str, float]]:
    """
    Draw the friction of each repeat around Table 1.

    Parameters
    ----------
    repeats : int
        How many.
    seed : int
        The same seed gives the same draws.

    Returns
    -------
    list of dict
        Values by the keys of `TABLE_1`.

    """
    quantiles = _hypercube(len(TABLE_1), repeats, np.random.default_rng(seed))
    drawn = [
        _positive(row, np.array(mean), np.array(deviation))
        for row, (mean, deviation) in zip(quantiles, TABLE_1.values(), strict=True)
    ]
    return [dict(zip(TABLE_1, map(float, values), strict=True)) for values in np.transpose(drawn)]


def draw_stiffness(repeats: int, seed: int) -> list[dict[str, tuple[float, ...]]]:
    """
    Draw the tissue stiffness of each place around Table 2.

    A place has one quantile per entry, used at all force levels: where the tissue is stiff, it is
    stiff under any force. At every level the symmetric part must be positive definite, or the
    tissue would yield energy when pressed: a hypercube with a place that breaks this is
    replaced by the next of the sequence of generators seeded (seed, 0), (seed, 1), ...

    Parameters
    ----------
    repeats : int
        How many places.
    seed : int
        The same seed gives the same draws.

    Returns
    -------
    list of dict
        Values at `FORCE_LEVELS` [N/m] by the keys of `TABLE_2`.

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
    """Return quantiles of the gamma distribution with that mean and standard deviation."""
    return np.asarray(gammaincinv((mean / deviation) ** 2, quantile) * deviation**2 / mean)
