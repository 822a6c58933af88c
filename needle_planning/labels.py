# SPDX-License-Identifier: Apache-2.0
"""Read the roles of labels from `labels.yaml`, and the anatomy that they make of segmentations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from math import prod
from pathlib import Path
from reprlib import repr as short
from typing import Any, Final

from needle_dynamics import FloatArray
from needle_planning.anatomy import Anatomy, COVERS, ROLES, SegmentationError, Structure
from needle_planning.segmentation import read_layers
from needle_planning.voxels import LARGEST_VALUE, Layer, MOST_VOXELS, planes, present, SPACES
from needle_ros.errors import ParameterError, shown
from needle_ros.files import read_yaml
from needle_ros.settings import (
    check_choice,
    CheckedSettings,
    choice,
    constant,
    from_values,
    positive,
    text,
    unknown_name,
)  # fmt: skip
import numpy as np
from numpy.typing import NDArray

_MOST: Final = 254  #: Largest number of structures.
_SHOWN: Final = 10  #: Names in a message.
_SAME: Final = 1e-6  #: Largest distance between corners of the same grid [m].
_WIDEST: Final = 0.5  #: Largest plausible margin [m].
_SOFTEST: Final = 100.0  #: Least plausible stiffness [N/m^2].


@dataclass(frozen=True, slots=True, kw_only=True)
class _Entry(CheckedSettings):
    """Keys of a structure; those that are given become fields of `Structure`."""

    role: str = choice('obstacle', ROLES)
    name: str = text('', 'name, in place of the label')
    margin: float = constant(0.0, 'm', 'distance that the needle keeps')
    stiffness: float = positive(1.0, 'N/m^2', 'median stiffness')
    spread: float = constant(
        0.0, '1', 'standard deviation of the logarithm of the stiffness', high=2.0
    )
    source: str = text('', 'source of the stiffness')


@dataclass(frozen=True, slots=True, kw_only=True)
class _Grid(CheckedSettings):
    """Settings for files that do not state them."""

    space: str = text('', 'RAS or LPS')
    spacing: float = positive(1e-3, 'm', 'spacing of the voxels of surfaces', high=0.1)


#: Valid keys of a structure by its role.
_PIERCED: Final = ('role', 'name', 'stiffness', 'spread', 'source')
_KEYS: Final = dict.fromkeys(ROLES, _PIERCED) | {'obstacle': ('role', 'name', 'margin')}
_TOP: Final = ('structures', 'others', *(item.name for item in fields(_Grid)))


@dataclass(frozen=True, slots=True, eq=False)
class Labels:
    """Roles of labels, by value or name; a structure with a smaller number covers larger ones."""

    structures: Mapping[int, Structure]  #: by number, from 1
    numbers: Mapping[int | str, int]  #: number of each label
    others: int  #: number of all other labels, or 0 if these are refused
    grid: _Grid


def read_labels(path: Path | str) -> Labels:
    """
    Read a file of labels.

    Parameters
    ----------
    path : Path or str
        File in YAML; see `docs/howto/segmentation.md`.

    Returns
    -------
    Labels
        Structures, numbered by role (obstacle, target, entry, tissue), obstacles by descending
        margin, and else by their order in the file.

    Raises
    ------
    ParameterError
        If it is not readable or invalid, with its name and the valid keys.
    """
    document = read_yaml(path)
    try:
        return _labels(document)
    except ParameterError as error:
        raise ParameterError(f'{path}: {error}') from error


def _labels(document: Any) -> Labels:
    if not isinstance(document, Mapping):
        raise ParameterError(f'labels have the keys {", ".join(_TOP)}, got {short(document)}')
    if unknown := [key for key in document if key not in _TOP]:
        raise ParameterError(unknown_name(str(unknown[0]), _TOP))
    given = document.get('structures')
    if not isinstance(given, Mapping) or not 0 < len(given) <= _MOST:
        raise ParameterError(
            f'structures must have 1 to {_MOST} labels with a role, got {short(given)}'
        )
    for key in given:
        is_value = isinstance(key, int) and not isinstance(key, bool)
        if not (1 <= key <= LARGEST_VALUE if is_value else isinstance(key, str)):
            raise ParameterError(
                f'structures: a label is a number from 1 to {LARGEST_VALUE} or a name, got {key!r}'
                + ('; write a name in quotes' if isinstance(key, bool) else '')
            )
    read = {key: _structure(f'structures: {key}', str(key), one) for key, one in given.items()}
    ranked = sorted(read.items(), key=lambda item: _rank(item[1]))
    numbers = {key: number for number, (key, _) in enumerate(ranked, 1)}
    structures = {number: one for number, (_, one) in enumerate(ranked, 1)}
    others = 0
    if 'others' in document:
        others = len(structures) + 1
        structures[others] = _structure('others', 'others', document['others'])
    count = Counter(one.name for one in structures.values())
    if twice := [name for name, times in count.items() if times > 1]:
        raise ParameterError(f'structures: {count[twice[0]]} of them have the name {twice[0]}')
    if not any(one.role == 'obstacle' for one in structures.values()):
        raise ParameterError('structures has no obstacle: without one, clearance is undefined')
    if 'space' in document:
        check_choice('space', document['space'], SPACES)
    grid = from_values(_Grid, {key: document[key] for key in _TOP[2:] if key in document})
    return Labels(structures, numbers, others, grid)


def _structure(where: str, name: str, given: Any) -> Structure:
    if not isinstance(given, Mapping):
        raise ParameterError(f'{where} must have a role: {{role: tissue}}, got {given!r}')
    role: Any = given.get('role')
    check_choice(f'{where}.role', role, ROLES)
    for key in given:
        if key in _KEYS[role]:
            continue
        if key in _PIERCED or key in _KEYS['obstacle']:
            raise ParameterError(
                f'{where}: {key} is not of the role {role}; valid: {", ".join(_KEYS[role])}'
            )
        raise ParameterError(unknown_name(f'{where}.{key}', (f'{where}.{k}' for k in _KEYS[role])))
    if role == 'obstacle' and 'margin' not in given:
        raise ParameterError(f'{where} is an obstacle and must have a margin, such as margin: 2mm')
    if 'stiffness' not in given and ('spread' in given or 'source' in given):
        raise ParameterError(f'{where} has a spread or a source, but no stiffness')
    entry = from_values(_Entry, given, f'{where}.')
    if entry.margin > _WIDEST:
        raise ParameterError(
            f'{where}.margin is {entry.margin:g} m, at most {_WIDEST:g} is plausible: numbers '
            'without a unit are m, write 2mm for 2 mm'
        )
    if 'stiffness' in given and entry.stiffness < _SOFTEST:
        raise ParameterError(
            f'{where}.stiffness is {entry.stiffness:g} N/m^2, at least {_SOFTEST:g} is plausible: '
            'numbers without a unit are N/m^2, write 20kPa for 20 kPa'
        )
    values = {key: getattr(entry, key) for key in given}
    # It may be a name of an external file, and is printed.
    return Structure(**{**values, 'name': shown(entry.name or name)})


def _rank(one: Structure) -> tuple[int, float]:
    """Return the rank of a structure: where structures overlap, the smallest is kept."""
    return COVERS.index(one.role), -one.margin


def read_anatomy(
    segmentation: Path | str | Sequence[Path | str], labels: Path | str
) -> tuple[Anatomy, ...]:
    """
    Read one anatomy for each grid of segmentations.

    Files on the same grid become one anatomy. Where structures overlap, an obstacle covers a
    target, a target an entry, and an entry tissue; of two obstacles the one with the larger
    margin is kept, and else the structure that is first in the file of labels. Each structure
    and each label has a role, or it is refused.

    Parameters
    ----------
    segmentation : Path or str, or sequence of these
        Files ``.nrrd``, ``.nhdr``, ``.seg.nrrd``, ``.nii``, ``.nii.gz`` and ``.stl``, and folders
        of STL files.
    labels : Path or str
        Roles of the labels, in YAML.

    Returns
    -------
    tuple of Anatomy
        Anatomies with disjoint grids; labels are numbers of `Structure`, 0 is empty. A needle must
        respect all of them.

    Raises
    ------
    SegmentationError
        If a file is damaged, of an unknown format, or too large.
    ParameterError
        If labels are invalid, belong to no voxel, or a label has no role.
    """
    given = [segmentation] if isinstance(segmentation, (str, Path)) else segmentation
    paths = [Path(path).expanduser() for path in given]
    if not paths:
        raise ParameterError('at least one segmentation is needed')
    meaning = read_labels(labels)
    grid = meaning.grid
    layers = (
        (str(path), layer)
        for path in paths
        for layer in read_layers(path, grid.space, grid.spacing)
    )
    return anatomy_of(layers, meaning, labels)


def anatomy_of(
    layers: Iterable[tuple[str, Layer]], meaning: Labels, labels: Path | str
) -> tuple[Anatomy, ...]:
    """
    Build one anatomy for each grid of layers, as `read_anatomy`.

    Parameters
    ----------
    layers : iterable of tuple
        Name of the source of each layer for messages, and the layer.
    meaning : Labels
        Roles of the labels.
    labels : Path or str
        File of the roles, for messages.

    Returns
    -------
    tuple of Anatomy
        Anatomies with disjoint grids; SegmentationError or ParameterError as of `read_anatomy`.

    """
    grids: list[_Painted] = []
    found: Counter[int | str] = Counter()
    names: set[str] = set()
    for source, layer in layers:
        names |= set(layer.names.values())
        table, used = _numbers(source, layer, meaning)
        found.update(used)
        same = [one for one in grids if one.has_grid_of(layer)]
        if not same:
            grids.append(_Painted.empty(layer, sum(one.labels.size for one in grids)))
        (same or grids[-1:])[0].paint(layer, table)
    for key in meaning.numbers:
        if not found[key]:
            raise ParameterError(
                f'{labels}: structures: {key} is in no segmentation; there are {_listed(names)}'
                + _unquoted(key)
            )
        if isinstance(key, int) and found[key] > 1:
            raise ParameterError(
                f'{labels}: structures: {key} is in {found[key]} layers or files: use a name '
                f'instead, of {_listed(names)}'
            )
    anatomies = tuple(one.anatomy(meaning.structures) for one in grids)
    visible = {number for one in anatomies for number in one.structures}
    for number, structure in meaning.structures.items():
        if structure.role in ('target', 'entry') and number not in visible | {meaning.others}:
            raise ParameterError(
                f'{labels}: {structure.role} {structure.name} is inside of other structures: '
                'obstacles cover targets, and both cover entries'
            )
    return anatomies


def _unquoted(key: int | str) -> str:
    """Return a hint if a label is a value in quotes."""
    is_value = isinstance(key, str) and key.isdecimal()
    return f'; for the value, write {key} without quotes' * is_value


def _listed(names: Iterable[str]) -> str:
    ordered = sorted(names)
    rest = f' and {len(ordered) - _SHOWN} others' if len(ordered) > _SHOWN else ''
    return ', '.join(ordered[:_SHOWN]) + rest


def _numbers(
    source: str, layer: Layer, labels: Labels
) -> tuple[NDArray[np.uint8], list[int | str]]:
    """Return the number of the structure of each value, and the keys that are in a layer."""
    table = np.zeros(LARGEST_VALUE + 1, np.uint8)
    used: list[int | str] = []
    without, hint = [], ''
    for value, name in layer.names.items():
        keys = [key for key in (value, name) if key in labels.numbers]
        if len(keys) > 1:
            raise ParameterError(
                f'{source}: label {value} has two roles in structures, as {value} and as {name!r}'
            )
        used += keys
        table[value] = labels.numbers[keys[0]] if keys else labels.others
        if not table[value]:
            without.append(name)
            hint = hint or _unquoted(str(value)) * (str(value) in labels.numbers)
    if without:
        raise ParameterError(
            f'{source}: labels without a role: {_listed(without)}; add them to structures, or '
            f'others: {{role: tissue}} for all of them{hint}'
        )
    return table, used


@dataclass(frozen=True, slots=True, eq=False)
class _Painted:
    """Numbers of structures on a grid."""

    labels: NDArray[np.uint8]  #: shape (i, j, k)
    to_patient: FloatArray  #: shape (4, 4)
    closed: bool  #: as of `Layer`

    @classmethod
    def empty(cls, layer: Layer, others: int) -> _Painted:
        """Return a grid without structures, beside others of so many voxels."""
        if prod(layer.values.shape) + others > 2 * MOST_VOXELS:
            raise SegmentationError(
                f'the grids have more than {2 * MOST_VOXELS} voxels: crop or resample them'
            )
        return cls(np.zeros_like(layer.values, np.uint8), layer.to_patient, layer.closed)

    def has_grid_of(self, layer: Layer) -> bool:
        if self.labels.shape != layer.values.shape or self.closed != layer.closed:
            return False
        # The distance between two grids is largest at a corner.
        ends = np.array(np.meshgrid(*[(0, size - 1) for size in self.labels.shape]))
        corners = np.concatenate([ends.reshape(3, -1), np.ones((1, 8))])
        apart = (self.to_patient - layer.to_patient) @ corners
        return bool(np.abs(apart).max() < _SAME)

    def paint(self, layer: Layer, table: NDArray[np.uint8]) -> None:
        """Keep the smaller number of each voxel except 0."""
        layers = planes(self.labels), planes(layer.values, self.labels)
        for old, values in zip(*layers, strict=True):
            new = table[values]
            # One less: 0 becomes the largest number.
            old[...] = np.minimum(old - np.uint8(1), new - np.uint8(1)) + np.uint8(1)

    def anatomy(self, structures: Mapping[int, Structure]) -> Anatomy:
        here = {number: structures[number] for number in present(self.labels)}
        return Anatomy(
            labels=self.labels, to_patient=self.to_patient, structures=here, closed=self.closed
        )
