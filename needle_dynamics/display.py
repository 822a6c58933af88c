# SPDX-License-Identifier: Apache-2.0
"""Display in terminals and notebooks: results as text, table, figure, DataFrame; progress."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import escape
import re
from typing import Any, Final, TYPE_CHECKING, TypeAlias

from needle_ros.errors import missing_extra
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    # Take half a second each to import, and pandas is optional.
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from pandas import DataFrame

#: Units of figures, and their factors, by SI unit.
_SHOWN: Final = {'m': ('mm', 1e3), 'm/s': ('mm/s', 1e3), 'rad': ('deg', 180.0 / np.pi)}

_MOST_ROWS: Final = 20  #: largest number of rows of a table that is shown completely
#: End of the name of a component.
_AXIS: Final = re.compile(r'([._][xyzw]|_measured|_fitted|\[?\d+\]?)$')

#: True for a progress bar, or a function that is called after each run.
Progress: TypeAlias = bool | Callable[[], object]


class Displayed:
    """Result that displays itself; a subclass defines `columns`."""

    __slots__ = ()

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return arrays (n,) by name with unit, such as ``depth [m]``; the abscissa is first."""
        raise NotImplementedError

    def __repr__(self) -> str:
        columns = self.columns()
        rows = len(next(iter(columns.values())))
        spans = (_span(*item) for item in list(columns.items())[: 2 if rows else 0])
        return f'<{", ".join([f"{type(self).__name__}: {rows} samples", *spans])}>'

    def _repr_html_(self) -> str:
        """Return the line of text, and a table of the columns or of their ranges."""
        columns = self.columns()
        heads, rows = [*columns], list(zip(*columns.values(), strict=True))
        if len(rows) > _MOST_ROWS and all(one.dtype.kind == 'f' for one in columns.values()):
            heads = ['', 'first', 'smallest', 'largest', 'last']
            rows = [(name, *_range(values)) for name, values in columns.items()]
        more = len(rows) - _MOST_ROWS
        lines = [''.join(f'<td>{_cell(one)}</td>' for one in row) for row in rows[:_MOST_ROWS]]
        body = ''.join(f'<tr>{line}</tr>' for line in lines)
        return (
            f'<p>{escape(repr(self))}</p><table><thead><tr>'
            f'{"".join(f"<th>{escape(head)}</th>" for head in heads)}</tr></thead>'
            f'<tbody>{body}</tbody></table>{f"<p>{more} more rows</p>" if more > 0 else ""}'
        )

    def to_dataframe(self) -> DataFrame:
        """Return the columns as a DataFrame of pandas; ParameterError if it is missing."""
        try:
            from pandas import DataFrame
        except ModuleNotFoundError as error:
            raise missing_extra(error, 'to_dataframe', 'pandas') from error
        return DataFrame(self.columns())

    def plot(self, figure: Figure | None = None) -> list[Axes]:
        """Draw the columns over the first one, by default in a new figure; return all axes."""
        # Components share axes, and zeros are left out.
        drawn = ((name, one) for name, one in self.columns().items() if one.dtype.kind in 'fb')
        (name, abscissa), *others = drawn
        panels: dict[str, list[tuple[str, NDArray[Any]]]] = {}
        for column, values in others:
            word, _, unit = column.partition(' [')
            common = _AXIS.sub('', word)
            panels.setdefault(f'{common} [{unit}', []).append((word.replace('_', ' '), values))
        # Such as torque and angle of a needle that does not turn.
        panels = {k: one for k, one in panels.items() if any(v.any() for _, v in one)} or panels
        figure = figure or new_figure(1.0 + 1.6 * len(panels))
        found = list(figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0])
        label, factor = shown(name)
        for axes, (panel, lines) in zip(found, panels.items(), strict=True):
            text, scale = shown(panel)
            for word, values in lines:
                axes.plot(factor * abscissa, scale * values, label=word)
            axes.set_ylabel(text)
            axes.grid(visible=True, alpha=0.3)
            if len(lines) > 1:
                axes.legend()
        found[-1].set_xlabel(label)
        return found


def new_figure(height: float) -> Figure:
    """Return a figure of ``matplotlib.pyplot`` with a height [in]."""
    from matplotlib import pyplot as plt

    return plt.figure(figsize=(9.0, height), layout='constrained')


def shown(name: str) -> tuple[str, float]:
    """Return the label of a column in the unit of figures, and the factor of its values."""
    word, _, unit = name.removesuffix(']').partition(' [')
    unit, factor = _SHOWN.get(unit, (unit, 1.0))
    return word.replace('_', ' ') + (f' [{unit}]' if unit else ''), factor


def _span(name: str, values: NDArray[Any]) -> str:
    word, _, unit = name.removesuffix(']').partition(' [')
    return f'{word.replace("_", " ")} {values[0]:.4g} to {values[-1]:.4g} {unit}'


def _range(values: NDArray[Any]) -> tuple[float, ...]:
    """Return the first, smallest, largest and last value; NaN is ignored."""
    known = values[np.isfinite(values)]
    low, high = (known.min(), known.max()) if len(known) else (np.nan, np.nan)
    return float(values[0]), float(low), float(high), float(values[-1])


def _cell(value: Any) -> str:
    # Zero without its sign.
    return f'{value + 0.0:.6g}' if isinstance(value, float) else escape(str(value))


@contextmanager
def progress_of(
    progress: Progress | None, total: int, unit: str
) -> Iterator[Callable[[], object]]:
    """Yield the function to call after each of a number of runs."""
    if callable(progress):
        yield progress
    elif progress:
        # Widgets in a notebook, text elsewhere.
        from tqdm.auto import tqdm

        with tqdm(total=total, unit=f' {unit}', leave=False) as bar:
            yield bar.update
    else:
        yield lambda: None
