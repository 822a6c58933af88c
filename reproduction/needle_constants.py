# SPDX-License-Identifier: Apache-2.0
"""Constants of the needle, Table 3, compared with a round wire."""

from math import pi
from typing import Final

from needle_dynamics import NeedleParameters
from reproduction.content import Grid, ReportSection

DIAMETER: Final = 1.27e-3  #: Diameter of an 18 gauge needle [m].


def section() -> ReportSection:
    p = NeedleParameters()
    rows = (
        ('l [m]', p.length, None),
        ('rho [kg/m^3]', p.density, None),
        ('E [Pa]', p.youngs_modulus, None),
        ('A [m^2]', p.area, pi / 4.0 * DIAMETER**2),
        ('I_y [m^4]', p.area_moment, pi / 64.0 * DIAMETER**4),
        ('I_x [m^4] in the paper, [kg m^2] here', p.rotary_inertia, pi / 32.0 * DIAMETER**4),
    )
    return ReportSection(
        title='Table 3',
        paragraphs=(
            (
                'A and I_y match a round needle of 1.27 mm. I_x is not its polar moment of '
                'area. The equations require a mass moment of inertia and use the same number in '
                'kg m^2; only the rotation depends on it. g (9.89 m/s^2 in the paper) is in no '
                'equation: the plane of motion is horizontal.'
            ),
        ),
        tables=(
            Grid(
                caption='Constants of the needle',
                heads=('constant', 'value', 'round wire of 1.27 mm', 'ratio'),
                rows=tuple(
                    (name, f'{value:.5g}')
                    + (('', '') if wire is None else (f'{wire:.4g}', f'{value / wire:.4g}'))
                    for name, value, wire in rows
                ),
            ),
        ),
    )
