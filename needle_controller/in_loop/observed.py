# SPDX-License-Identifier: Apache-2.0
"""Observer of a closed loop in simulation, with a tip sensor and without a wrench."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from math import ceil
from typing import Final, NamedTuple, TYPE_CHECKING

from needle_controller.compiled.filter import Filter
from needle_controller.compiled.loop_observer import HEAD, LoopObserver
from needle_controller.load_estimator import CHECK_INTERVAL, WARM_UP
from needle_controller.observer.observer import empty_filter, largest_mean
from needle_controller.observer.settings import ObserverSettings
from needle_dynamics import NeedleModel, NeedleParameters
from needle_dynamics.compiled.lane_rows import LANES
import numpy as np

if TYPE_CHECKING:
    from needle_dynamics.compiled.boxed import Boxed

_EXPOSURE: Final = 1e-3  #: exposure of the tip sensor, relative to the period


class TipObserver(NamedTuple):
    """
    Observer that measures the tip at each sample, and its nominal model.

    `settings` are those of `Observer`, of which the wrench and `tip_latency` are not used. The
    exposure is short, so that the tip measurement is of the time of the sample.
    """

    parameters: NeedleParameters  #: nominal needle and tissue
    settings: ObserverSettings
    period: float  #: sample period [s]
    largest: float  #: largest plausible load [N]; a larger one restarts the observer

    @property
    def used(self) -> ObserverSettings:
        """Settings with the exposure, and a wrench without filters."""
        return replace(
            self.settings, tip_exposure=_EXPOSURE * self.period, tip_latency=0.0, cutoffs=(),
            filter_rate=1.0 / self.period,
        )  # fmt: skip


def compiled_observer(observer: TipObserver) -> tuple[LoopObserver, Boxed[Filter]]:
    """Return observers for all lanes."""
    settings, period = observer.used, observer.period
    history = ceil(settings.history / period) + 2
    own = LoopObserver(
        memory=np.zeros((LANES, HEAD + history)),
        exposure=settings.tip_exposure,
        largest=observer.largest,
        interval=CHECK_INTERVAL,
        known=int(WARM_UP * settings.history / period),
        far=largest_mean(history),
    )
    return own, _boxed(observer.parameters, settings, LANES)


@cache
def no_observer() -> tuple[LoopObserver, Boxed[Filter]]:
    """Return arguments of the compiled loop without observers."""
    none = LoopObserver(np.zeros((0, HEAD)), 1.0, 0.0, 1, 0, 0.0)
    return none, _boxed(NeedleParameters(), ObserverSettings(), 0)


def _boxed(parameters: NeedleParameters, settings: ObserverSettings, rows: int) -> Boxed[Filter]:
    from needle_dynamics.compiled.boxed import Boxed

    return Boxed(empty_filter(NeedleModel(parameters), settings, 1, 2 * rows, 1))
