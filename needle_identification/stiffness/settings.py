# SPDX-License-Identifier: Apache-2.0
"""Settings of stiffness identification."""

from dataclasses import dataclass

from needle_identification.estimation import ESTIMATORS
from needle_ros.settings import CheckedSettings, choice, constant, positive


@dataclass(frozen=True, slots=True, kw_only=True)
class StiffnessSettings(CheckedSettings):
    """
    Settings of `identify_stiffness`; fields describe meaning and unit.

    The mean matrices of Table 2 have an asymmetry of up to 0.086, and the paper calls their
    tissue a spring; ``largest_asymmetry`` is the next round number.
    """

    contact_length: float = positive(
        1.0,
        'm',
        'length of tissue that the end-effector presses; 1 m gives the value of the paper',
    )
    level_tolerance: float = positive(
        0.05, 'N', 'forces this close are one level, and steady within it'
    )
    rest_force: float = positive(0.1, 'N', 'force up to which it counts as rest')
    hold_time: float = positive(0.1, 's', 'shortest steady force that counts as a hold or a rest')
    settle_time: float = constant(0.02, 's', 'left out at the beginning of each hold and rest')
    largest_asymmetry: float = constant(
        0.1, '1', 'antisymmetric part over symmetric up to which it counts as a spring'
    )
    estimator: str = choice('ordinary', ESTIMATORS)
