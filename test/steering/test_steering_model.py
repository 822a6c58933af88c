# SPDX-License-Identifier: Apache-2.0
"""Responses of the steering model: superposition and cancellation."""

from __future__ import annotations

from dataclasses import replace
from math import pi

from needle_controller import SteeringModel, SteeringPrior
from needle_dynamics import NEEDLES, SteeredNeedle
import numpy as np
from numpy.testing import assert_allclose
import pytest

NEEDLE, _STEERING, _ = NEEDLES['bending_35mm']
#: Two layers, and elements of the same length as in the model.
NEEDLE = replace(NEEDLE, layer_depths=(0.03125,), layer_stiffnesses=(4e4,))
STEERING = replace(_STEERING, skin_stiffness=400.0, bevel_load=(1.0, 0.5), element=1.25e-3)
DEPTHS = np.linspace(0.005, 0.08, 16)
EXACT = SteeringPrior(spread=0.0)


@pytest.mark.parametrize('together', [False, True])
@pytest.mark.parametrize('cause', ['guide 0', 'guide 7', 'tilt', 'bevel 0', 'bevel 8'])
def test_each_response_equals_an_insertion_with_one_cause(cause: str, together: bool) -> None:
    """A unit of each cause gives the tip and the force on the guide of `SteeredNeedle`."""
    model = SteeringModel(NEEDLE, STEERING, DEPTHS, EXACT, together=together)
    kind, _, number = cause.partition(' ')
    j, n = int(number or 0), len(DEPTHS) - 1
    steering = STEERING if kind == 'bevel' else replace(STEERING, bevel_load=(0.0,))
    # The bevel pushes along z in step j, and along x before and after it; step 0 is the skin.
    rolls = np.full(n + 1, 0.5 * pi)
    rolls[j] = 0.0
    guides = np.zeros((n + 1, 2))
    if kind == 'guide':
        guides[1 + j, 0] = 1.0
    tilt = (1.0, 0.0) if kind == 'tilt' else (0.0, 0.0)
    needle = SteeredNeedle(NEEDLE, steering, tilt=tilt, roll=float(rolls[0]))
    needle.move(depth=float(DEPTHS[0]))
    tips, loads = [needle.tip], []
    for to, roll, guide in zip(DEPTHS[1:], rolls[1:], guides[1:], strict=True):
        needle.move(roll=float(roll))
        if not together:
            needle.move(guide=guide)
            loads.append(needle.guide_load[0])
        needle.move(depth=float(to), guide=guide)
        if together:
            loads.append(needle.guide_load[0])
        tips.append(needle.tip)
    axis = 1 if kind == 'bevel' else 0
    responses = model.responses
    tip, load = {
        'guide': (responses.guide[0, :, j], responses.guide_load[0, :, j]),
        'tilt': (responses.causes[0, :, 2], responses.causes_load[0, :, 2]),
        'bevel': (responses.bevel[0, :, j], responses.bevel_load[0, :, j]),
    }[kind]
    # Rounding over 64 elements, and in the nodes of `SteeredNeedle`, which are sums of elements.
    found, force = np.array(tips)[:, 2 * axis], np.array(loads)[:, axis]
    assert_allclose(tip, found, atol=1e-12 * np.abs(found).max())
    assert_allclose(load, force, atol=1e-12 * np.abs(force).max())


def test_elements_end_at_steps_and_layers() -> None:
    """Between nodes at steps and borders the needle is exact: shorter elements change nothing."""
    needle = replace(NEEDLE, layer_depths=(0.0317,))
    uneven = np.array([0.0037, 0.011, 0.0291, 0.03, 0.04, 0.052])
    whole = SteeringModel(needle, STEERING, uneven, EXACT)
    halved = np.sort(np.append(uneven, 0.5 * (uneven[:-1] + uneven[1:])))
    fine = SteeringModel(needle, STEERING, halved, EXACT)
    # A position of the guide in both halves of a step equals the position in the step.
    pairs = fine.responses.guide[0, ::2].reshape(len(uneven), -1, 2).sum(axis=2)
    # A path that is straight in an element is straight in its parts: rounding only.
    assert_allclose(whole.responses.guide[0], pairs, atol=1e-12)


def test_construction_reports_progress_and_can_be_cancelled() -> None:
    class CancelledError(Exception):
        pass

    seen = []

    def progress(done: int, total: int) -> None:
        seen.append((done, total))
        if done == 3:
            raise CancelledError

    with pytest.raises(CancelledError):
        SteeringModel(NEEDLE, STEERING, DEPTHS, progress=progress)
    # A grid of 13 x 4, and 2 x 3 kinematic points.
    assert seen == [(k, 58) for k in range(4)]
    seen.clear()
    SteeringModel(NEEDLE, STEERING, DEPTHS, EXACT, progress=progress)
    assert seen == [(0, 1)]
