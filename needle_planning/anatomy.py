# SPDX-License-Identifier: Apache-2.0
"""Segmented image in patient coordinates: labels, and what each label means for a needle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import nan
from typing import Final

from needle_dynamics import FloatArray
import numpy as np
from numpy.typing import NDArray

#: Roles of a label: never touched; pierced; to reach; where the needle may enter.
ROLES: Final = ('obstacle', 'tissue', 'target', 'entry')


@dataclass(frozen=True, slots=True, kw_only=True)
class Structure:
    """Meaning of a label."""

    name: str
    role: str  #: one of `ROLES`
    margin: float = 0.0  #: distance that the needle keeps from an obstacle [m]
    stiffness: float = nan  #: median stiffness of tissue [N/m^2]; nan: that of the needle file
    spread: float = nan  #: standard deviation of its logarithm [1]
    source: str = ''  #: source of the stiffness


@dataclass(frozen=True, slots=True, kw_only=True)
class Anatomy:
    """
    Segmented image; patient coordinates are RAS [m]: x to the right, y to the front, z up.

    Voxels without a structure are empty: a needle may pass through them.
    """

    labels: NDArray[np.integer]  #: label of each voxel, shape (i, j, k)
    to_patient: FloatArray  #: from voxel indices (center of the voxel) to patient, shape (4, 4)
    structures: Mapping[int, Structure]  #: by label
