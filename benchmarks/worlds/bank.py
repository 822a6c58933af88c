"""
Prototype of a steering law whose prior can be wrong: a bank of hypotheses.

The hypotheses are the product of bending lengths, of skins from zero on, and of path noises from
1e-4 to 1e-2 rad^2/m, weighed by their evidence as before. A needle that differs from the model is
then explained by path noise, which widens the intervals and makes each measurement count more.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Final

from needle_controller.compiled.hypotheses import HypothesisResponses
from needle_controller.steering.laws.multi_hypothesis import MultiHypothesisLaw
from needle_controller.steering.limits import SteeringLimits
from needle_controller.steering.responses import SteeringModel
from needle_dynamics import FloatArray
from needle_dynamics.arrays import IntArray
import numpy as np
from numpy.typing import ArrayLike

#: Path noises of the hypotheses [rad^2/m].
PATH_NOISES: Final = (1e-4, 1e-3, 1e-2)

#: Skins of the hypotheses: stiffness over the stiffness of the tissue [m].
SKINS: Final = (0.0, 6e-3, 0.02, 0.06)


class BankModel(SteeringModel):
    """The hypotheses of a model for other skins, with a prior covariance for each path noise."""

    def __init__(self, model: SteeringModel) -> None:
        self.__dict__.update(vars(model))
        found: list[HypothesisResponses] = []
        for skin in SKINS:
            stiffness = skin * model.needle.tissue_stiffness
            one = SteeringModel(
                model.needle,
                replace(model.steering, skin_stiffness=stiffness),
                model.depths,
                model.prior,
            )
            # Of the skins of a model the one nearest to 1: the prior is relative there.
            nearest = np.abs(one.skins - 1.0)
            kept = np.flatnonzero(nearest <= nearest.min() + 1e-9)[: len(np.unique(one.lengths))]
            self.lengths = one.lengths[kept]
            found.append(_only(one.responses, kept))
        count, each = len(PATH_NOISES), len(SKINS) * len(self.lengths)
        names = HypothesisResponses._fields
        joined = {
            name: np.concatenate([getattr(one, name) for one in found]) for name in names[:7]
        }
        joined |= {
            name: np.concatenate([getattr(one, name) for one in found]) for name in names[8:]
        }
        guide = joined['guide']
        grid = guide.reshape(len(SKINS), len(self.lengths), *guide.shape[1:])
        between = [np.gradient(grid, axis=axis).reshape(guide.shape) for axis in (1, 0)]
        joined['between'] = np.array(between)
        self.responses = HypothesisResponses(
            **{name: _repeated(values, count, name) for name, values in joined.items()}
        )
        self.lengths = np.tile(self.lengths, len(SKINS) * count)
        covariances = np.repeat(model.prior_covariance[np.newaxis], count * each, axis=0)
        # The variance of the curvature is proportional to the path noise.
        ratios = np.repeat(np.array(PATH_NOISES) / model.prior.path_noise, each)
        covariances[:, 4:-2, 4:-2] *= ratios[:, np.newaxis, np.newaxis]
        self.covariances = covariances


def _only(responses: HypothesisResponses, kept: IntArray) -> HypothesisResponses:
    """Return the responses of some hypotheses."""
    return HypothesisResponses(
        **{
            name: values[:, kept] if name == 'between' else values[kept]
            for name, values in responses._asdict().items()
        }
    )


def _repeated(values: FloatArray, count: int, name: str) -> FloatArray:
    """Repeat responses along the hypotheses."""
    return np.concatenate(count * [values], axis=1 if name == 'between' else 0)


_bank = lru_cache(maxsize=64)(BankModel)


class BankLaw(MultiHypothesisLaw):
    """Our law for a bank of hypotheses; parameters as for `MultiHypothesisLaw`."""

    def __init__(
        self, model: SteeringModel, target: ArrayLike, limits: SteeringLimits, roll: float = 0.0
    ) -> None:
        self._begun = False
        super().__init__(_bank(model), target, limits, roll)

    def aim(self, target: ArrayLike) -> None:
        if not self._begun:
            self._begun = True
            assert isinstance(self._model, BankModel)  # noqa: S101
            self._now.covariance[:] = self._model.covariances
        super().aim(target)
