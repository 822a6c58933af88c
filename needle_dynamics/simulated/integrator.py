# SPDX-License-Identifier: Apache-2.0
"""
Structure-preserving integrator of the needle: frozen-depth modal flow, exact friction flow.

The splitting of a step is described in `needle_dynamics.compiled.step` and docs/architecture.md.
The integrator is of second order, symplectic without friction and damping (the total
displacement then equals drift-kick-drift), sticks exactly, and has no stability limit from the
modes or from viscous friction. Source of the method: E. Hairer, C. Lubich, G. Wanner, "Geometric
Numerical Integration", 2nd ed., 2006, sections II.5 and XIII (splitting, highly oscillatory
problems).
"""

from math import copysign, inf, isfinite, isnan
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.step import advance_boxed, Inputs, Interval
from needle_dynamics.errors import InsertionDepthError
from needle_dynamics.model import NeedleModel
from needle_dynamics.parameters import NeedleParameters
from needle_ros.errors import NeedleError, ParameterError, ShapeError
from needle_ros.settings import checked
import numpy as np
from numpy.typing import ArrayLike

#: Default step [s], for a tip deflection error of 2e-4 in the open-loop run of the source.
DEFAULT_STEP: Final = 1e-5

SHORTEST_STEP: Final = 1e-9  #: shortest step [s]; rounding errors dominate far above it


class Integrator:
    """
    Time integrator of one needle.

    Parameters
    ----------
    parameters : NeedleParameters
        Constants.
    state : array_like, shape (2 (2 + n),)
        Initial state, see `NeedleModel.state_at`.
    step : float
        Longest step [s].
    graded : bool
        Let the step grow with the insertion depth once it exceeds a tenth of the needle length:
        the modal frequencies decrease with its square.

    Examples
    --------
    >>> from needle_dynamics import Integrator, NeedleModel, NeedleParameters
    >>> parameters = NeedleParameters.preset('phantom')
    >>> needle = Integrator(parameters, NeedleModel(parameters).state_at(0.05))
    >>> means = needle.advance(0.1, force=3.0)
    >>> print(f'{needle.depth:.4f} m, {needle.velocity:.4f} m/s, {means.axial_force:.1f} N')
    0.0508 m, 0.0081 m/s, 3.0 N

    """

    def __init__(
        self,
        parameters: NeedleParameters,
        state: ArrayLike,
        step: float = DEFAULT_STEP,
        *,
        graded: bool = False,
    ) -> None:
        self.step = checked_step(step)
        self.graded = graded
        self.time = 0.0  #: time [s], used for swelling tissue
        self._state = np.array(state)
        self._load = np.empty((1, 3))
        self.change(parameters)

    def change(self, parameters: NeedleParameters) -> None:
        """Change the constants; the old ones are kept if the state is not valid for the new."""
        from needle_dynamics.compiled.boxed import Boxed

        model = NeedleModel(parameters)
        self._state = model.checked_state(self._state)
        self.model = model  #: the needle
        self._needle, self._boxed = model.compiled, Boxed(model.compiled)
        self._middle = model.coordinates

    @property
    def state(self) -> FloatArray:
        """Present state, a copy; shape (2 (2 + n),)."""
        return self._state.copy()

    @property
    def depth(self) -> float:
        """Insertion depth s [m]."""
        return self._needle.length - float(self._state.item(0))

    @property
    def velocity(self) -> float:
        """Insertion velocity s_dot [m/s]."""
        return -float(self._state.item(self._middle))

    def advance(
        self,
        duration: float,
        force: float = 0.0,
        torque: float = 0.0,
        loads: FloatArray | None = None,
    ) -> Interval:
        """
        Advance for a duration [s] under a constant force f_y [N] and torque tau [N m] at the base.

        ``loads``, shape (parts, 3), takes the mean forces along y and z [N] and the mean moment
        about x [N m] of the base in parts of equal duration, at whose ends steps end.
        InsertionDepthError if the depth left its range; the state is then the last valid one.
        """
        if loads is None:
            loads = self._load
        elif loads.shape[1:] != (3,) or not (
            loads.size and loads.flags.carray and loads.dtype == np.float64
        ):
            raise ShapeError(
                'loads must be writable, contiguous, of shape (parts, 3), got '
                f'{loads.shape}, {loads.dtype}'
            )
        return self._run(duration, Inputs(float(force), float(torque), 0.0, False), loads)

    def advance_moved(self, duration: float, velocity: float) -> Interval:
        """Advance for a duration [s] with a linear change of the base velocity [m/s]."""
        # The axial force is the force required by the motion, without a limit. At rest, friction
        # takes the value within its bounds that minimizes this force.
        return self._run(duration, Inputs(0.0, 0.0, float(velocity), True), self._load)

    def advance_pushed(self, duration: float, force: float, speed_limit: float) -> Interval:
        """Advance for a duration [s] under a base force [N], up to a speed [m/s]."""
        # At the limit the axial force is the force required by the motion.
        before, clock, depth = self._state.copy(), self.time, self.depth
        direction = force
        try:
            means = self.advance(duration, force)
        except InsertionDepthError:
            # At the speed limit the depth may stay within its range.
            too_fast = True
        else:
            # The hub may have stopped a motion that was too fast.
            gone = abs(self.depth - depth)
            too_fast = max(abs(self.velocity), gone / duration) > speed_limit
            direction = self.velocity or force
        if too_fast:
            self._state[:], self.time = before, clock
            means = self.advance_moved(duration, copysign(speed_limit, direction))
        return means

    def _run(self, duration: float, inputs: Inputs, loads: FloatArray) -> Interval:
        if not 0.0 < duration < inf:
            raise ParameterError(f'duration must be positive and finite, got {duration!r} s')
        for name, value in zip(('force', 'torque', 'velocity'), inputs[:3], strict=True):
            if not isfinite(value):
                raise ParameterError(f'{name} must be finite, got {value!r}')
        # An integer would cause the step to be compiled for another type.
        duration = float(duration)
        left, means = advance_boxed(
            self._boxed, self._state, self.time, inputs, self.step, self.graded, duration, loads
        )
        if left != 0.0:
            if left > 0.0:
                self.time += duration - left
            raise not_completed(self.model, self._state, left)
        self.time += duration
        return means


def not_completed(model: NeedleModel, state: FloatArray, left: float) -> NeedleError:
    """Return the error of a motion with ``left`` [s] remaining: outside the range, not finite."""
    if isnan(left):
        return NeedleError('the motion is not finite: constants, state or inputs are badly scaled')
    p, far = model.parameters, model.compiled.maximum_depth
    depth = p.length - float(state[0])
    limit = (
        f'minimum_depth = {p.minimum_depth:g} m while withdrawing'
        if depth - p.minimum_depth < far - depth
        else f'the largest insertion depth, {far:g} m'
    )
    return InsertionDepthError(f'insertion depth {depth:.6g} m reached {limit}')


def checked_step(step: float) -> float:
    """Check a longest step [s] and return it as a float."""
    return checked('step', step, 's', low=SHORTEST_STEP)
