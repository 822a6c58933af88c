"""Inverse dynamics that learns friction on the way."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import inf

from needle_controller.laws.inverse_dynamics import InverseDynamics, InverseDynamicsGains
from needle_ros.errors import ParameterError
from needle_ros.settings import check_constants, constant


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptiveGains(InverseDynamicsGains):
    """Gains of inverse dynamics, and how friction is learned."""

    learn: bool = field(
        default=True, metadata={'description': 'learn; false keeps what is learned as it is'}
    )
    bound: float = constant(
        0.5, '1', 'largest learned change of dry and of viscous friction, relative to the model',
        high=10.0,
    )  # fmt: skip
    noise: float = constant(
        0.05, 'N or N m', 'standard deviation of the force that friction does not explain',
        open_low=True,
    )  # fmt: skip

    def __post_init__(self) -> None:
        check_constants(self)
        if not isinstance(self.learn, bool):
            raise ParameterError(f'learn must be true or false, got {self.learn!r}')


@dataclass(frozen=True, slots=True, kw_only=True)
class Adaptive(InverseDynamics):
    """
    `InverseDynamics` with friction learned on the way, see `needle_controller.compiled.learning`.

    In each direction it learns what dry friction, viscous friction and dry friction per inserted
    length have beyond the model. The corrections count in the feed-forward of the modeled motion
    only. They are within their bounds whatever is measured, so that they are a bounded force from
    outside of the loop, which is that of inverse dynamics.

    Attributes
    ----------
    gains : AdaptiveGains
        Gains.

    """

    gains: AdaptiveGains

    def __post_init__(self) -> None:
        # Without arguments, super does not work in a dataclass with slots.
        InverseDynamics.__post_init__(self)
        noise = self.gains.noise if self.gains.learn else inf
        constants = self.constants._replace(bound=float(self.gains.bound), noise=float(noise))
        object.__setattr__(self, 'constants', constants)
        object.__setattr__(self, 'packed', tuple(constants))

    def linear(self) -> Adaptive:
        """Return the law without Coulomb friction and learning; see `Law.linear`."""
        gains = replace(self.gains, learn=False, bound=0.0)
        return replace(self, axis=self.axis.without_coulomb(), gains=gains)
