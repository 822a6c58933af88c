# SPDX-License-Identifier: Apache-2.0
"""Constants of needle and tissue, validated at construction; elastic tissue, equation (7)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from math import ceil, expm1
from typing import Any, Final

from needle_dynamics.compiled.tissue import Layers
from needle_dynamics.friction import Friction
from needle_dynamics.modes import ModeShapes
from needle_ros.errors import ParameterError
from needle_ros.settings import (
    check_constants,
    check_whole,
    checked,
    choice,
    constant,
    flag,
    from_values,
    number_fields,
    positive,
    same_field,
)
import numpy as np

#: Formulations: all terms of the Euler-Lagrange equations, or the final form in the source.
FORMULATIONS: Final = ('complete', 'as_printed')

#: Largest condition number of G; above it the modal state has less than five valid digits.
LARGEST_CONDITION: Final = 1e11

#: Least insertion depth over l with cond(G) <= LARGEST_CONDITION, for 1, 2, ... modes. G depends
#: only on this ratio. The table allows parameter checks without compiled code.
LEAST_RATIOS: Final = (
    0.0, 1.27099e-4, 0.0943411, 0.228479, 0.332967, 0.410300, 0.474010, 0.526876, 0.571028,
    0.608223, 0.639854, 0.667005,
)  # fmt: skip

#: Maximum number of modes; more are distinguishable only at large insertion depths.
MOST_MODES: Final = len(LEAST_RATIOS)


@dataclass(frozen=True, slots=True, kw_only=True)
class Tissue:
    """
    Elastic foundation k(y, t), piecewise constant in depth, optionally swelling.

    A single layer without swelling is the homogeneous tissue (8) of the source.

    """

    starts: tuple[float, ...] = constant((), 'm', 'depths at which the layers begin, the first 0')
    stiffnesses: tuple[float, ...] = constant((), 'N/m^2', 'stiffness of each layer per length')
    swelling: float = constant(
        0.0, '1', 'final relative increase of the stiffness over its value at time 0',
        low=-1.0, open_low=True,
    )  # fmt: skip
    swelling_time: float = positive(1.0, 's', 'time constant of the swelling')

    def __post_init__(self) -> None:
        check_constants(self)
        ordered = all(low < high for low, high in pairwise(self.starts))
        if len(self.starts) != len(self.stiffnesses) or self.starts[:1] != (0.0,) or not ordered:
            raise ParameterError(
                f'layers must start at 0 and go deeper, with one stiffness each, got starts '
                f'{self.starts} and stiffnesses {self.stiffnesses}'
            )

    def growth(self, time: float) -> float:
        """Return the factor of the stiffness by swelling at a time of at least 0 [s]."""
        checked('time', time, 's', low=0.0)
        return 1.0 - self.swelling * expm1(-time / self.swelling_time)

    def layer(self, depth: float) -> int:
        """Return the index of the layer at a depth [m]; at a boundary the deeper layer."""
        return max(int(np.searchsorted(self.starts, depth, side='right')) - 1, 0)

    def stiffness(self, depth: float, time: float = 0.0) -> float:
        """Return the stiffness per length k(y, t) of (7) [N/m^2] at a depth [m] and time [s]."""
        return self.stiffnesses[self.layer(depth)] * self.growth(time)

    def layers(self, modes: ModeShapes) -> Layers:
        """Return the layers, with the contributions of the layers above to the mode integrals."""
        n, m = modes.count, len(self.starts)
        above = np.zeros((m, n, n)), np.zeros((m, n)), np.zeros((m, n))
        for i in range(1, m):
            at = modes.integrals(min(self.starts[i], modes.reach * modes.length))
            step = self.stiffnesses[i - 1] - self.stiffnesses[i]
            for total, integral in zip(above, (at.gram, at.area, at.moment), strict=True):
                total[i] = total[i - 1] + step * integral
        return Layers(np.array(self.starts), np.array(self.stiffnesses), *above)


@dataclass(frozen=True, slots=True, kw_only=True)
class NeedleParameters:
    """
    Constants of a flexible needle in soft tissue, SI units.

    The defaults are Table 3 and section 3.2.8 of [Boroomand2014]_ with Table 1 read as 0.3 N s/m
    (the preset `paper_si`).

    References
    ----------
    .. [Boroomand2014] A. Boroomand, M. Tavakoli, R. Sloboda, N. Usmani, "Dynamical modeling
       and controllability analysis of a flexible needle in soft tissue", 2014.

    Examples
    --------
    >>> parameters = NeedleParameters.preset('phantom', tissue_stiffness=600.0)
    >>> parameters.tissue_stiffness, parameters.viscous_friction
    (600.0, 300.0)
    >>> NeedleParameters.preset('phantom', length=-0.2)
    Traceback (most recent call last):
        ...
    needle_ros.errors.ParameterError: length must be finite, > 0 m, got -0.2

    """

    length: float = positive(0.2, 'm', 'needle length l')
    density: float = positive(8000.0, 'kg/m^3', 'mass density rho of the needle')
    area: float = positive(1.27e-6, 'm^2', 'effective cross-section A')
    youngs_modulus: float = positive(200e9, 'Pa', "Young's modulus E")
    area_moment: float = positive(
        1.28e-13, 'm^4', 'second moment of area I_y of the cross-section'
    )
    rotary_inertia: float = positive(
        1.0626e-9, 'kg m^2', 'I_x, used as a mass moment of inertia about x'
    )
    carriage_mass: float = constant(0.0, 'kg', 'mass that moves with the needle base')
    tissue_stiffness: float = constant(520.0, 'N/m^2', 'tissue stiffness k_a per length')
    layer_depths: tuple[float, ...] = constant(
        (), 'm', 'depths at which further tissue layers begin'
    )
    layer_stiffnesses: tuple[float, ...] = constant(
        (), 'N/m^2', 'stiffness of each of these layers'
    )
    swelling: float = constant(
        0.0, '1', 'final relative change of the tissue stiffness by swelling',
        low=-1.0, open_low=True,
    )  # fmt: skip
    swelling_time: float = positive(1.0, 's', 'time constant of the swelling')
    tissue_damping: float = constant(0.0, 'N s/m^2', 'tissue damping c_a per length')
    coulomb_friction: float = same_field(Friction, 'coulomb')
    viscous_friction: float = same_field(Friction, 'viscous')
    friction_law: str = same_field(Friction, 'law')
    withdrawal_friction: float = same_field(Friction, 'withdrawal')
    breakaway_friction: float = same_field(Friction, 'breakaway')
    stribeck_speed: float = same_field(Friction, 'stribeck_speed')
    smoothing_speed: float = same_field(Friction, 'smoothing_speed')
    modes: int = field(default=2, metadata={'description': 'number of shape modes n'})
    formulation: str = choice('complete', FORMULATIONS)
    minimum_depth: float = positive(1e-3, 'm', 'insertion depth below which the model stops')
    hub_stop: bool = flag(True, 'the hub stops on the skin (inelastic)')

    def __post_init__(self) -> None:
        check_constants(self)
        for name in number_fields(self):
            # An integer would cause compiled functions to be compiled for another type.
            object.__setattr__(self, name, float(getattr(self, name)))
        if self.minimum_depth >= self.length:
            raise ParameterError(
                f'minimum_depth must be < length = {self.length:g} m, got {self.minimum_depth!r}'
            )
        self._check_layers()
        self._check_modes()

    def _check_layers(self) -> None:
        depths = (0.0, *self.layer_depths)
        if len(self.layer_depths) != len(self.layer_stiffnesses):
            raise ParameterError(
                f'layer_stiffnesses must have one value for each of the {len(depths) - 1} '
                f'layer_depths, got {len(self.layer_stiffnesses)}'
            )
        if any(low >= high for low, high in pairwise(depths)):
            raise ParameterError(
                f'layer_depths must be > 0 and increase, got {list(self.layer_depths)}'
            )

    def _check_modes(self) -> None:
        n = self.modes
        check_whole('modes', n, 1, MOST_MODES)
        # An integer of NumPy would cause it, too.
        object.__setattr__(self, 'modes', int(n))
        least = LEAST_RATIOS[n - 1] * self.length
        if self.minimum_depth < least:
            raise ParameterError(
                f'{n} modes cannot be distinguished at minimum_depth = {self.minimum_depth:g} m, '
                f'where cond(G) > {LARGEST_CONDITION:.0e}; valid: minimum_depth >= '
                f'{ceil(1e4 * least) / 1e4:g} m, or fewer modes'
            )

    @property
    def tissue(self) -> Tissue:
        return Tissue(
            starts=(0.0, *self.layer_depths),
            stiffnesses=(self.tissue_stiffness, *self.layer_stiffnesses),
            swelling=self.swelling,
            swelling_time=self.swelling_time,
        )

    @property
    def friction(self) -> Friction:
        return Friction(
            law=self.friction_law,
            coulomb=self.coulomb_friction,
            viscous=self.viscous_friction,
            withdrawal=self.withdrawal_friction,
            breakaway=self.breakaway_friction,
            stribeck_speed=self.stribeck_speed,
            smoothing_speed=self.smoothing_speed,
        )

    @property
    def linear_density(self) -> float:
        """Mass per length rho A [kg/m]."""
        return self.density * self.area

    @property
    def bending_stiffness(self) -> float:
        """Bending stiffness E I_y [N m^2]."""
        return self.youngs_modulus * self.area_moment

    @property
    def moving_mass(self) -> float:
        """Mass moving along the insertion axis, rho A l plus the carriage [kg]."""
        return self.linear_density * self.length + self.carriage_mass

    @property
    def reach(self) -> float:
        """Largest insertion depth over l."""
        # Without the stop, the needle may overshoot the hub by its length.
        return 1.0 if self.hub_stop else 2.0

    @classmethod
    def preset(cls, name: str, **changes: Any) -> NeedleParameters:
        """Return the constants of a needle of `find_needle` by name, with changed fields."""
        # Imported here: the needles that bend are above this module.
        from needle_dynamics.needles import find_needle, of_tube

        return from_values(cls, {**asdict(find_needle(name).needle), **of_tube(changes)})


_PAPER_SI = NeedleParameters()
_PAPER_MM = replace(_PAPER_SI, viscous_friction=300.0)

#: The paper's needle by name. Table 1 prints mu_v = 0.3 without a unit: `paper_si` assumes
#: 0.3 N s/m, `paper_mm` 0.3 N s/mm. `phantom` adds the tissue damping that the paper
#: omits: 30 % of critical for the first mode at full insertion (an assumption).
PRESETS: Final[Mapping[str, NeedleParameters]] = {
    'paper_si': _PAPER_SI,
    'paper_mm': _PAPER_MM,
    'phantom': replace(_PAPER_MM, tissue_damping=1.6),
}

PAPER_NEEDLE: Final = 'phantom'  #: needle of the model of the paper, if no other is named
