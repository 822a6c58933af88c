# SPDX-License-Identifier: Apache-2.0
"""
States and shapes of a flexible needle in soft tissue, and the stiffness against its bending.

The generalized coordinates are q = [d, theta, q1, ..., qn] and the state is X = [q, q_dot]:
eight numbers for n = 2. d is the length of needle outside the tissue and decreases during
insertion.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.integrals import ModeIntegrals, tip_deflections
from needle_dynamics.compiled.tissue import Layers
from needle_dynamics.errors import InsertionDepthError
from needle_dynamics.modes import mode_shapes, ModeShapes
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.tissue import Tissue
from needle_ros.errors import ParameterError, ShapeError
import numpy as np
from numpy.typing import ArrayLike

ROUNDING: Final = 1e-12  #: rounding tolerance of an insertion depth, relative to the needle length


@dataclass(frozen=True)
class NeedleStatics:
    """Shape modes and tissue of a needle, its states, and their shapes, in SI units."""

    parameters: NeedleParameters

    @cached_property
    def modes(self) -> ModeShapes:
        """Shape modes of the needle."""
        p = self.parameters
        return mode_shapes(p.length, p.modes, p.reach)

    @cached_property
    def tissue(self) -> Tissue:
        """Tissue along the needle."""
        return self.parameters.tissue

    @cached_property
    def layers(self) -> Layers:
        """Integrals over the layers of the tissue."""
        return self.tissue.layers(self.modes)

    @property
    def coordinates(self) -> int:
        """Number of generalized coordinates, 2 + n."""
        return 2 + self.parameters.modes

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        """Names of the generalized coordinates, in order: d, theta, q1, ..., qn."""
        return ('d', 'theta', *(f'q{i + 1}' for i in range(self.parameters.modes)))

    def checked_state(self, state: ArrayLike) -> FloatArray:
        """Return a copy of a state, or raise ShapeError or InsertionDepthError."""
        try:
            checked = np.array(state, dtype=float)
        except (TypeError, ValueError):
            raise ShapeError(f'state must be numbers, got {state!r}') from None
        if checked.shape != (2 * self.coordinates,):
            raise ShapeError(
                f'state must have shape ({2 * self.coordinates},), got {checked.shape}'
            )
        if not np.isfinite(checked).all():
            raise ShapeError(f'state must be finite, got {checked.tolist()}')
        p = self.parameters
        depth = p.length - checked[0]
        high = self.modes.reach * p.length
        # The insertion depth is a difference, so its limits hold up to rounding.
        if not p.minimum_depth - ROUNDING * p.length <= depth <= high:
            raise InsertionDepthError(
                f'insertion depth {depth:.6g} m is outside [{p.minimum_depth:g}, {high:g}] m '
                '(minimum_depth to the hub)'
            )
        return checked

    def _stiffness(self, at: ModeIntegrals, depth: float, time: float) -> FloatArray:
        tissue, layer = self.tissue, self.tissue.layer(depth)
        above = self.layers.gram[layer]
        elastic = tissue.growth(time) * (tissue.stiffnesses[layer] * at.gram + above)
        return np.asarray(self.parameters.bending_stiffness * at.curvature_gram + elastic)

    def state_at(
        self, depth: float, tip_deflection: float = 0.0, modal: Sequence[float] = ()
    ) -> FloatArray:
        """
        Return the state at rest at an insertion depth [m], with a tip deflection [m] or shape.

        With a tip deflection w(s), the shape is the static shape under a lateral force at the tip,
        which has the least elastic energy for that deflection. (The source gives only the tip
        deflection.) ``modal``, q1 to qn [m^3/2], gives the shape instead.
        """
        state = np.zeros(2 * self.coordinates)
        state[0] = self.parameters.length - depth
        state = self.checked_state(state)
        if len(modal):
            if len(modal) != self.modes.count:
                raise ShapeError(f'modal must have {self.modes.count} numbers, got {modal!r}')
            if tip_deflection != 0.0:
                raise ParameterError(
                    'modal and tip_deflection both define the shape: '
                    f'one must be empty or 0, got {modal!r} and {tip_deflection!r} m'
                )
            state[2 : self.coordinates] = modal
            return self.checked_state(state)
        at = self.modes.integrals(depth)
        shape = np.linalg.solve(self._stiffness(at, depth, 0.0), at.value)
        state[2 : self.coordinates] = shape * (tip_deflection / (at.value @ shape))
        return self.checked_state(state)

    def stiffness_matrix(self, depth: float, time: float = 0.0) -> FloatArray:
        """Return the modal stiffness E I_y H + k_a G [N/m] from (12), shape (n, n)."""
        return self._stiffness(self.modes.integrals(depth), depth, time)

    def tip_deflection(self, state: ArrayLike) -> float:
        """Return the deflection of the tip Y = w(s, t) along z [m], the output of the model."""
        return float(self.tip_deflections(self.checked_state(state)[np.newaxis])[0])

    def tip_deflections(self, states: ArrayLike) -> FloatArray:
        """Return the tip deflections [m], shape (...), of many valid states; NaN for NaN."""
        x = np.ascontiguousarray(states, dtype=float)
        rows = x.reshape(-1, 2 * self.coordinates)
        return tip_deflections(self.modes.tables, rows).reshape(x.shape[:-1])

    def shape(self, state: ArrayLike, points: int = 50) -> FloatArray:
        """Return points y and w(y) [m] from entry point to tip, equation (10); (points, 2)."""
        x = self.checked_state(state)
        if not isinstance(points, int) or points < 2:
            raise ShapeError(f'points must be an integer >= 2, got {points!r}')
        y = np.linspace(0.0, self.parameters.length - x[0], points)
        return np.column_stack([y, self.modes.values(y) @ x[2 : self.coordinates]])
