"""Stiffness at one place of the tissue, by force level."""

from __future__ import annotations

from dataclasses import dataclass

from needle_dynamics.arrays import FloatArray
from needle_identification.estimation.estimate import Named, ParameterEstimate
from needle_identification.stiffness.presses import Presses
import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class LevelEstimate(Named[ParameterEstimate]):
    """
    Stiffness at one force level.

    Attributes
    ----------
    force : float
        Mean magnitude of the force [N].
    parameters : tuple of ParameterEstimate
        k_xx, k_xz, k_zx, k_zz [N/m].
    curl : ParameterEstimate
        k_zx - k_xz [N/m], the curl of the force of the tissue -K d.
    spring : ParameterEstimate
        Frobenius norm of the antisymmetric part of K over that of the symmetric part [1]. It is
        never negative and, near zero, too large on average. Its interval is right there too: it
        holds zero where that of the curl does.
    is_spring : bool
        Whether all of the interval of ``spring`` is within the setting ``largest_asymmetry``.
    words : str
        Whether the tissue is a spring, and why.
    principal : (ParameterEstimate, ParameterEstimate)
        Larger and smaller principal stiffness, of the symmetric part [N/m].
    angle : ParameterEstimate
        Direction of the larger one, from x toward z, in (-pi/2, pi/2] [rad]; not determined
        where the two agree within their errors.
    tissue_stiffness : ParameterEstimate
        k_a = k_zz / contact length [N/m^2].
    presses, directions : int
        Number of presses used, and of their directions.
    residual : float
        Root mean square of force minus K d [N].
    determination : float
        Coefficient of determination R^2.
    condition : float
        Condition number of the displacements; large where they have one direction only.

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
        """K [N/m], shape (2, 2), rows of force and columns of displacement; nan if unknown."""
        return np.array([p.value for p in self.parameters]).reshape(2, 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class StiffnessEstimate:
    """
    Stiffness at one place of the tissue.

    Attributes
    ----------
    name : str
        The recording.
    levels : tuple of LevelEstimate
        By force, from the smallest.
    off_plane : float
        Largest ratio of the displacement out of the plane to that in the plane.
    warnings : tuple of str
        What to know before using the numbers, in words.
    presses : Presses
        What was fitted.

    """

    name: str
    levels: tuple[LevelEstimate, ...]
    off_plane: float
    warnings: tuple[str, ...]
    presses: Presses

    def __repr__(self) -> str:
        forces = ', '.join(f'{level.force:.3g}' for level in self.levels)
        return f'<StiffnessEstimate of {self.name}: force levels {forces} N>'
