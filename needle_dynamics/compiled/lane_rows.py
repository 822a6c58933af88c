# SPDX-License-Identifier: Apache-2.0
"""Arrangement of the numbers of many needles: one row of `LANES` entries for each quantity."""

from typing import Final, NamedTuple

from needle_dynamics.arrays import Matrix

LANES: Final = 32  #: number of lanes per step: their rows fit into the first-level cache
COLUMNS: Final = 26  #: columns of `ModeTables.series` for G, H, phi and phi'' of two modes
#: Those that couple the second mode with the first one, and with the tip.
SECOND: Final = [3, 4, 5, 12, 13, 14, 20, 21, 24, 25]

# Offset of each row. First the constants.
(
    LENGTH, DENSITY, BENDING, STIFFNESS, DAMPING, MASS, COULOMB, VISCOUS, WITHDRAWAL,
    LOW, HIGH, STOP, INERTIA, SWELLING, SWELLING_TIME,
    LAW, BREAKAWAY, STRIBECK_SPEED, SMOOTHING_SPEED,
    # Motion, deflections and momenta of up to four modes, time left of the interval, time, and
    # row of the layers of the needle.
    DEPTH, VELOCITY, ACCELERATION, Q1, Q2, _Q3, _Q4, Z1, Z2, _Z3, _Z4, FORCE, LEFT, TIME, NEEDLE,
    # Stiffness at the tip.
    TISSUE,
    # One step: its length, time left after it, relative depth in its middle and fourth power of
    # this depth, whether the depth is in range, and the impulse of the modes.
    H, REST, XI, XI4, INSIDE, IMPULSE,
    # Result of the step.
    NEW_Q1, NEW_Q2, _NEW_Q3, _NEW_Q4, NEW_Z1, NEW_Z2, _NEW_Z3, _NEW_Z4, NEW_U, TRAVEL, STOPS,
    # Tip deflection [m].
    TIP,
    # Addition of the layers above to the stiffness of the modes, for each pair i <= j.
    ABOVE,
) = range(0, 54 * LANES, LANES)  # fmt: skip

#: Series or values of the modes at the depth of the step.
SERIES: Final = ABOVE + 10 * LANES
#: Rows of two modes.
ROWS: Final = SERIES // LANES + COLUMNS
#: First columns of a layer of a needle, before its addition to the stiffness of each pair of modes
#: [N/m^2]: depth at which it begins [m], infinite without one; its stiffness [N/m^2].
LAYER: Final = 2

#: Number of rows that move with a needle between lanes.
KEPT: Final = H // LANES


class Constants(NamedTuple):
    """Constants of a needle, in the order of the first rows; units as in `NeedleParameters`."""

    length: float
    linear_density: float
    bending_stiffness: float
    tissue_stiffness: float
    tissue_damping: float
    moving_mass: float
    coulomb_friction: float
    viscous_friction: float
    withdrawal_friction: float
    #: Range of the insertion depth [m].
    lowest: float
    highest: float
    stop: float  #: insertion depth at which the hub stops, or infinity [m]
    rotary_inertia: float
    #: Final increase and time constant of the stiffness [1, s].
    swelling: float
    swelling_time: float
    #: As in `FrictionConstants`.
    law: float
    breakaway_friction: float
    stribeck_speed: float
    smoothing_speed: float


class LaneModes(NamedTuple):
    """Modes of a needle of length 1, for the lanes."""

    number: int  #: number of modes; two for a needle with one, of which the second has no effect
    #: Two modes: the first columns of `ModeTables.series`, shape (1 + 4 m, `COLUMNS`). More:
    #: polynomials of `many_lanes`, shape (pieces terms, columns) with the columns G / xi^5 and
    #: H / xi of each pair, phi / xi^2 and phi'' of each mode.
    table: Matrix
