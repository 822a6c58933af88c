# SPDX-License-Identifier: Apache-2.0
"""Simulate the tip response of a recorded insertion to guide, tilt and bevel."""

from math import ceil
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.cut import insert, NO_FORCES
from needle_dynamics.steering.needle import empty_cut
from needle_identification.steering.recording import SteeringRecording
import numpy as np

ORDERS: Final = ('together', 'guide first')  #: order of guide motion and insertion between samples

#: Drift terms and their constants.
TERMS: Final = {
    'tilt': ('tilt_x', 'tilt_z'),
    'frame': ('frame_x', 'frame_z', 'frame_y'),
    'bevel': ('curvature_z', 'curvature_x'),
}

#: Longest element [m]: accurate to a micrometer, and equal for all bending lengths, so that the
#: responses are smooth functions of them.
_ELEMENT: Final = 1.5e-3

_CAUSES: Final = np.arange(3)
_NO_WANDER: Final = np.zeros((1, 0, 2))


class TipResponses(NamedTuple):
    """Tip motion at the samples by cause."""

    guide: FloatArray  # (n, 2) x and z, by the motion of the guide [m]
    tilt: FloatArray  # (n,) per tilt of the guide, in its plane [m]
    bevel: FloatArray  # (n, 2) x and z, per curvature of a long needle by the bevel [m^2]


class SimulatedCauses:
    """A recorded insertion for each cause, in one order; the lengths are given later."""

    def __init__(self, recording: SteeringRecording, order: str) -> None:
        depth, guide = recording.depth, recording.guide - recording.guide[0]
        poses = np.zeros((3, len(depth), 6))
        poses[:, :, 0] = depth
        poses[0, :, 1], poses[0, :, 3] = guide.T
        poses[1, :, 4] = 1.0
        poses[2, :, 5] = recording.roll
        if order == 'guide first':
            # The guide moves to its next position before the needle, except at the last depth.
            # Contiguous, as compiled.
            poses = np.repeat(poses, 2, axis=1)[:, 1:].copy()
            poses[:, 1::2, 0] = depth[:-1]
        self._poses, self._deepest = poses, float(depth.max())
        self._every = 2 if order == 'guide first' else 1
        # Nodes at the depths of guide motions, for equal steps.
        steps = np.diff(depth)
        step = float(np.median(steps[steps > _ELEMENT])) if (steps > _ELEMENT).any() else _ELEMENT
        self._element = step / ceil(step / _ELEMENT - 1e-6)

    def responses(self, free: float, length: float, skin: float) -> TipResponses:
        """Simulate the insertion for lengths in m, and skin over tissue stiffness."""
        # The response depends only on lengths: unit bending stiffness.
        reach, element, tissue = self._deepest + free, self._element, 4.0 / length**4
        constants = np.array([[1.0, element, skin * tissue, 0.0, 0.0, reach, free]])
        layers = np.zeros((3, 3, 1))
        layers[:, 1] = tissue
        layers[2, 2] = 1.0 / length
        tips = np.empty((3, self._poses.shape[1], 2))
        cut = empty_cut(reach, element, 1)
        insert(constants, layers, 1.0, _NO_WANDER, self._poses, _CAUSES, cut, tips, NO_FORCES)
        guide, tilt, bevel = tips[:, :: self._every]
        return TipResponses(guide=guide, tilt=tilt[:, 1], bevel=bevel)


def drift(term: str, recording: SteeringRecording, r: TipResponses) -> FloatArray:
    """Return tip motion in x, then z, per unit of the constants of a term, shape (2 n, k)."""
    zero, depth = np.zeros(len(r.tilt)), recording.depth
    (guide_x, guide_z), (bevel_x, bevel_z) = r.guide.T, r.bevel.T
    pairs = {
        'tilt': [(r.tilt, zero), (zero, r.tilt)],
        # Rotations about z and x appear as a drift with depth; a rotation about y mixes x and z.
        'frame': [(depth, zero), (zero, depth), (guide_z, -guide_x)],
        # Load along z at zero roll, and rotated by a quarter turn.
        'bevel': [(bevel_x, bevel_z), (bevel_z, -bevel_x)],
    }[term]
    return np.array([np.concatenate(pair) for pair in pairs]).T
