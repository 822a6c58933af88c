# SPDX-License-Identifier: Apache-2.0
"""Pictures of steering match the code that draws them, and its results."""

from __future__ import annotations

from pathlib import Path
import runpy

from matplotlib.image import imread
import numpy as np
import pytest

IMAGES = Path(__file__).parents[2] / 'docs' / 'images'
SCRIPT = IMAGES / 'steering.py'


@pytest.mark.parametrize('name', ['steering', 'bending', 'targets'])
def test_shipped_pictures_match_their_scripts(tmp_path: Path, name: str) -> None:
    script = IMAGES / f'{name}.py'
    figure = runpy.run_path(str(script))['draw']()
    figure.savefig(tmp_path / 'now.png', dpi=120)
    now, kept = imread(tmp_path / 'now.png'), imread(script.with_suffix('.png'))
    assert now.shape == kept.shape
    # Tolerance for the rounding of colors; a curvature smaller by 10 % gives 0.001.
    assert np.abs(now - kept).mean() < 3e-4


def test_drawn_needles_bend_and_follow_their_paths() -> None:
    """A bevel bends one needle, a rotation reverses it, the guide bends another needle."""
    names = runpy.run_path(str(SCRIPT))
    bent, turned, moved = (one for one, _, _ in names['needles']())
    assert bent.tip[2] > 8e-3
    assert abs(turned.tip[2]) < 0.5 * bent.tip[2]
    assert moved.tip[2] < -3e-3
    depths, lengths, found = names['authority']()
    assert found[:, 0].min() > 0.8
    # Between one and four bending lengths the tip moves opposite; deeper it hardly moves.
    within = (depths > 1.2 * lengths[0]) & (depths < 3.5 * lengths[0])
    assert found[0, within].max() < 0.0
    assert np.abs(found[0, depths > 4.0 * lengths[0]]).max() < 0.05
    above, below = names['draw']().axes[:2]
    assert above.get_aspect() == 1.0
    assert 'depth' in above.get_xlabel()
    assert 'lambda' in below.get_ylabel()


def test_first_picture_shows_a_bending_needle() -> None:
    """The tip moves opposite to the guide, by a centimeter in both planes."""
    one, shapes = runpy.run_path(str(IMAGES / 'bending.py'))['insert']()
    assert one.tip[0] < -0.01
    assert one.tip[2] > 0.01
    assert shapes[-1][0].tolist() == [8e-3, -0.04, 0.0]
