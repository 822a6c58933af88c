# SPDX-License-Identifier: Apache-2.0
"""Inverse dynamics with friction adaptation."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from typing import Any, ClassVar

from needle_controller.laws.inverse_dynamics import InverseDynamics, InverseDynamicsGains
from needle_ros.settings import constant, flag, positive


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptiveGains(InverseDynamicsGains):
    """Gains of inverse dynamics with friction adaptation."""

    learn: bool = flag(True, 'adapt the friction; false freezes the learned friction')
    bound: float = constant(
        0.5, '1', 'largest learned change of dry and of viscous friction, relative to the model',
        high=10.0,
    )  # fmt: skip
    noise: float = positive(
        0.05, 'N or N m', 'standard deviation of the force not explained by the friction model'
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Adaptive(InverseDynamics):
    """
    `InverseDynamics` with adaptation of friction, see `needle_controller.compiled.learning`.

    In each direction it estimates corrections of dry friction, viscous friction and dry friction
    per insertion depth. They enter the feed-forward of the modeled motion only and are bounded for
    every measurement: a bounded external force on the loop of inverse dynamics.
    """

    LINEAR: ClassVar[Mapping[str, Any]] = {'learn': False, 'bound': 0.0}

    gains: AdaptiveGains

    def __post_init__(self) -> None:
        # Without arguments, super does not work in a dataclass with slots.
        InverseDynamics.__post_init__(self)
        noise = self.gains.noise if self.gains.learn else inf
        constants = self.constants._replace(bound=float(self.gains.bound), noise=float(noise))
        object.__setattr__(self, 'constants', constants)
        object.__setattr__(self, 'packed', tuple(constants))
