"""What the tip of a steered needle does along the way of a recording, by cause."""

from __future__ import annotations

from math import ceil
from typing import Final, NamedTuple

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.cut import insert, NOT_FELT
from needle_dynamics.steering.needle import empty_cut
from needle_identification.steering.recording import SteeringRecording
import numpy as np

#: How guide and depth change between samples.
ORDERS: Final = ('together', 'guide first')

#: What makes a needle drift, each with its constants.
TERMS: Final = {
    'tilt': ('tilt_x', 'tilt_z'),
    'frame': ('frame_x', 'frame_z', 'frame_y'),
    'bevel': ('curvature_z', 'curvature_x'),
}

#: Longest element [m]: good to a micrometer, and the same for all bending lengths, so that the
#: responses change smoothly with them.
_ELEMENT: Final = 1.5e-3


class Responses(NamedTuple):
    """
    Motions of the tip at the samples, each for one cause.

    Attributes
    ----------
    guide : ndarray, shape (n, 2)
        In x and z, by the motion of the guide [m].
    tilt : ndarray, shape (n,)
        Per tilt of the guide, in its plane [m].
    bevel : ndarray, shape (n, 2)
        In x and z, by a bevel that turns a long needle with 1/m [m^2].

    """

    guide: FloatArray
    tilt: FloatArray
    bevel: FloatArray


def responses(
    recording: SteeringRecording, free: float, length: float, skin: float, order: str
) -> Responses:
    """
    Simulate a recorded insertion, once for each cause.

    Parameters
    ----------
    recording : SteeringRecording
        The recording.
    free : float
        Free length between guide and skin [m].
    length : float
        Bending length lambda [m].
    skin : float
        Stiffness of the skin over that of the tissue per length [m].
    order : str
        One of `ORDERS`.

    Returns
    -------
    Responses
        Motions of the tip.

    """
    depth, guide = recording.depth, recording.guide - recording.guide[0]
    poses = np.zeros((3, len(depth), 6))
    poses[:, :, 0] = depth
    poses[0, :, 1], poses[0, :, 3] = guide.T
    poses[1, :, 4] = 1.0
    poses[2, :, 5] = recording.roll
    if order == 'guide first':
        # At each depth but the last one the guide moves on before the needle does.
        poses = np.repeat(poses, 2, axis=1)[:, 1:]
        poses[:, 1::2, 0] = depth[:-1]
    # All of it depends on lengths alone: of unit bending stiffness.
    reach = float(depth.max()) + free
    # Nodes where the guide changes its way, if the steps are even.
    steps = np.diff(depth)
    step = float(np.median(steps[steps > _ELEMENT])) if (steps > _ELEMENT).any() else _ELEMENT
    element = step / ceil(step / _ELEMENT - 1e-6)
    tissue = 4.0 / length**4
    constants = np.array([[1.0, element, skin * tissue, 0.0, 0.0, reach, free]])
    layers = np.zeros((3, 3, 1))
    layers[:, 1] = tissue
    layers[2, 2] = 1.0 / length
    tips = np.empty((3, poses.shape[1], 2))
    insert(
        constants,
        layers,
        1.0,
        np.zeros((1, 0, 2)),
        poses,
        np.arange(3),
        empty_cut(reach, element, 1),
        tips,
        NOT_FELT,
    )
    if order == 'guide first':
        tips = tips[:, ::2]
    return Responses(guide=tips[0], tilt=tips[1, :, 1], bevel=tips[2])


def drift(term: str, recording: SteeringRecording, r: Responses) -> FloatArray:
    """
    Return what the tip does per unit of the constants of a term.

    Parameters
    ----------
    term : str
        One of `TERMS`.
    recording : SteeringRecording
        The recording.
    r : Responses
        Its responses.

    Returns
    -------
    ndarray, shape (2 n, k)
        Motions of the tip in x, then in z, by the constants of the term [m per unit].

    """
    zero, depth = np.zeros(len(r.tilt)), recording.depth
    (guide_x, guide_z), (bevel_x, bevel_z) = r.guide.T, r.bevel.T
    pairs = {
        'tilt': [(r.tilt, zero), (zero, r.tilt)],
        # Turns about z and x let the tip seem to drift with depth; one about y mixes x and z.
        'frame': [(depth, zero), (zero, depth), (guide_z, -guide_x)],
        # As it pushes along z at zero roll, and a quarter of a turn further on.
        'bevel': [(bevel_x, bevel_z), (bevel_z, -bevel_x)],
    }[term]
    return np.array([np.concatenate(pair) for pair in pairs]).T
