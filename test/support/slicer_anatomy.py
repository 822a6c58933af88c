# SPDX-License-Identifier: Apache-2.0
"""Small label map as of 3D Slicer, with its roles and a target [mm]: skin, bone and a tumor."""

from __future__ import annotations

from typing import Any, Final

from needle_insertion.slicer.messages import SEGMENTATION
import numpy as np
import pyigtl

LABELS: Final = """\
structures:
  1: {role: entry, name: skin}
  2: {role: obstacle, name: bone, margin: 2mm}
  3: {role: target, name: tumor}
"""

VALUES: Final = np.zeros((60, 60, 80), dtype=np.int16)
VALUES[:, :, 77:79], VALUES[10:34, :, 50], VALUES[27:34, 27:34, 7:14] = 1, 2, 3

#: From voxels of 1 mm to the patient, RAS [mm].
MATRIX: Final = np.eye(4)
MATRIX[:3, 3] = -30.0, 20.0, -40.0

TARGET: Final = MATRIX[:3, 3] + (30.0, 30.0, 10.0)


def image_message(values: Any, matrix: Any, *, version: int = 1, lps: bool = False) -> bytes:
    """Return the message of pyigtl; values of shape (i, j, k), and its matrix [mm]."""
    message = pyigtl.ImageMessage(
        np.ascontiguousarray(values.transpose(2, 1, 0)),
        ijk_to_world_matrix=matrix,
        world_coordinate_system='lps' if lps else 'ras',
        device_name=SEGMENTATION,
    )
    message.header_version = version
    message.metadata = {'key': 'value'} if version > 1 else {}
    return bytes(message.pack())
