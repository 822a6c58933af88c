# SPDX-License-Identifier: Apache-2.0
"""Report a simulated steered insertion as summary, CSV and figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, TYPE_CHECKING, TypeVar

from needle_dynamics import FloatArray, Insertion
from needle_dynamics.steering.needle import NeedleShape
from needle_insertion.report.content import csv_table, png
from needle_ros.files import write_whole
import numpy as np

if TYPE_CHECKING:
    # Take half a second each to import; only pictures need them.
    from matplotlib.figure import Figure
    from needle_controller.steering.laws.multi_hypothesis import Reach

_Item = TypeVar('_Item')

#: Columns of the CSV, with the names that friction and steering identification expect.
COLUMNS: Final = (
    'time [s]', 'depth [m]', 'speed [m/s]', 'force [N]', 'guide_x [m]', 'guide_z [m]',
    'roll [rad]', 'tip_x [m]', 'tip_z [m]', 'tip_roll [rad]', 'force_x [N]', 'force_z [N]',
    'torque_x [N m]', 'torque_y [N m]', 'torque_z [N m]',
)  # fmt: skip

_LINEAR: Final = 0.3  #: largest slope of a linear beam
_DRAWN: Final = 4  #: number of drawn needle shapes
_WIDTH: Final = 9.0  #: width of the picture [in]
_MARGIN: Final = 4.0  #: margin around a needle [mm]


class InsertionRecord:
    """Samples of an insertion, with needle shapes."""

    def __init__(self, one: Insertion) -> None:
        self.one = one
        self._rows: list[list[float]] = []
        self._shapes: list[NeedleShape] = []
        self.take(0.0)

    def take(self, force: float) -> None:
        """Record a sample; ``force`` is the mean axial force since the previous sample [N]."""
        one, needle = self.one, self.one.needle
        x, _, z = needle.tip
        pose = (*needle.guide, needle.roll, x, z, needle.tip_roll)
        self._rows.append([one.time, one.depth, one.velocity, force, *pose, *one.wrench])
        self._shapes.append(needle.shape)

    @property
    def table(self) -> FloatArray:
        """Samples, shape (n, columns) in the order of `COLUMNS`."""
        return np.array(self._rows)

    @property
    def largest_slope(self) -> float:
        return float(max(np.abs(one.slopes).max() for one in self._shapes))

    @property
    def shapes(self) -> list[NeedleShape]:
        """Needle shapes at evenly spaced samples, including the last."""
        return evenly(self._shapes, _DRAWN + 1)[1:]


def evenly(items: Sequence[_Item], count: int) -> list[_Item]:
    """Return items at evenly spaced places, including the first and the last."""
    places = np.linspace(0, len(items) - 1, count).round().astype(int)
    return [items[place] for place in places.tolist()]


def summary(record: InsertionRecord) -> dict[str, float]:
    column = dict(zip(COLUMNS, record.table.T, strict=True))
    return {
        'duration [s]': float(column['time [s]'][-1]),
        'depth at the end [m]': float(column['depth [m]'][-1]),
        'tip at the end, x [m]': float(column['tip_x [m]'][-1]),
        'tip at the end, z [m]': float(column['tip_z [m]'][-1]),
        'largest slope': record.largest_slope,
        'largest axial force [N]': float(np.abs(column['force [N]']).max()),
        'largest lateral force on the guide [N]': float(
            np.hypot(column['force_x [N]'], column['force_z [N]']).max()
        ),
        'membranes punctured': float(sum(record.one.punctured)),
    }


def warnings(record: InsertionRecord) -> Iterator[str]:
    """Yield a warning if the needle bends beyond the validity of the model."""
    if record.largest_slope > _LINEAR:
        yield (
            f'the largest slope of the needle is {record.largest_slope:.2g}: a linear beam is '
            f'valid up to about {_LINEAR:g}'
        )


def write(path: Path, record: InsertionRecord) -> None:
    if path.suffix == '.csv':
        write_whole(path, csv_table(COLUMNS, record.table))
    else:
        shapes = [np.insert(one.deflections, 1, one.depths, axis=1) for one in record.shapes]
        cut_path = record.one.needle.path
        cut = np.insert(cut_path.deflections, 1, cut_path.depths, axis=1)
        write_whole(path, png(draw_needle(shapes, cut)))


def draw_needle(
    needles: Sequence[FloatArray],
    path: FloatArray,
    target: FloatArray | None = None,
    beside: FloatArray | None = None,
) -> Figure:
    """
    Draw needle shapes (k, 3), cut path (m, 3) and target (3,) to scale in both planes [m].

    The last needle is drawn bold. ``beside`` (k, 3) is the needle of an open-loop insertion.
    """
    from matplotlib.figure import Figure

    begin = 1e3 * min(float(one[:, 1].min()) for one in needles)
    end = 1e3 * max(float(one[:, 1].max()) for one in needles) + 5.0
    others = [one for one in (target, beside) if one is not None]
    whole = 1e3 * np.vstack([*needles, path, *others])[:, [0, 2]]
    limits = np.array([whole.min(axis=0) - _MARGIN, whole.max(axis=0) + _MARGIN]).T
    spans = np.diff(limits)[:, 0]
    # Height from the scale, plus space for labels.
    height = _WIDTH * float(spans.sum()) / (end - begin)
    figure = Figure(figsize=(_WIDTH, height + 1.5), layout='constrained')
    planes = figure.subplots(2, 1, sharex=True, height_ratios=spans.tolist())
    for k, axes, limit in zip((0, 2), planes, limits.tolist(), strict=True):
        axes.axvspan(0.0, end, color='#f3d9d0', lw=0)
        axes.axvline(0.0, color='#b07060', lw=2.0)
        for needle in needles[:-1]:
            axes.plot(*1e3 * needle[:, [1, k]].T, color='tab:blue', lw=0.8, alpha=0.5)
        axes.plot(*1e3 * needles[-1][:, [1, k]].T, color='tab:blue', lw=2.0, label='needle')
        axes.plot(1e3 * path[:, 1], 1e3 * path[:, k], 'k--', lw=0.8, label='cut path')
        if beside is not None:
            axes.plot(1e3 * beside[:, 1], 1e3 * beside[:, k], color='gray', label='open loop')
        if target is not None:
            axes.plot(1e3 * target[1], 1e3 * target[k], 'x', color='tab:red', label='target')
        axes.set(ylabel=f'{"xyz"[k]} [mm]', xlim=(begin, end), ylim=limit, aspect='equal')
        axes.grid(visible=True, alpha=0.3)
    axes.set_xlabel('depth y [mm]')
    # Above the axes: Matplotlib 3.6 has no place outside all axes.
    handles, labels = axes.get_legend_handles_labels()
    planes[0].legend(handles, labels, loc='lower right', bbox_to_anchor=(1.0, 1.0), ncols=4)
    return figure


def draw_reach(reach: Reach, target: FloatArray) -> Figure:
    """Draw the reachable set at the depth of an unreachable target, x and z [m]."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    figure = Figure(figsize=(6.0, 6.0), layout='constrained')
    axes = figure.subplots()
    for middle, size, weight in zip(*reach, strict=True):
        low, span = 1e3 * (middle - size), 2e3 * size
        style = {'color': 'tab:blue', 'alpha': min(1.0, 2.0 * weight)}
        axes.add_patch(Rectangle((low.real, low.imag), span.real, span.imag, **style))
    axes.plot(*(1e3 * target), 'rx', ms=10.0, mew=2.0, label='target')
    axes.plot(0.0, 0.0, 'k+', ms=10.0, label='axis of the guide')
    axes.set(xlabel='x [mm]', ylabel='z [mm]', title='Reachable tip positions', aspect='equal')
    axes.margins(0.1)
    axes.legend()
    return figure
