# SPDX-License-Identifier: Apache-2.0
"""Controllability and observability of the paper's needle, sections 3.2.3 to 3.2.6."""

from typing import Final

from needle_dynamics import NeedleModel, NeedleParameters
from needle_insertion.report import controllability as report
from needle_insertion.report.content import Picture
from reproduction.content import Grid, ReportSection

#: Operating points: insertion depths [m], tip deflections [m], velocity [m/s].
DEPTHS: Final = (0.02, 0.1, 0.2)
DEFLECTIONS: Final = (0.0, 5e-4)
SPEED: Final = 5e-3


def section() -> ReportSection:
    parameters = NeedleParameters.preset('paper_si')
    model = NeedleModel(parameters)
    straight, bent = (
        report.analyze_points(model, DEPTHS, (deflection,), (SPEED,)) for deflection in DEFLECTIONS
    )
    first, last = straight[0].result, bent[0].result
    figure = report.draw_map(report.map_needle(parameters, SPEED))
    return ReportSection(
        title='Controllability and observability',
        paragraphs=(
            (
                'Linearized about a straight needle, f_y and tau control '
                f'{first.state.rank} of {first.state.order} states, and {first.observed.rank} are '
                f'observable from the tip. With a deflection of {1e3 * DEFLECTIONS[-1]:g} mm '
                f'{last.state.rank} and {last.observed.rank}. Ranks are computed in '
                'natural units: in SI units the columns of [B, AB, ...] span more decades than '
                'doubles have digits. The margin is the change of the pair that removes a rank.'
            ),
        ),
        tables=(
            Grid(
                caption='States controlled by f_y and tau, and observable from the tip deflection '
                '(0.3 N s/m, complete equations)',
                heads=report.POINT_HEADS,
                rows=tuple(point.row for point in (*straight, *bent)),
            ),
        ),
        pictures=(
            Picture(
                'controllability',
                'Distance of the linearized needle from losing controllability and observability, '
                'and tip motion per base motion, by insertion depth and deflection.',
                figure,
            ),
        ),
    )
