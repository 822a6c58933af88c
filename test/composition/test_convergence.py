# SPDX-License-Identifier: Apache-2.0
"""Figure of the convergence with the number of modes."""

from __future__ import annotations

from pathlib import Path
import runpy

import numpy as np

SCRIPT = Path(__file__).parents[2] / 'docs' / 'images' / 'convergence.py'


def test_errors_decrease_with_every_mode() -> None:
    """Every line decreases with the number of modes, down to the visible range."""
    left, right = runpy.run_path(str(SCRIPT))['draw']().axes
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
