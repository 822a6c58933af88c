"""Tissue stiffness at a place, by force level."""

from __future__ import annotations

from dataclasses import dataclass

from needle_dynamics.arrays import FloatArray
from needle_identification.estimation.estimate import Named, ParameterEstimate
from needle_identification.stiffness.presses import Presses
import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class LevelEstimate(Named[ParameterEstimate]):
    """
    Stiffness at a force level.

    Attributes
    ----------
    force : float
        Mean magnitude of the force [N].
    parameters : tuple of ParameterEstimate
        k_xx, k_xz, k_zx, k_zz [N/m].
    curl : ParameterEstimate
        k_zx - k_xz [N/m], the curl of the force of the tissue -K d.
    spring : ParameterEstimate
        Frobenius norm of the antisymmetric part of K over the norm of the symmetric part [1]. It
        is nonnegative and biased upward near zero. Its interval has the nominal coverage and
        contains zero if the interval of the curl does.
    is_spring : bool
        Whether the whole interval of ``spring`` is within the setting ``largest_asymmetry``.
    words : str
        Whether the tissue is a spring, and why.
    principal : (ParameterEstimate, ParameterEstimate)
        Larger and smaller principal stiffness, of the symmetric part [N/m].
    angle : ParameterEstimate
        Direction of the larger stiffness, from x toward z, in (-pi/2, pi/2] [rad]; not
        determined if the two agree within their errors.
    tissue_stiffness : ParameterEstimate
        k_a = k_zz / contact length [N/m^2].
    presses, directions : int
        Number of used presses and of directions.
    residual : float
        Root mean square of force minus K d [N].
    determination : float
        Coefficient of determination R^2.
    condition : float
        Condition number of the displacements; large for a single direction.

    """

    force: float
    parameters: tuple[ParameterEstimate, ...]
    curl: ParameterEstimate
    spring: ParameterEstimate
    is_spring: bool
    words: str
    principal: tuple[ParameterEstimate, ParameterEstimate]
    angle: ParameterEstimate
    tissue_stiffness: ParameterEstimate
    presses: int
    directions: int
    residual: float
    determination: float
    condition: float

    def _named(self) -> tuple[ParameterEstimate, ...]:
        others = (self.curl, self.spring, *self.principal, self.angle, self.tissue_stiffness)
        return (*self.parameters, *others)

    def __repr__(self) -> str:
        (k_xx, k_xz), (k_zx, k_zz) = self.matrix.tolist()
        matrix = f'[[{k_xx:.4g}, {k_xz:.4g}], [{k_zx:.4g}, {k_zz:.4g}]] N/m'
        return f'<LevelEstimate at {self.force:.3g} N: K = {matrix}>'

    @property
    def matrix(self) -> FloatArray:
        """K [N/m], shape (2, 2), rows of force, columns of displacement; nan if undetermined."""
        return np.array([p.value for p in self.parameters]).reshape(2, 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class StiffnessEstimate:
    """
    Tissue stiffness at a place.

    Attributes
    ----------
    name : str
        Name of the recording.
    levels : tuple of LevelEstimate
        By force, in ascending order.
    off_plane : float
        Largest ratio of displacement out of the plane to displacement in the plane.
    warnings : tuple of str
        Warnings about the validity of the estimate.
    presses : Presses
        Fitted presses.

    """

    name: str
    levels: tuple[LevelEstimate, ...]
    off_plane: float
    warnings: tuple[str, ...]
    presses: Presses

    def __repr__(self) -> str:
        forces = ', '.join(f'{level.force:.3g}' for level in self.levels)
        return f'<StiffnessEstimate of {self.name}: force levels {forces} N>'
