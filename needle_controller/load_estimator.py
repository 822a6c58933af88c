# SPDX-License-Identifier: Apache-2.0
"""Load of the bent needle on the insertion axis, from an observer or from the simulation."""

from collections.abc import Sequence
from typing import Final

from needle_controller.controller import Measurement
from needle_controller.observer.observer import NEAREST, Observer
from needle_controller.observer.settings import ObserverSettings
from needle_dynamics import NeedleModel, NeedleParameters
from needle_ros.errors import ParameterError
from needle_ros.status import ObserverStatus
from needle_ros.timing import NANOSECONDS
import numpy as np

CHECK_INTERVAL: Final = 25  #: Samples between two consistency checks of the observer.
WARM_UP: Final = 1.2  #: Time after the start without a check, as a multiple of the history.


def build_observer(
    parameters: NeedleParameters, settings: ObserverSettings, period: float
) -> Observer:
    """Return an observer with a sample period [s]; its errors name the parameter of the node."""
    try:
        return Observer(parameters, settings, period)
    except ParameterError as error:
        raise ParameterError(f'observer.{error}') from error


class LoadEstimator:
    """
    Load of the bent needle up to ``largest`` [N], of an observer or the simulation, or zero.

    Encoders and tip wait for `update`, so that no command waits for the observer.
    """

    def __init__(
        self, parameters: NeedleParameters, observer: Observer | None = None, largest: float = 1e6
    ) -> None:
        self.model = NeedleModel(parameters)
        self.observer, self._largest = observer, largest
        self.forget()

    def forget(self) -> None:
        #: Force against insertion [N]; zero if it is unknown or the observer is inconsistent.
        self.load = 0.0
        self.warning: str | None = None  #: Why the observer is inconsistent.
        self._updates = 0
        self._updated = -1  #: Stamp of the last encoder sample of an update [ns].
        #: Stamp, lateral force and moment of the last wrench that waits for the encoders, and
        #: encoders and tip that wait for the update, with their stamps [ns].
        self._waiting: tuple[int, float, float] | None = None
        self._encoders: tuple[int, Measurement] | None = None
        self._tip: tuple[int, float] | None = None
        if self.observer is not None:
            self.observer.reset()

    def take_tip(self, stamp: int, deflection: float) -> None:
        """Add a deflection of the tip [m] with its stamp [ns]."""
        if self._tip is not None and self.observer is not None:
            self.observer.add_tip(*self._tip)
        self._tip = stamp, deflection

    def take_wrench(self, stamp: int, lateral: float, moment: float) -> None:
        """
        Add lateral force along z [N] and moment about x at the base without the torque [N m].

        It belongs to the encoder sample that is nearest in time, and waits for its update.
        """
        if self.observer is None:
            return
        if self.waits or stamp > self._updated:
            self._waiting = stamp, lateral, moment
        else:
            self.observer.add_wrench(stamp, lateral, moment)

    def take_truth(self, state: Sequence[float]) -> None:
        """Set the load from a true state, shape (2 (2 + n),), which must have a valid load."""
        self.load = 0.0
        # Finite states may overflow.
        with np.errstate(over='ignore', invalid='ignore'):
            load = -float(self.model.bias_forces(state)[0])
        if not abs(load) <= self._largest:
            raise ParameterError(f'implausible load of {load:.3g} N')
        self.load = load

    def take_encoders(self, stamp: int, measured: Measurement) -> None:
        """Add an encoder sample with its stamp [ns]."""
        self._encoders = stamp, measured

    @property
    def waits(self) -> bool:
        """Whether an encoder sample waits for the update."""
        return self._encoders is not None

    def update(self) -> None:
        """Update the load with the encoder sample that waits, and the wrench and tip before it."""
        observer, encoders, tip = self.observer, self._encoders, self._tip
        self._encoders = self._tip = None
        if observer is None or encoders is None:
            return
        if tip is not None:
            observer.add_tip(*tip)
        stamp, measured = encoders
        own, self._updated = None, stamp
        if (wrench := self._waiting) is not None:
            later = (wrench[0] - stamp) / NANOSECONDS / observer.period
            if later <= NEAREST:
                self._waiting = None
            if abs(later) <= NEAREST:
                own = wrench[1:]
            elif later < 0.0:
                observer.add_wrench(*wrench)
        self.load = 0.0
        observer.update(stamp, measured.depth, measured.velocity, own)
        self._updates += 1
        if self._updates % CHECK_INTERVAL == 0:
            self._check_consistency(observer)
        load = observer.load
        if not abs(load) <= self._largest:
            self.forget()
            raise ParameterError(f'implausible load estimate of {load:.3g} N; observer restarted')
        if self.warning is None:
            self.load = load

    def _check_consistency(self, observer: Observer) -> None:
        # The initial state is a guess, and affects the NIS while the history contains it.
        known = self._updates * observer.period > WARM_UP * observer.settings.history
        nis = observer.nis
        self.warning = None
        if known and nis.doubtful:
            self.warning = (
                f'the observer is inconsistent with the measurements: NIS is {nis.ratio:.2f} '
                f'instead of 1; the load of the bent needle is not used'
            )

    def status(self) -> ObserverStatus | None:
        observer = self.observer
        if observer is None or not observer.ready:
            return None
        nis, (tip, deviation) = observer.nis, observer.tip_deflection
        force, force_deviation = observer.tip_force
        return ObserverStatus(
            tip_deflection=tip,
            tip_deflection_deviation=deviation,
            tip_force=force,
            tip_force_deviation=force_deviation,
            load=observer.load,
            nis=nis.ratio,
            nis_interval=(nis.low, nis.high),
            rejected=observer.refused,
            restarts=observer.restarts,
            warning=observer.warning or '',
        )
