"""Pictures of the documentation: they can be drawn, and show what they say."""

from __future__ import annotations

from io import BytesIO

from needle_insertion.paper.convergence import convergence_figure
import numpy as np


def test_convergence_figure_shows_errors_that_fall() -> None:
    """Every line of the picture falls with the number of modes, down to where it can be seen."""
    figure = convergence_figure()
    left, right = figure.axes
    lines = [*left.get_lines(), *right.get_lines()]
    assert len(lines) == 7
    for line in lines:
        errors = np.asarray(line.get_ydata(), dtype=float)
        errors = errors[np.isfinite(errors)]
        assert errors.size >= 6
        assert np.all(errors > 0.0)
        assert np.all(np.diff(errors) < 0.0)
    for axes in (left, right):
        assert axes.get_xlabel() == 'number of modes n'
        assert 'exact beam, relative' in axes.get_ylabel()
        assert axes.get_yscale() == 'log'
    buffer = BytesIO()
    figure.savefig(buffer, format='png')
    assert buffer.getvalue().startswith(b'\x89PNG')
