# SPDX-License-Identifier: Apache-2.0
"""
Values of the paper's Tables 1 and 2, in SI units.

The paper prints no units. In Table 1 mu_v = 0.3 is read as N s/mm, for which an insertion under 3
N takes seconds; Table 2 is read as kN/m, for which its last k_zz is the 0.52 of the text. The
constants of Table 3 are the defaults of `needle_dynamics.NeedleParameters`.
"""

from collections.abc import Mapping
from typing import Final

EXPERIMENTS: Final = 20  #: number of experiments of each mean and standard deviation

#: Table 1: mean and standard deviation of mu_s [N] and mu_v [N s/m].
TABLE_1: Final[Mapping[str, tuple[float, float]]] = {
    'coulomb_friction': (0.56, 0.0374),
    'viscous_friction': (300.0, 44.7),
}

FORCE_LEVELS: Final = (1.1, 1.2, 1.3, 1.4, 1.5)  #: force levels of Table 2 [N]

#: Table 2: means and standard deviations of each entry at each force level [N/m].
TABLE_2: Final[Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]]] = {
    'k_xx': ((1260.0, 820.0, 1100.0, 1030.0, 960.0), (80.0, 540.0, 110.0, 120.0, 120.0)),
    'k_xz': ((40.0, 40.0, 10.0, 1.0, -5.0), (80.0, 70.0, 90.0, 80.0, 80.0)),
    'k_zx': ((-100.0, -100.0, -110.0, -110.0, -110.0), (60.0, 100.0, 90.0, 90.0, 90.0)),
    'k_zz': ((1010.0, 810.0, 690.0, 600.0, 520.0), (110.0, 150.0, 180.0, 190.0, 180.0)),
}
