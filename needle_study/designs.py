# SPDX-License-Identifier: Apache-2.0
"""
Sampling designs: uniform numbers, noise and replicate of each sample of a study.

The replicates of a Sobol sequence are scrambled independently [Owen1998]_. Sobol' indices are
computed from groups of samples [Saltelli2010]_.

References
----------
.. [Owen1998] A. B. Owen, "Scrambling Sobol' and Niederreiter-Xing points", Journal of Complexity
   14, 1998.
.. [Saltelli2010] A. Saltelli et al., "Variance based sensitivity analysis of model output",
   Computer Physics Communications 181, 2010.

"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

from needle_dynamics.arrays import FloatArray, IntArray
from needle_ros.errors import ParameterError
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri
from scipy.stats import qmc

#: Smallest and largest probability at which a quantile is evaluated.
INSIDE: Final = 2.0**-54
BELOW: Final = 1.0 - 2.0**-53

#: Independent sequences of a Sobol design, whose scatter gives the intervals.
REPLICATES: Final = 16

#: Largest number of samples of a Latin hypercube: each process holds a permutation per dimension.
_MOST_LATIN: Final = 2**24


@dataclass(frozen=True, eq=False)
class RandomDesign:
    """Independent samples, and base of the other designs."""

    samples: int  #: number of samples
    seed: int  #: of the study
    factor: FloatArray  #: Cholesky factor of the correlations of the normal scores, shape (d, d)

    name = 'random'  #: of the study file
    replicates = 0  #: number of independent parts; 0 if all samples are independent
    mixes = True  #: whether correlations are applied to the uniform numbers

    @property
    def dimensions(self) -> int:
        return len(self.factor)

    @property
    def is_correlated(self) -> bool:
        return not np.array_equal(self.factor, np.eye(self.dimensions))

    def rng(self, *key: int) -> np.random.Generator:
        """Return the random generator of a key, such as a sample and 0."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key))

    def noise(self, number: int) -> np.random.Generator:
        return self.rng(number, 1)

    def replicate(self, numbers: IntArray) -> IntArray:
        """Return the independent part of each sample."""
        return numbers

    def parts(self, first: int, count: int) -> FloatArray:
        """Return the probabilities of the quantiles of consecutive samples, shape (count, d)."""
        parts = np.clip(self.uniform(first, count), INSIDE, BELOW)
        if self.mixes and self.is_correlated:
            scores = ndtri(parts)
            parts = np.array([ndtr(_mixed(row, scores.T)) for row in self.factor]).T
        return np.asarray(np.clip(parts, INSIDE, BELOW))

    def uniform(self, first: int, count: int) -> FloatArray:
        """Return uniform numbers in (0, 1) of consecutive samples, shape (count, d)."""
        each = [
            self.rng(number, 0).random(self.dimensions) for number in range(first, first + count)
        ]
        return np.array(each).reshape(count, self.dimensions)


@dataclass(frozen=True, eq=False)
class LatinDesign(RandomDesign):
    """Latin hypercube: each of equal parts of every distribution has one sample."""

    name = 'latin'
    mixes = False  # its strata are correlated

    def __post_init__(self) -> None:
        if self.samples > _MOST_LATIN:
            raise ParameterError(
                f'design latin takes at most {_MOST_LATIN} samples, got {self.samples}'
            )

    def uniform(self, first: int, count: int) -> FloatArray:
        uniform = super().uniform(first, count)
        rows = map(tuple, self.factor.tolist())
        strata = [_strata(self.samples, self.seed, row)[first : first + count] for row in rows]
        return np.asarray((np.transpose(strata) + uniform) / self.samples).reshape(uniform.shape)


class SobolDesign(RandomDesign):
    """Independently scrambled Sobol sequences, which take turns."""

    name = 'sobol'
    replicates = REPLICATES

    def replicate(self, numbers: IntArray) -> IntArray:
        return numbers % REPLICATES

    def uniform(self, first: int, count: int) -> FloatArray:
        return self.points(first, count, self.dimensions)

    def points(self, first: int, count: int, dimensions: int) -> FloatArray:
        """Return consecutive points of the sequences in turn, shape (count, dimensions)."""
        found = np.empty((count, dimensions))
        for replicate in range(REPLICATES if dimensions else 0):
            at = np.arange((replicate - first) % REPLICATES, count, REPLICATES)
            if len(at):
                sequence = qmc.Sobol(dimensions, seed=self.rng(replicate, 0, 1))
                if skipped := (first + int(at[0])) // REPLICATES:
                    sequence.fast_forward(skipped)
                # A single sample first: scipy warns of a first draw that is not a power of 2.
                found[at] = [*sequence.random(1), *sequence.random(len(at) - 1)]
        return found


@dataclass(frozen=True, eq=False)
class SaltelliDesign(SobolDesign):
    """
    Groups of samples for Sobol' indices, where the noise is a variable, too.

    A group has a sample A, a sample B, A with the noise of B, and for each variable A with the
    value of this variable in B.
    """

    name = 'saltelli'

    def __post_init__(self) -> None:
        if self.is_correlated:
            raise ParameterError(
                'design saltelli takes no correlations: Sobol indices are of independent variables'
            )

    @property
    def group(self) -> int:
        return self.dimensions + 3

    def noise(self, number: int) -> np.random.Generator:
        group, place = divmod(number, self.group)
        return self.rng(group, 2 if place in (1, 2) else 1)

    def replicate(self, numbers: IntArray) -> IntArray:
        return super().replicate(numbers // self.group)

    def uniform(self, first: int, count: int) -> FloatArray:
        begin, d = first // self.group, self.dimensions
        groups = (first + count - 1) // self.group + 1 - begin
        points = self.points(begin, groups, 2 * d).reshape(groups, 1, 2, d)
        samples = np.repeat(points[:, :, 0], self.group, axis=1)
        samples[:, 1] = points[:, 0, 1]
        for k in range(d):
            samples[:, 3 + k, k] = points[:, 0, 1, k]
        here = first - begin * self.group
        return samples.reshape(-1, d)[here : here + count]


#: Designs of the study file, the default first.
DESIGNS: Final = {
    one.name: one for one in (SobolDesign, RandomDesign, LatinDesign, SaltelliDesign)
}


def _mixed(row: Sequence[float], scores: Iterable[FloatArray]) -> FloatArray:
    # No matrix product: its bits may depend on the number of rows.
    return np.asarray(sum(f * one for f, one in zip(row, scores, strict=False)))


@lru_cache(maxsize=64)
def _strata(count: int, seed: int, row: tuple[float, ...]) -> NDArray[np.uint32]:
    """
    Return the strata of a dimension by sample, with its row of the Cholesky factor.

    Each has one sample, also with correlations: they are in the order of correlated normal scores.
    Source: R. L. Iman, W. J. Conover, Communications in Statistics B 11 (1982), 311.
    """
    dimension = max(np.flatnonzero(row))
    if dimension and any(row[:dimension]):
        scores = (
            ndtri((_permutation(count, seed, k) + 0.5) / count) for k in range(dimension + 1)
        )
        strata = np.empty(count, dtype=np.uint32)
        strata[np.argsort(_mixed(row, scores), kind='stable')] = np.arange(count)
        return strata
    return _permutation(count, seed, int(dimension))


def _permutation(count: int, seed: int, dimension: int) -> NDArray[np.uint32]:
    # The generators of samples have two numbers in their key, this generator has three.
    key = np.random.SeedSequence(seed, spawn_key=(dimension, 0, 0))
    return np.random.default_rng(key).permutation(np.arange(count, dtype=np.uint32))
