# SPDX-License-Identifier: Apache-2.0
"""Steps and limits of a steering law, as parameters."""

from dataclasses import dataclass
from math import inf
from typing import Final

from needle_ros.settings import check_constants, constant


@dataclass(frozen=True, slots=True, kw_only=True)
class SteeringLimits:
    """
    Length of the steps, and limits of the guide setpoints of a steering law.

    The defaults are for a robot: a force on tissue and a motion without a limit are never implied.
    """

    step_length: float = constant(
        5e-3, 'm', 'insertion from one tip measurement to the next', open_low=True
    )
    guide_limit: float = constant(
        6e-3, 'm', 'largest position of the guide along x and along z; 0: it stays at 0'
    )
    guide_step: float = constant(
        2e-3, 'm', 'largest change of the guide from one step to the next along x and along z',
        open_low=True, unlimited=True,
    )  # fmt: skip
    load_limit: float = constant(
        8.0, 'N', 'largest lateral force of the guide that is planned, along x and along z; the '
        'reachable set is computed without it',
        open_low=True, unlimited=True,
    )  # fmt: skip
    turns: int = constant(0, '1', 'allowed number of turns of the needle', whole=True)

    def __post_init__(self) -> None:
        check_constants(self)
        object.__setattr__(self, 'turns', int(self.turns))


#: Default limits of simulations; these two differ from the node: a simulated guide has time for
#: any motion between two steps, and its force harms no tissue.
SIMULATION_LIMITS: Final = SteeringLimits(guide_step=inf, load_limit=inf)
