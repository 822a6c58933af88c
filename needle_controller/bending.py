"""What is known of the bending of the needle, and the load that it adds to the insertion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from needle_controller.controller import Measurement
from needle_controller.observer.observer import Observer
from needle_dynamics import NeedleModel, NeedleParameters
from needle_ros.errors import ParameterError
from needle_ros.timing import NANOSECONDS
import numpy as np

#: Samples between two looks at the consistency of the observer.
_LOOK: Final = 25


class Bending:
    """
    The load of the bent needle: from an observer, from the simulation, or zero.

    Stamps are integers in ns.

    Parameters
    ----------
    parameters : NeedleParameters
        Needle and tissue.
    observer : Observer, optional
        Estimates the bending from tip and wrench.
    largest : float
        Load that no needle has [N]; an observer that says so is started anew.

    Attributes
    ----------
    load : float
        Force against insertion [N]; zero where it is not known, or the observer is doubtful.
    warning : str or None
        Why the observer is doubtful.
    model : NeedleModel
        The needle, for the load of a true state.
    observer : Observer or None
        As given.

    """

    def __init__(
        self,
        parameters: NeedleParameters,
        observer: Observer | None = None,
        largest: float = 1e6,
    ) -> None:
        self.model = NeedleModel(parameters)
        self.observer, self._largest = observer, largest
        self.forget()

    def forget(self) -> None:
        """Know nothing of what was measured."""
        self.load = 0.0
        self.warning: str | None = None
        self._updates = 0
        #: Stamp, lateral force and moment of the last wrench that no measurement has taken.
        self._waiting: tuple[int, float, float] | None = None
        if self.observer is not None:
            self.observer.reset()

    def take_tip(self, stamp: int, deflection: float) -> None:
        """
        Take in the deflection of the tip [m].

        Parameters
        ----------
        stamp : int
            Its stamp [ns].
        deflection : float
            Deflection of the tip [m].

        """
        if self.observer is not None:
            self.observer.add_tip(stamp / NANOSECONDS, deflection)

    def take_wrench(self, stamp: int, lateral: float, moment: float, measured: int) -> None:
        """
        Take in force [N] and moment [N m]; one newer than the encoders waits for them.

        Parameters
        ----------
        stamp : int
            Its stamp [ns].
        lateral, moment : float
            Force along z [N], and moment about x at the base [N m] without the torque.
        measured : int
            Stamp of the newest encoder sample [ns].

        """
        if self.observer is None:
            return
        if stamp > measured:
            self._waiting = stamp, lateral, moment
        else:
            self.observer.add_wrench(stamp / NANOSECONDS, lateral, moment)

    def take_truth(self, state: Sequence[float]) -> None:
        """
        Take the load from a true state, or raise NeedleError if it has none.

        Parameters
        ----------
        state : sequence of float, shape (2 (2 + n),)
            State of the simulation, SI units.

        Raises
        ------
        NeedleError
            If the state has no load.

        """
        self.load = 0.0
        # What is finite may be too large all the same.
        with np.errstate(over='ignore', invalid='ignore'):
            load = -float(self.model.bias_forces(state)[0])
        if not abs(load) <= self._largest:
            raise ParameterError(f'such a needle has a load of {load:.3g} N')
        self.load = load

    def update(self, stamp: int, measured: Measurement) -> None:
        """
        Take in the encoders and the wrench of the same stamp, or raise NeedleError.

        Parameters
        ----------
        stamp : int
            Stamp of the encoder sample [ns].
        measured : Measurement
            The encoders.

        Raises
        ------
        NeedleError
            If the observer cannot take it.

        """
        observer, wrench = self.observer, self._waiting
        if observer is None:
            return
        own = wrench[1:] if wrench is not None and wrench[0] == stamp else None
        if wrench is not None and wrench[0] <= stamp:
            self._waiting = None
        self.load = 0.0
        observer.update(stamp / NANOSECONDS, measured.depth, measured.speed, own)
        self._updates += 1
        if self._updates % _LOOK == 0:
            self._judge(observer)
        if not abs(observer.load) <= self._largest:
            load = observer.load
            self.forget()
            raise ParameterError(f'a load of {load:.3g} N is absurd; the observer started anew')
        if self.warning is None:
            self.load = observer.load

    def _judge(self, observer: Observer) -> None:
        """See whether the errors of the observer are as large as it says."""
        # What it begins with is a guess, and counts as long as the history has it.
        known = self._updates * observer.period > 1.2 * observer.settings.history
        nis = observer.nis
        self.warning = None
        if known and nis.doubtful:
            self.warning = (
                f'the observer does not explain what is measured: NIS is {nis.ratio:.2f} '
                f'instead of 1; the load of the bent needle is not used'
            )

    def describe(self) -> dict[str, object]:
        """Return what diagnostics say of the observer, if there is one that has begun."""
        observer = self.observer
        if observer is None or not observer.ready:
            return {}
        consistency, (tip, spread) = observer.nis, observer.tip_deflection
        force, deviation = observer.tip_force
        return {
            'tip deflection [m]': f'{tip:.6f} +- {spread:.6f}',
            'load of the bent needle [N]': f'{observer.load:.4f}',
            'observer consistency (NIS)': (
                f'{consistency.ratio:.3f} in [{consistency.low:.3f}, {consistency.high:.3f}]'
            ),
            'lateral force at the tip [N]': f'{force:.3f} +- {deviation:.3f}',
            'observer samples refused': observer.refused,
            'observer restarts': observer.restarts,
            'observer warning': observer.warning or '',
        }
