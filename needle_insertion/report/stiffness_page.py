"""The page about identified stiffness: the result, the data behind it, and what to doubt."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from needle_identification import LevelEstimate, StiffnessEstimate, StiffnessSummary
from needle_identification.estimation.formatting import measured
from needle_identification.result import model_parameters
from needle_insertion.paper.tables import FORCE_LEVELS, TABLE_2
from needle_insertion.report.figures import spread_figure
from needle_insertion.report.origin import Origin
from needle_insertion.report.page import write_page
from needle_insertion.report.picture import Picture
from needle_insertion.report.stiffness_figures import level_figure, press_figure
from needle_insertion.report.stiffness_tables import result_level, tissue_stiffness_at
from needle_insertion.report.wording import (
    card,
    counted,
    estimate_cell,
    grouped_warnings,
    MEAN_HEADS,
    mean_row,
    nearest_to_median,
    short_names,
    with_deviation,
)
import numpy as np

_ENTRY_HEADS: Final = tuple(f'{entry} [N/m]' for entry in TABLE_2)


def write_stiffness_page(folder: Path, summary: StiffnessSummary, origin: Origin) -> Path:
    """
    Write ``stiffness.html`` and its pictures.

    Parameters
    ----------
    folder : Path
        Where to write.
    summary : StiffnessSummary
        What was identified.
    origin : Origin
        What it was identified from, and how.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    ParameterError
        If a file cannot be written.

    """
    estimates = summary.estimates
    label = short_names([estimate.name for estimate in estimates])
    force = result_level(summary).force
    found = [tissue_stiffness_at(one, force) for one in estimates]
    shown = estimates[nearest_to_median([one.value for one in found])]
    springs = [level.is_spring for estimate in estimates for level in estimate.levels]
    path = folder / 'stiffness.html'
    write_page(
        path,
        'stiffness.html',
        title='Stiffness of the tissue',
        introduction=f'Identified from {counted(len(estimates), "recording")} of presses in the '
        'plane of deflection, as in Table 2 of the paper.',
        pictures=_pictures(label, summary, shown),
        cards=[
            card(summary.tissue_stiffness),
            (
                'Is it a spring?',
                f'{sum(springs)} of {len(springs)} matrices are',
                'by the curl of the force, within its uncertainty',
            ),
        ],
        origin=origin,
        warnings=grouped_warnings(estimates, label),
        places=counted(len(estimates), 'place'),
        heads=('force', *_ENTRY_HEADS),
        mean_rows=[
            (f'{level.force:.2f} N', *(with_deviation(level[name]) for name in TABLE_2))
            for level in summary.levels
        ],
        published_rows=[
            (f'{force:g} N', *(f'{row[0][i]:g} ({row[1][i]:g})' for row in TABLE_2.values()))
            for i, force in enumerate(FORCE_LEVELS)
        ],
        result_heads=('force', *MEAN_HEADS[1:]),
        result_rows=[
            (f'{level.force:.2f} N', *mean_row(level['tissue_stiffness'])[1:])
            for level in summary.levels
        ],
        shown=shown,
        name=label[shown.name],
        spring_rows=[_spring_row(level) for level in shown.levels],
        place_heads=(
            *('recording', 'force [N]', *_ENTRY_HEADS),
            *('presses, directions', 'residual [mN]', 'R²', 'condition'),
        ),
        place_rows=[
            (label[estimate.name], *_place_cells(level))
            for estimate in estimates
            for level in estimate.levels
        ],
        values=model_parameters([summary.tissue_stiffness]),
    )
    return path


def _spring_row(level: LevelEstimate) -> tuple[str, ...]:
    """Return force, curl, asymmetry, and the principal stiffnesses and their direction."""
    return (
        f'{level.force:.2f} N',
        *map(estimate_cell, (level.curl, level.spring, *level.principal)),
        measured(np.degrees(level.angle.value), np.degrees(level.angle.error)),
    )


def _place_cells(level: LevelEstimate) -> tuple[str, ...]:
    return (
        f'{level.force:.2f}',
        *map(estimate_cell, level.parameters),
        f'{level.presses} in {level.directions}',
        f'{1e3 * level.residual:.2f}',
        f'{level.determination:.4f}',
        f'{level.condition:.1f}',
    )


def _pictures(
    label: dict[str, str], summary: StiffnessSummary, shown: StiffnessEstimate
) -> list[Picture]:
    name, force = label[shown.name], result_level(summary).force
    result = summary.tissue_stiffness
    rows = [
        (label[one.name], {result.name: tissue_stiffness_at(one, force)})
        for one in summary.estimates
    ]
    return [
        Picture(
            'stiffness_levels',
            'Entries of the matrix against the force, with 95 % intervals of the mean. Small dots '
            'are places. Gray is Table 2, mean and STD.',
            level_figure(summary),
            'Four plots of the entries of the stiffness matrix against force, beside Table 2.',
        ),
        Picture(
            'stiffness_presses',
            f'{name}. Left: force against displacement along each direction. Right: where the '
            'end-effector came to rest, the ellipse on which each level of force ends according '
            'to the fitted matrix, and the principal axes at the largest force.',
            press_figure(shown),
            f'Two plots of {name}. Force grows with displacement in each direction. The rest '
            'positions of a level of force lie on an ellipse.',
        ),
        Picture(
            'stiffness_spread',
            f'k_a of each place at {force:.2f} N with its 95 % interval. The line and the band '
            'are the mean and its interval.',
            spread_figure([result], rows),
            f'Dot plot of k_a over {counted(len(rows), "place")} with intervals.',
        ),
    ]
