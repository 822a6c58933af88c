# SPDX-License-Identifier: Apache-2.0
"""Layers of tissue along a line, from the stiffness of labels."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from math import ceil, isfinite
from typing import Final, NamedTuple

from needle_controller.steering.insertion_plan import MOST_LAYERS
from needle_dynamics.arrays import FloatArray
from needle_dynamics.parameters import NeedleParameters
from needle_planning.anatomy import Anatomy
from needle_planning.clearance import image_frame
import numpy as np

_SPACING: Final = 1e-4  #: Spacing of the points of a line whose labels are read [m].
_LEAST: Final = 1e-3  #: Least stiffness [N/m^2]: its logarithm is finite.
_WIDEST: Final = 2.0  #: Largest spread of a prior.


class _Tissue(NamedTuple):
    """Tissue of a part of the line."""

    stiffness: float  #: [N/m^2]
    spread: float  #: standard deviation of its logarithm
    own: int  #: layer of the needle file


def tissue_layers(
    anatomies: Sequence[Anatomy], entry: FloatArray, target: FloatArray, needle: NeedleParameters
) -> FloatArray:
    """
    Return the layers of tissue along a line.

    Where no label has a stiffness, the tissue is that of the needle file. If there are more than
    eight layers, successive layers that differ least become one.

    Parameters
    ----------
    anatomies : sequence of Anatomy
        Images; where several labels have a stiffness, the first image is used.
    entry, target : ndarray, shape (3,)
        Ends of the line in patient coordinates [m].
    needle : NeedleParameters
        Needle and tissue of the needle file.

    Returns
    -------
    ndarray, shape (layers, 3)
        Depth at which each layer begins [m], median stiffness [N/m^2], and standard deviation of
        its logarithm; without rows if no label along the line has a stiffness.

    """
    length = float(np.linalg.norm(target - entry))
    count = max(1, ceil(length / _SPACING))
    depths = (np.arange(count) + 0.5) * length / count
    points = entry + np.outer(depths / length, target - entry)
    own = np.searchsorted(needle.tissue.starts, depths, side='right') - 1
    tissues = [_Tissue(needle.tissue.stiffnesses[k], 0.0, int(k)) for k in own]
    labeled = False
    for anatomy in reversed(anatomies):
        found = {
            label: (one.stiffness, one.spread if isfinite(one.spread) else 0.0)
            for label, one in anatomy.structures.items()
            if isfinite(one.stiffness)
        }
        frame, shape = image_frame(anatomy), np.array(anatomy.labels.shape)
        index = np.rint(frame.of_patient(points) / frame.spacing).astype(np.int64)
        for k in np.flatnonzero(((index >= 0) & (index < shape)).all(axis=1)).tolist():
            if (label := int(anatomy.labels[tuple(index[k])])) in found:
                tissues[k], labeled = _Tissue(*found[label], tissues[k].own), True
    if not labeled:
        return np.zeros((0, 3))
    runs = [(one, len(list(same))) for one, same in groupby(tissues)]
    parts = np.array([(size, max(one.stiffness, _LEAST), one.spread) for one, size in runs])
    while len(parts) > MOST_LAYERS:
        parts = _merged(parts)
    starts = np.append(0.0, np.cumsum(parts[:-1, 0])) * length / count
    return np.column_stack([starts, parts[:, 1:]])


def _merged(parts: FloatArray) -> FloatArray:
    """Merge the two successive parts (size, stiffness, spread) that differ least."""
    sizes, logs = parts[:, 0], np.log(parts[:, 1])
    # Sum of squares that a common mean adds.
    costs = sizes[1:] * sizes[:-1] / (sizes[1:] + sizes[:-1]) * np.diff(logs) ** 2
    k = int(costs.argmin())
    both = slice(k, k + 2)
    size = sizes[both].sum()
    mean = sizes[both] @ logs[both] / size
    variance = sizes[both] @ (parts[both, 2] ** 2 + (logs[both] - mean) ** 2) / size
    one = size, np.exp(mean), min(np.sqrt(variance), _WIDEST)
    return np.vstack([parts[:k], one, parts[k + 2 :]])
