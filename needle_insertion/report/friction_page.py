"""The page about identified friction: the result, the data behind it, and what to doubt."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import Final

from needle_identification import FrictionEstimate, FrictionSummary, Statistic
from needle_identification.result import model_parameters
from needle_insertion.paper.tables import TABLE_1
from needle_insertion.report.figures import spread_figure
from needle_insertion.report.friction_figures import data_figure, residual_figure
from needle_insertion.report.friction_tables import (
    friction_parameters,
    friction_statistics,
    parameter_cells,
)
from needle_insertion.report.origin import Origin
from needle_insertion.report.page import write_page
from needle_insertion.report.picture import Picture
from needle_insertion.report.wording import (
    card,
    counted,
    grouped_warnings,
    label_of,
    MEAN_HEADS,
    mean_row,
    nearest_to_median,
    short_names,
)

#: Parameters that a plant takes while it runs.
_LIVE: Final = ('model.coulomb_friction', 'model.viscous_friction')


def write_friction_page(folder: Path, summary: FrictionSummary, origin: Origin) -> Path:
    """
    Write ``friction.html`` and its pictures.

    Parameters
    ----------
    folder : Path
        Where to write.
    summary : FrictionSummary
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
    means = friction_statistics(summary)
    main = [one for one in summary.statistics if one.name in TABLE_1]
    first = [one[summary.statistics[0].name].value for one in estimates]
    shown = estimates[nearest_to_median(first)]
    values = model_parameters(summary.statistics)
    path = folder / 'friction.html'
    write_page(
        path,
        'friction.html',
        title='Friction between needle and tissue',
        introduction=f'Identified from {counted(len(estimates), "recording")} of force and motion '
        'of the needle base by regression on equation (15).',
        pictures=_pictures(label, means, shown, estimates),
        cards=[card(one) for one in main or summary.statistics[:2]],
        origin=origin,
        warnings=grouped_warnings(estimates, label),
        mean_rows=[(*mean_row(one), _published(one)) for one in means],
        mean_heads=(*MEAN_HEADS, 'Table 1, mean ± STD'),
        shown=shown,
        name=label[shown.name],
        term_rows=_term_rows(shown, estimates),
        rows=[
            (
                label[one.name],
                *parameter_cells(one, means),
                f'{one.samples}',
                f'{1e3 * one.residual:.2f}',
                f'{one.determination:.4f}',
                f'{one.condition:.1f}',
            )
            for one in estimates
        ],
        heads=(
            *('recording', *(label_of(mean) for mean in means)),
            *('samples used', 'residual [mN]', 'R²', 'condition'),
        ),
        values=values,
        live=[
            f'ros2 param set /plant {name} {values[name]:.6g}' for name in _LIVE if name in values
        ],
    )
    return path


def _published(one: Statistic) -> str:
    if one.name not in TABLE_1:
        return ''
    mean, deviation = TABLE_1[one.name]
    return f'{mean:g} ± {deviation:g} {one.unit}'


def _term_rows(
    shown: FrictionEstimate, estimates: Sequence[FrictionEstimate]
) -> list[tuple[str, ...]]:
    """Return the other sets of terms, each with the support that it has."""
    supported = Counter(
        one.terms for estimate in estimates for one in estimate.comparison if one.supported
    )
    return [
        (
            ', '.join(one.terms),
            f'{supported[one.terms]} of {len(estimates)}',
            f'{one.difference:+,.1f}' if isfinite(one.difference) else '',
            one.words,
        )
        for one in shown.comparison
    ]


def _pictures(
    label: dict[str, str],
    means: list[Statistic],
    shown: FrictionEstimate,
    estimates: Sequence[FrictionEstimate],
) -> list[Picture]:
    name = label[shown.name]
    return [
        Picture(
            'friction_data',
            f'{name}: force over time and against speed after the low-pass filter, and the fit '
            f'of {", ".join(shown.terms)} to the samples in steady motion.',
            data_figure(shown),
            f'Two plots of {name}. The force over time follows the strokes of the needle, with '
            'the fitted force on top of it. Against speed the force jumps at zero by twice mu_s '
            'and rises with slope mu_v.',
        ),
        Picture(
            'friction_residuals',
            f'{name}: measured minus fitted force, over time, against speed, and as a histogram, '
            'separately for both directions.',
            residual_figure(shown),
            f'Three plots of the residual force of {name}, which has a root mean square of '
            f'{1e3 * shown.residual:.2g} mN. A good fit leaves noise around zero without a trend.',
        ),
        Picture(
            'friction_spread',
            'Each recording with its 95 % interval. The line and the band are the mean and its '
            'interval.',
            spread_figure(
                means, [(label[one.name], friction_parameters(one)) for one in estimates]
            ),
            f'Dot plots of each parameter over {len(estimates)} recordings with intervals.',
        ),
    ]
