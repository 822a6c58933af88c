# SPDX-License-Identifier: Apache-2.0
"""Report controllability and observability at operating points as tables, JSON and a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from io import StringIO
from itertools import product
from pathlib import Path
from typing import Any, Final, TYPE_CHECKING

from needle_dynamics import analyze, linearize, NeedleModel, NeedleParameters
from needle_dynamics.analysis import (
    Analysis,
    controllability_map,
    ControllabilityMap,
    StateStructure,
)
from needle_dynamics.linearization import LinearSystem, operating_point
from needle_insertion.report.content import png
from needle_ros.files import write_whole
import numpy as np
from tqdm import tqdm

if TYPE_CHECKING:
    # Takes half a second to import; only the map needs it.
    from matplotlib.figure import Figure

#: Smallest depth of the map as a fraction of the needle length; numbers of depths and deflections.
SHALLOWEST, DEPTHS, DEFLECTIONS = 0.05, 41, 31

LARGEST_DEFLECTION: Final = 2e-3  #: largest tip deflection of the map if none is given [m]

#: Column heads of `OperatingPoint.row`.
POINT_HEADS: Final = (
    'depth, tip, speed',
    *('ctrb', 'not ctrb', 'margin', 'weakest'),
    *('obsv', 'not obsv', 'margin', 'weakest'),
    'tip / base travel',
)

_MAPPED: Final = ('rank', 'distance', 'observed_rank', 'observed_margin', 'output_gain')

_PANELS: Final = (
    ('distance', 'distance from losing state controllability', 'change of A, B (natural units)'),
    ('output_gain', 'tip deflection per base travel', 'm per m'),
    ('observed_margin', 'distance from losing observability', 'change of A, C (natural units)'),
)


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """Analysis at an insertion depth [m], tip deflection [m], velocity [m/s] and force [N]."""

    depth: float
    deflection: float
    speed: float
    force: float
    system: LinearSystem
    result: Analysis

    @property
    def row(self) -> tuple[str, ...]:
        """Cells of a table with the heads `POINT_HEADS`."""
        found = self.result
        return (
            f'{1e2 * self.depth:g} cm, {1e3 * self.deflection:g} mm, {1e3 * self.speed:g} mm/s',
            *_cells(found.state),
            *_cells(found.observed),
            f'{found.output_gain:.2g}' if found.output_controllable else 'none',
        )

    @property
    def document(self) -> dict[str, Any]:
        system, found = self.system, self.result
        return {
            'depth': self.depth,
            'tip_deflection': self.deflection,
            'speed': self.speed,
            'force': self.force,
            'states': system.names,
            'inputs': ('f_y', 'tau'),
            **{name: getattr(system, name).tolist() for name in ('A', 'B', 'C', 'D', 'drift')},
            'natural_frequencies': system.frequencies.tolist(),
            'controllability': _structure(found.state),
            'observability': _structure(found.observed),
            'output_controllability': {
                'controllable': found.output_controllable,
                'gain': found.output_gain,
            },
        }


def _cells(found: StateStructure) -> tuple[str, ...]:
    return f'{found.rank}/{found.order}', found.loss, f'{found.margin:.1e}', found.weakest


def _structure(found: StateStructure) -> dict[str, Any]:
    names = (
        *('order', 'rank', 'deficiency', 'lost', 'combined', 'loss', 'distance', 'margin'),
        'weakest',
    )
    return {
        **{name: getattr(found, name) for name in names},
        'eigenvalues': [[value.real, value.imag] for value in found.eigenvalues.tolist()],
        'distances': found.distances.tolist(),
    }


def analyze_points(
    model: NeedleModel,
    depths: Sequence[float],
    deflections: Sequence[float],
    speeds: Sequence[float],
    force: float = 0.0,
    sliding: str | None = None,
) -> list[OperatingPoint]:
    """Analyze combinations of depth [m], deflection [m] and velocity [m/s], force in N."""
    points = []
    for depth, deflection, speed in product(depths, deflections, speeds):
        state = operating_point(model, depth, deflection, speed)
        system = linearize(model, state, force, sliding=sliding)
        points.append(OperatingPoint(depth, deflection, speed, force, system, analyze(system)))
    return points


def map_needle(
    parameters: NeedleParameters,
    speed: float,
    largest: float = LARGEST_DEFLECTION,
    force: float = 0.0,
    sliding: str | None = None,
) -> ControllabilityMap:
    """Analyze a grid of insertion depths and deflections up to ``largest`` [m]."""
    length = parameters.length
    deflections = np.linspace(0.0, largest, DEFLECTIONS)
    depths = np.linspace(max(SHALLOWEST * length, parameters.minimum_depth), length, DEPTHS)
    with tqdm(total=DEPTHS, desc='depths', disable=None, leave=False) as bar:
        return controllability_map(
            parameters, depths, deflections, speed, sliding, force, bar.update
        )


def draw_map(found: ControllabilityMap) -> Figure:
    """Draw a map in three panels, gray where the state is not controllable."""
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    parameters = found.parameters
    figure = Figure(figsize=(13.0, 4.6), layout='constrained')
    order = 2 * (2 + parameters.modes)
    lost = found.rank < order
    panels = figure.subplots(1, 3, sharey=True)
    for axes, (name, title, unit) in zip(panels, _PANELS, strict=True):
        shown = np.ma.masked_array(getattr(found, name), lost).T
        axes.set_facecolor('0.75')
        mesh = axes.pcolormesh(
            1e2 * found.depths,
            1e3 * found.deflections,
            shown,
            norm=LogNorm() if shown.count() else None,
            shading='nearest',
        )
        figure.colorbar(mesh, ax=axes, location='bottom', label=unit)
        axes.set(title=title, xlabel='insertion depth [cm]')
        axes.title.set_fontsize('medium')
    figure.axes[0].set_ylabel('tip deflection [mm]')
    figure.suptitle(
        f'{parameters.formulation}, {parameters.modes} modes, {1e3 * found.velocity:g} mm/s; '
        'dimensionless; gray: not fully controllable'
    )
    return figure


def write_map(folder: Path, found: ControllabilityMap) -> list[Path]:
    depths, deflections = np.meshgrid(found.depths, found.deflections, indexing='ij')
    columns = (depths, deflections, *(getattr(found, name) for name in _MAPPED))
    text = StringIO()
    heads = ','.join(('depth_m', 'tip_deflection_m', *_MAPPED))
    rows = np.column_stack([column.ravel() for column in columns])
    np.savetxt(text, rows, '%.6g', ',', header=heads, comments='')
    table, drawing = folder / 'controllability.csv', folder / 'controllability.png'
    write_whole(table, text.getvalue().encode())
    write_whole(drawing, png(draw_map(found)))
    return [table, drawing]
