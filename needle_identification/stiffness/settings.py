"""Settings of the identification of stiffness."""

from __future__ import annotations

from dataclasses import dataclass

from needle_identification.estimation.estimators import check_estimator
from needle_ros.settings import check_constants, constant


@dataclass(frozen=True, slots=True, kw_only=True)
class StiffnessSettings:
    """
    Settings of `identify_stiffness`.

    Attributes
    ----------
    contact_length : float
        Length of tissue that the end-effector presses [m]; k_a is k_zz over this length. The
        default gives the number of the source.
    level_tolerance : float
        Forces this close are one force level, and a force that stays within it is steady [N].
    rest_force : float
        Force up to which the end-effector is at rest [N].
    hold_time : float
        Shortest steady force that counts as a hold or a rest [s].
    settle_time : float
        Time left out at the beginning of each hold and rest [s].
    largest_asymmetry : float
        Largest `asymmetry` that counts as a spring [1]. The mean matrices of Table 2 reach
        0.086, and the source calls their tissue a spring.
    estimator : str
        One of `ESTIMATORS`.

    Raises
    ------
    ParameterError
        If a setting is out of range, or the estimator is unknown.

    """

    contact_length: float = constant(
        1.0,
        'm',
        'length of tissue that the end-effector presses; 1 m gives the number of the source',
        open_low=True,
    )
    level_tolerance: float = constant(
        0.05, 'N', 'forces this close are one level, and steady within it', open_low=True
    )
    rest_force: float = constant(0.1, 'N', 'force up to which it counts as rest', open_low=True)
    hold_time: float = constant(
        0.1, 's', 'shortest steady force that counts as a hold or a rest', open_low=True
    )
    settle_time: float = constant(0.02, 's', 'left out at the beginning of each hold and rest')
    largest_asymmetry: float = constant(
        0.1, '1', 'antisymmetric part over symmetric up to which it counts as a spring'
    )
    estimator: str = 'ordinary'

    def __post_init__(self) -> None:
        check_constants(self)
        check_estimator(self.estimator)
