# SPDX-License-Identifier: Apache-2.0
"""Write the page of a plan: sections of the anatomy with the needle, clearance and guide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import ceil
from pathlib import Path
from typing import Any, Final, NamedTuple

from needle_controller.steering.insertion_plan import Plan
from needle_dynamics.arrays import FloatArray
from needle_insertion.report.anatomy_view import AnatomyView
from needle_insertion.report.content import Picture
from needle_insertion.report.page import write_page
from needle_insertion.report.section import (
    draw_section,
    halo,
    Legend,
    legend_of,
    MARGIN_COLOR,
    OUTSIDE_COLOR,
    Plane,
    sample,
    Section,
    section,
)
from needle_planning.anatomy import Anatomy, plan_warnings, ROLES
from needle_planning.chance import Chance
from needle_planning.clearance import Clearance, LIMIT
from needle_planning.planned_needle import complete_needle, shafts
from needle_ros.errors import ParameterError
import numpy as np

_AROUND: Final = 0.015  #: Length before the entry point and beyond the target in a section [m].
_HALF: Final = (0.02, 0.035, 0.06)  #: Half of the width: least, usual and largest [m].
_PIXELS: Final = 880  #: Pixels along the longer side of a section.
#: Largest difference of clearance between plan and page; the plan states it to 50 um [m].
_SAME: Final = 2e-4
_WIDTH: Final = 8.0  #: Width of a picture [inches].
_VISIBLE: Final = 1e-4  #: Distance from a section that is stated [m].
_CHARACTERS: Final = 120  #: Characters in the width of a picture.
#: Heads of the columns of a plan, and of the structure.
_HEADS: Final = (
    'depth [mm]', 'guide x [mm]', 'guide z [mm]', 'tip R [mm]', 'tip A [mm]', 'tip S [mm]',
    'clearance [mm]', 'limited by',
)  # fmt: skip
_SPREAD: Final = '#b00020', '#1c2128'  #: Colors of inserted needles: failure, success.
_MARKERS: Final = 'osD^vPX'  #: Markers of the structures of the chart.


class _Shaft(NamedTuple):
    """Needle of a plan, in patient coordinates."""

    final: FloatArray  #: points from outside the skin to the tip at the end [m], shape (k, 3)
    limits: list[str]  #: structure with the least clearance in the step to each depth
    along: FloatArray  #: position of points in the tissue along the line [m], shape (p,)
    clearances: FloatArray  #: clearance of these points [m], shape (p,)
    nearest: list[str]  #: structure that limits it
    inserted: FloatArray  #: needles of simulated insertions [m], shape (m, k, 3)
    success: list[bool]  #: whether each of them succeeds


def write_plan_page(
    plan: Plan,
    anatomy: Anatomy | Sequence[Anatomy],
    path: Path | str,
    chance: Chance | None = None,
) -> None:
    """
    Write the page of a plan, and its pictures, which have its name, in the same folder.

    Parameters
    ----------
    plan : Plan
        Plan in this anatomy.
    anatomy : Anatomy or sequence of Anatomy
        Segmented images, as for `find_plan`.
    path : Path or str
        File to write (.html).
    chance : Chance, optional
        Simulated insertions along the plan, whose needles and probabilities are shown.

    Raises
    ------
    ParameterError
        The plan is outside the images, or does not fit the anatomy or the needle.

    """
    every = [anatomy] if isinstance(anatomy, Anatomy) else list(anatomy)
    legend = legend_of(every, plan.structure)
    planes = _planes(plan, legend)
    clearance = Clearance(
        every, np.concatenate([one.corners for one in planes]), radius=plan.radius
    )
    _check(plan, every, legend, clearance)
    shaft = _shaft(plan, clearance, chance)
    pictures = [
        _picture(plan, legend, shaft, name, section(every, legend, clearance, plan.radius, one))
        for name, one in zip(('x', 'z', 'across'), planes, strict=True)
    ]
    pictures.append(_by_depth(plan, legend, shaft))
    # Two pages in a folder have their own pictures.
    pictures = [replace(one, name=f'{Path(path).stem}_{one.name}') for one in pictures]
    *sections, depth = pictures
    near = f'to {plan.structure}' if plan.structure else 'to all obstacles'
    least = 'at least ' * plan.at_limit + _mm(plan.clearance)
    bent = plan.guide.any()
    warnings = plan_warnings(every, plan.target, plan.entry, plan.direction)
    words = 'Drag to turn, or use the arrow keys. Obstacles are opaque, all else is translucent.'
    if chance is not None and len(shaft.inserted):
        words += f' Lines: {len(shaft.inserted)} of {chance.insertions} simulated insertions.'
    write_page(
        Path(path),
        'plan.html',
        pictures,
        AnatomyView(words, plan, every, chance),
        introduction=f'Needle {plan.needle} from the skin to the target, '
        f'{"bowed by the guide" if bent else "straight"}, in {len(plan.guide)} steps. '
        'Clearances are beyond the margins of the obstacles.'
        + ''.join(f' Warning: {one}.' for one in warnings),
        cards=[
            ('Least clearance', f'{least} mm', near),
            ('Length', f'{_mm(plan.length)} mm', f'{len(plan.guide)} steps'),
            ('Bow', f'{_mm(plan.bow)} mm', 'largest deflection from the straight line'),
            *([] if chance is None else [('Success', *chance.rows()[-1][1:])]),
        ],
        chances=[] if chance is None else chance.rows(),
        sections=sections,
        depth=depth,
        guide='The guide is at zero until the needle has pierced the skin. It moves to the '
        'setpoint of a step while the needle rests, and rests while the needle is inserted.'
        if bent
        else 'The guide stays at zero.',
        points=_positions(plan),
        values=_values(plan),
        step_heads=_HEADS,
        steps=_steps(plan, shaft),
        structures=[
            (one.name, one.role, _mm(one.margin) if one.role == ROLES[0] else '', str(number))
            for number, one in enumerate(legend.structures, 1)
        ],
    )


def _mm(value: float) -> str:
    # Without a sign of zero.
    return f'{1e3 * value + 0.0:.2f}'.replace('-0.00', '0.00')


def _positions(plan: Plan) -> list[tuple[str, ...]]:
    named = {'entry': plan.entry, 'target': plan.target, 'least clearance': plan.place}
    rows = [(name, *map(_mm, at)) for name, at in named.items()]
    axes = zip(('guide axis x', 'direction (y)', 'guide axis z'), plan.axes, strict=True)
    return rows + [(name, *(f'{one + 0.0:.4f}' for one in axis)) for name, axis in axes]


def _values(plan: Plan) -> list[tuple[str, str, str]]:
    lengths = (
        ('needle radius', plan.radius, 'subtracted from each distance'),
        ('length', plan.length, 'straight line from entry point to target'),
        ('largest bow', plan.bow, 'deflection of the shaft from the straight line'),
        ('clearance', plan.clearance, f'least one, {plan.structure or "beyond 30 mm"}'),
        ('resolution', plan.resolution, 'of the search'),
        ('bound straight', plan.straight_bound, _bound('straight needle', plan.straight_bound)),
        ('bound', plan.bound, _bound('needle within the limits of the guide', plan.bound)),
    )
    return [
        ('needle', plan.needle, 'name or file'),
        ('roll', f'{np.degrees(plan.roll):.2f} deg', 'rotation about its axis'),
        *((name, f'{_mm(value)} mm', meaning) for name, value, meaning in lengths),
    ]


def _bound(kind: str, bound: float) -> str:
    # Clearances above the limit are not distinguished.
    return (
        f'limit of the search, a {kind} may have more' if bound >= LIMIT else f'no {kind} has more'
    )


def _steps(plan: Plan, shaft: _Shaft) -> list[tuple[str, ...]]:
    rows = zip(*plan.columns().values(), strict=True)
    return [(*map(_mm, row), name) for row, name in zip(rows, shaft.limits, strict=True)]


def _planes(plan: Plan, legend: Legend) -> list[Plane]:
    """Return two planes that contain the line, and one perpendicular to it."""
    margin = max(
        (one.margin for one in legend.structures if one.name == plan.structure), default=0
    )
    # The structure that limits the clearance is visible.
    needed = 1.3 * (plan.clearance + margin + plan.radius) + plan.bow + 5e-3
    least, usual, most = _HALF
    half = float(np.clip(max(min(0.3 * plan.length, usual), needed), least, most))
    x, y, z = plan.axes
    low = np.array([-_AROUND, -half])
    high = np.array([plan.length + _AROUND, half])
    pixel = float((high - low).max()) / _PIXELS
    across = plan.entry + float((plan.place - plan.entry) @ y) * y
    return [
        Plane(plan.entry, np.stack([y, x]), low, high, pixel),
        Plane(plan.entry, np.stack([y, z]), low, high, pixel),
        Plane(across, np.stack([x, z]), np.full(2, -half), np.full(2, half), 4.0 * half / _PIXELS),
    ]


def _check(plan: Plan, anatomies: Sequence[Anatomy], legend: Legend, clearance: Clearance) -> None:
    """Raise `ParameterError` if a plan is not of these images."""
    ends = np.stack([plan.entry, plan.target])
    along = np.linspace(ends[0], ends[1], 100)
    if (sample(anatomies, legend.structures, along) < -1).all():
        at = ', '.join(map(_mm, plan.target))
        raise ParameterError(f'the plan to the target {at} mm is outside the image')
    found = float(clearance.at(plan.place[np.newaxis])[0])
    if not abs(found - plan.clearance) < _SAME:
        raise ParameterError(
            f'the plan is of another anatomy: it has a clearance of {_mm(plan.clearance)} mm, and '
            f'{_mm(found)} mm at the same place in this anatomy'
        )


def _shaft(plan: Plan, clearance: Clearance, chance: Chance | None = None) -> _Shaft:
    """Insert the needle of a plan; return it with the needles of simulated insertions."""
    limits = [clearance.structure_at(plan.entry)]
    # After each motion of the guide, and after the insertion that follows.
    every = list(shafts(plan))
    for before, after in zip(every[::2], every[1::2], strict=True):
        step = np.concatenate([before, after])
        limits.append(clearance.structure_at(step[clearance.at(step).argmin()]))
    points = every[-1]
    return _Shaft(
        complete_needle(plan, _AROUND),
        limits,
        (points - plan.entry) @ plan.direction,
        clearance.at(points),
        [clearance.structure_at(point) for point in points],
        np.empty((0, 0, 3)) if chance is None else chance.shafts,
        [] if chance is None else (chance.values['success'][: len(chance.shafts)] > 0).tolist(),
    )


def _picture(plan: Plan, legend: Legend, shaft: _Shaft, name: str, shown: Section) -> Picture:
    from matplotlib.figure import Figure

    plane, across = shown.plane, name == 'across'
    wide, tall = plane.high - plane.low
    width = (0.6 if across else 0.88) * _WIDTH
    drawing = Figure(figsize=(_WIDTH, width * tall / wide))
    # The height is fitted to the legend below.
    left = 0.5 - 0.5 * width / _WIDTH if across else 0.1
    axes = drawing.add_axes((left, 0.0, width / _WIDTH, 1.0))
    line, tip = plane.coordinates(shaft.final), plane.coordinates(plan.path)
    place, target = plane.coordinates(np.stack([plan.place, plan.target]))
    if across:
        around = (plan.radius + plan.clearance) * _circle()
        draw_section(axes, shown, legend, place + np.concatenate([0.5 * around, around]))
        marks = _draw_circles(axes, plan, place)
        depth = (plan.place - plan.entry) @ plan.axes[1]
        near = f' to {plan.structure}' if plan.structure else ''
        words = (
            f'Section perpendicular to the line at a depth of {_mm(depth)} mm, at the least '
            f'clearance: {_mm(plan.clearance)} mm{near}.'
        )
        labels = 'guide axis x', 'guide axis z'
    else:
        draw_section(axes, shown, legend, np.concatenate([line, tip]))
        marks = _draw_inserted(axes, plane.coordinates(shaft.inserted), shaft.success)
        marks += _draw_needle(axes, plan, line, tip, place, target)
        labels = 'depth', f'guide axis {name[-1]}'
        words = f'Section through the line from entry point to target, along {labels[1]}.'
        normal = np.cross(*plane.axes)
        off = float(np.abs((shaft.final - plane.origin) @ normal).max())
        if off >= _VISIBLE:
            words += f' The needle is projected: it is up to {_mm(off)} mm from this section.'
        if len(shaft.inserted):
            words += f' Also projected: {len(shaft.inserted)} needles of simulated insertions.'
    axes.set(xlabel=f'{labels[0]} [mm]', ylabel=f'{labels[1]} [mm]')
    rows = _add_legend(drawing, legend, shown, marks)
    below, picture = 0.6 + 0.18 * rows, width * tall / wide
    height = below + picture + 0.15
    drawing.set_figheight(height)
    axes.set_position((left, below / height, width / _WIDTH, picture / height))
    return Picture(name, words, drawing)


def _circle() -> FloatArray:
    angles = np.linspace(0.0, 2.0 * np.pi, 60)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _draw_circles(axes: Any, plan: Plan, place: FloatArray) -> list[Any]:
    """Draw the needle and its clearance in the section across, in mm."""
    from matplotlib.patches import Circle

    free = plan.radius + plan.clearance
    return [
        axes.add_patch(
            Circle(
                tuple(1e3 * place), 1e3 * radius, ec='k', path_effects=halo(), zorder=5, **style
            )
        )
        for radius, style in (
            (plan.radius, {'fc': 'k', 'label': 'needle'}),
            (free, {'fill': False, 'ls': '--', 'lw': 1.4, 'label': 'free of margins'}),
        )
    ]


def _draw_inserted(axes: Any, lines: FloatArray, success: Sequence[bool]) -> list[Any]:
    """Draw inserted needles, shape (m, k, 2), in mm."""
    from matplotlib.collections import LineCollection

    marks = []
    for wanted, style, name in ((True, '-', 'success'), (False, '--', 'failure')):
        some = 1e3 * lines[np.array(success, dtype=np.bool_) == wanted]
        if len(some):
            added = LineCollection(
                list(some), colors=_SPREAD[wanted], lw=0.7, ls=style, zorder=3,
                label=f'inserted, {name}',
            )  # fmt: skip
            marks.append(axes.add_collection(added, autolim=False))
    return marks


def _draw_needle(
    axes: Any, plan: Plan, line: FloatArray, tip: FloatArray, place: FloatArray, target: FloatArray
) -> list[Any]:
    """Draw the shaft with its true width, the path of the tip, and marks, in mm."""
    turns = np.gradient(line, axis=0)
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    side = plan.radius * np.stack([-turns[:, 1], turns[:, 0]], axis=1)
    outline = 1e3 * np.concatenate([line + side, (line - side)[::-1]])
    marks = axes.fill(
        *outline.T, fc='k', ec='k', lw=0.6, path_effects=halo(3.0), zorder=4,
        label='needle at the end',
    )  # fmt: skip
    if plan.guide.any():
        marks += axes.plot(
            *(1e3 * tip).T, color='k', lw=1.3, ls=':', path_effects=halo(2.6), zorder=3,
            label='path of the tip',
        )  # fmt: skip
        ends = (0.0, 1e3 * plan.length)
        marks += axes.plot(
            ends, (0.0, 0.0), color='#444444', lw=0.8, ls='--', zorder=3, label='straight line'
        )
    for at, marker, size, label in (
        ((0.0, 0.0), '|', 12.0, 'entry point'),
        (1e3 * target, 'x', 9.0, 'target'),
        (1e3 * place, 'o', 12.0, f'least clearance, {_mm(plan.clearance)} mm'),
    ):
        marks += axes.plot(
            *at, ls='', marker=marker, ms=size, mec='k', mew=2.0, mfc='none', zorder=5,
            path_effects=halo(4.0), label=label,
        )  # fmt: skip
    return marks  # type: ignore[no-any-return]


def _add_legend(drawing: Any, legend: Legend, shown: Section, marks: list[Any]) -> int:
    """Add the legend of a section below it; return its number of rows."""
    from matplotlib.patches import Patch

    visible = [number for number in np.unique(shown.numbers).tolist() if number >= 0]
    entries = marks + [
        Patch(fc=legend.colors[k], ec='#555555', label=_named(legend, k)) for k in visible
    ]
    if shown.margin.any():
        entries.append(
            Patch(fc='w', ec=MARGIN_COLOR, hatch='/////', label='margin of an obstacle')
        )
    if (shown.numbers < -1).any():
        entries.append(Patch(fc=OUTSIDE_COLOR, ec='#555555', label='outside the image'))
    return _legend(drawing, entries, 'lower center')


def _legend(drawing: Any, entries: list[Any], place: str, **where: Any) -> int:
    longest = max(len(one.get_label()) for one in entries)
    columns = min(len(entries), max(1, _CHARACTERS // (longest + 8)), 4)
    added = drawing.legend(
        handles=entries, loc=place, ncols=columns, fontsize=8, frameon=False, **where
    )
    # Names may contain a dollar sign.
    for text in added.get_texts():
        text.set_parse_math(False)
    return ceil(len(entries) / columns)


def _named(legend: Legend, number: int) -> str:
    # Labels that begin with an underscore are not shown.
    name, role = legend.names[number].replace('_', ' '), legend.structures[number].role
    return name if name == role else f'{name} ({role})'


def _by_depth(plan: Plan, legend: Legend, shaft: _Shaft) -> Picture:
    """Draw the clearance in each step, and the guide."""
    from matplotlib.figure import Figure

    bent = bool(plan.guide.any())
    drawing = Figure(figsize=(_WIDTH, 5.2 if bent else 3.2), layout='constrained')
    rows = drawing.subplots(1 + bent, 1, sharex=True, squeeze=False)[:, 0]
    depths, values = 1e3 * plan.depths, 1e3 * plan.clearances
    rows[0].stairs(
        values[1:], depths, color='k', lw=1.6, baseline=None, label='least of the shaft in a step'
    )
    for k, name in enumerate(dict.fromkeys(shaft.nearest)):
        which = np.array([one == name for one in shaft.nearest])
        color, shown = legend.obstacle(name)
        ends = np.where(which, 1e3 * shaft.clearances, np.nan)
        rows[0].plot(
            1e3 * shaft.along, ends, lw=2.0, color=color,
            marker=_MARKERS[k % len(_MARKERS)], markevery=(int(which.argmax()), 12),
            label=f'complete needle, limited by {shown}' if name else 'beyond 30 mm',
        )  # fmt: skip
    rows[0].axhline(1e3 * plan.clearance, color='k', lw=0.8, ls='--')
    top = max(values[1:].max(), 1e3 * shaft.clearances.max())
    rows[0].set(ylim=(0.0, 1.1 * top), ylabel='clearance [mm]')
    words = 'Least clearance of the shaft in each step of the insertion, and clearance along the '
    words += 'complete needle with the structure that limits it; dashed: clearance of the plan, '
    words += f'{_mm(plan.clearance)} mm.'
    if bent:
        for column, (axis, style) in enumerate((('x', '-'), ('z', '--'))):
            rows[1].stairs(
                1e3 * plan.guide[:, column], depths, lw=2.0, ls=style, baseline=None,
                color=('k', '#767676')[column], label=f'guide {axis}',
            )  # fmt: skip
        rows[1].axhline(0.0, color='#999999', lw=0.6)
        rows[1].set(ylabel='guide [mm]')
        words += ' Below: setpoints of the guide.'
    entries = [one for row in rows for one in row.get_legend_handles_labels()[0]]
    # Above the axes: Matplotlib 3.6 has no place outside all axes.
    count = _legend(rows[0], entries, 'lower center', bbox_to_anchor=(0.5, 1.0))
    drawing.set_figheight(drawing.get_figheight() + 0.18 * count)
    rows[-1].set(xlabel='depth [mm]', xlim=(0.0, depths[-1]))
    return Picture('depth', words, drawing)
