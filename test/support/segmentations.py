# SPDX-License-Identifier: Apache-2.0
"""Segmentations for tests, written by the libraries of their formats."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from needle_dynamics import FloatArray
from needle_planning import Anatomy
import nibabel
from nibabel.affines import apply_affine
import nrrd
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
import yaml

#: Between RAS and LPS.
LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
#: Roles for the labels 1 and 2.
ROLES = {1: {'role': 'obstacle', 'margin': '2mm'}, 2: {'role': 'tissue'}}


def write_nifti(path: Path, values: NDArray[Any], affine: FloatArray, **codes: int) -> Path:
    """Write values with an affine in RAS [mm]."""
    image = nibabel.Nifti1Image(values, affine)
    image.header.set_xyzt_units('mm')
    image.set_sform(affine, codes.get('sform', 1))
    image.set_qform(affine, codes.get('qform', 0))
    nibabel.save(image, path)
    return path


def write_nrrd(path: Path, values: NDArray[Any], affine: FloatArray, **fields: Any) -> Path:
    """Write values with an affine in LPS [mm]; a first axis of layers has no direction."""
    directions = np.full((values.ndim, 3), np.nan)
    directions[-3:] = affine[:3, :3].T
    header = {
        'space': 'left-posterior-superior',
        'space directions': directions,
        'space origin': affine[:3, 3],
        **fields,
    }
    nrrd.write(str(path), values, {key: one for key, one in header.items() if one is not None})
    return path


def write_labels(path: Path, structures: Mapping[Any, Any], **others: Any) -> Path:
    # Copies: aliases are not read.
    copies = {key: dict(one) for key, one in structures.items()}
    path.write_text(yaml.safe_dump({'structures': copies, **others}), 'utf-8')
    return path


def positions(voxels: NDArray[np.bool_], affine: FloatArray) -> FloatArray:
    """Return the positions of voxels, shape (n, 3)."""
    return np.asarray(apply_affine(affine, np.argwhere(voxels)))


def positions_of(anatomy: Anatomy, name: str) -> FloatArray:
    """Return the positions of the voxels of a structure [m], shape (n, 3)."""
    (label,) = (label for label, one in anatomy.structures.items() if one.name == name)
    return positions(anatomy.labels == label, anatomy.to_patient)


def assert_same_positions(one: FloatArray, other: FloatArray) -> None:
    """Assert that two sets of voxels are the same, to 1 um: files have single precision."""
    assert len(one) == len(other)
    if len(one):
        apart, nearest = cKDTree(other).query(one)
        assert np.max(apart) < 1e-6
        assert len(set(nearest)) == len(other)
