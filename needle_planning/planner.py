# SPDX-License-Identifier: Apache-2.0
"""Planner: entry point and guide setpoints with the largest clearance to the obstacles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite
from typing import Any, Final, TypeAlias

from needle_controller.steering.insertion_plan import guide_axes, in_layers, Plan
from needle_controller.steering.settings import SteeringLimits, step_depths
from needle_dynamics.arrays import FloatArray, floats
from needle_dynamics.needles import DEFAULT_NEEDLE, find_needle, NeedlePreset
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.parameters import longest_insertion, SteeringParameters
from needle_planning.anatomy import Anatomy
from needle_planning.certificate import free_space, simulate_insertion, SimulatedInsertion
from needle_planning.clearance import Clearance, image_frame
from needle_planning.layers import tissue_layers
from needle_planning.paths import (
    best_bow,
    bow_profile,
    Line,
    needle_radius,
    path_responses,
    SKIN_LIMIT,
    STEEPEST,
)
from needle_planning.search import disc_region, EntryRegion, Lines, search_lines, voxel_region
from needle_ros.errors import JobError, ParameterError
from needle_ros.settings import checked
import numpy as np
from numpy.typing import ArrayLike

RESOLUTION: Final = 5e-4  #: Usual resolution of the search [m].

_CANDIDATES: Final = 4  #: Lines for which the best bow is computed.
_APART: Final = 2e-3  #: Least distance of their entry points [m].
_PARTS: Final = 16  #: Parts of a line with a largest bow each.
_LENGTHS: Final = 0.02  #: Distance of the lengths for which the largest bow is computed [m].
_MORE: Final = 1.1  #: Factor of the largest bow, for the lengths and places between.
_OFF: Final = 1e-4  #: Largest distance of the tip from the target in the simulation [m].
_FAR: Final = 1.0  #: Largest plausible coordinate of a target [m].
_FINEST: Final = 1e-4  #: Least resolution [m].
#: Part of the resolution for the search; the rest is for the check of the plan.
_SEARCHED: Final = 0.9
#: Factor of the limits of slope and load in the simulation, which is linear to a few percent.
_LINEAR: Final = 1.05


#: Line, guide setpoints, depths and simulated insertion of a plan.
_Best: TypeAlias = tuple[Line, FloatArray, FloatArray, SimulatedInsertion]


class NoPathError(JobError):
    """No path has a positive clearance; `bound` limits that of the searched needles [m]."""

    def __init__(self, message: str, bound: float) -> None:
        super().__init__(message)
        self.bound = bound

    def __reduce__(self) -> tuple[Any, ...]:
        return NoPathError, (str(self), self.bound)


def find_plan(
    anatomy: Anatomy | Sequence[Anatomy],
    target: ArrayLike,
    *,
    entry: str | ArrayLike | None = None,
    entry_radius: float = 0.01,
    needle: str = DEFAULT_NEEDLE,
    limits: SteeringLimits | None = None,
    roll: float = 0.0,
    skin_limit: float = SKIN_LIMIT,
    bow: bool = True,
    resolution: float = RESOLUTION,
    progress: Callable[[str], object] | None = None,
) -> Plan:
    """
    Find the entry point and the guide setpoints with the largest clearance along the needle.

    Parameters
    ----------
    anatomy : Anatomy or sequence of Anatomy
        Image with obstacles, or several images in the same patient coordinates.
    target : array_like, shape (3,)
        Target of the tip in patient coordinates, RAS [m].
    entry : str or array_like, shape (3,), optional
        Name of the structure where the needle may enter, or an entry point; by default all
        structures with the role ``entry``.
    entry_radius : float
        Radius of the disc of entry points around an entry point [m].
    needle : str
        Needle and tissue, see `find_needle`.
    limits : SteeringLimits, optional
        Step length, and limits of guide position, guide motion and lateral load.
    roll : float
        Roll of the needle [rad].
    skin_limit : float
        Largest sideways displacement of the needle at the skin by the guide, along x and along
        z [m]; inf: no limit.
    bow : bool
        Whether the guide may bow the needle where this increases the clearance.
    resolution : float
        Resolution h of the search [m].
    progress : callable, optional
        Called with a description of each part of the search.

    Returns
    -------
    Plan
        A straight plan has the largest clearance of all straight needles, less at most h. A bowed
        plan has more than h in addition.

    Raises
    ------
    NoPathError
        No straight needle has a clearance above h; the message has the result for bowed needles.
    ParameterError
        An argument is not valid: a target outside the image or in an obstacle, an entry region
        without voxels, or a needle that is too short.

    Examples
    --------
    >>> import numpy as np
    >>> from needle_planning import Anatomy, find_plan, Structure
    >>> labels = np.zeros((60, 60, 80), dtype=np.int16)
    >>> labels[:, :, 78], labels[10:34, :, 50] = 1, 2
    >>> structures = {
    ...     1: Structure(name='skin', role='entry'),
    ...     2: Structure(name='bone', role='obstacle', margin=2e-3),
    ... }
    >>> anatomy = Anatomy(
    ...     labels=labels, to_patient=np.diag([1e-3, 1e-3, 1e-3, 1.0]), structures=structures
    ... )
    >>> plan = find_plan(anatomy, (0.03, 0.03, 0.01), bow=False)
    >>> print(plan.structure, f'{1e3 * plan.clearance:.0f} mm')
    bone 10 mm

    """
    every = [anatomy] if isinstance(anatomy, Anatomy) else list(anatomy)
    limits = limits or SteeringLimits()
    planner = _Planner(
        every, target, entry, entry_radius, needle, limits, roll, skin_limit, resolution
    )
    return planner.plan(bow, progress or (lambda _: None))


class _Planner:
    """Search for one target, with checked arguments."""

    def __init__(
        self,
        anatomies: Sequence[Anatomy],
        target: ArrayLike,
        entry: str | ArrayLike | None,
        entry_radius: float,
        needle: str,
        limits: SteeringLimits,
        roll: float,
        skin_limit: float,
        resolution: float,
    ) -> None:
        self.anatomies, self.target = anatomies, _point('target', target)
        checked('skin_limit', skin_limit, 'm', low=0.0, unlimited=True)
        self.name, self.limits, self.roll, self.skin_limit = needle, limits, roll, skin_limit
        self.resolution = checked('resolution', resolution, 'm', low=_FINEST)
        self.preset = _usable(needle)
        self.radius = needle_radius(self.preset.needle)
        self.reach = longest_insertion(self.preset.needle, self.preset.steering)
        _check_inside(anatomies, self.target)
        region = _region(anatomies, self.target, entry, entry_radius)
        lengths = np.linalg.norm(region.centers - self.target, axis=1)
        near = lengths - region.radius <= self.reach
        if not near.any():
            raise ParameterError(
                f'the needle {needle} is too short: the nearest entry point is '
                f'{1e3 * lengths.min():.1f} mm from the target, it reaches {1e3 * self.reach:.1f} '
                'mm (length without free_length)'
            )
        self.region = region._replace(centers=region.centers[near])
        self.lengths = lengths[near]
        self.clearance = Clearance(
            anatomies,
            np.vstack([self.region.centers, self.target]),
            radius=self.radius,
            beyond=region.radius + 2.0 * limits.guide_limit,
        )
        for number in self.clearance.unused:
            names = (one.name for one in anatomies[number].structures.values())
            raise ParameterError(
                f'the image with {" and ".join(names)} is away from the entry points and the '
                f'target: its corners are within {_corners(anatomies[number])} mm; check its '
                'coordinates, or leave it out'
            )
        self.at_target = at_target = float(self.clearance.at(self.target[np.newaxis])[0])
        if at_target <= 0.0:
            name = self.clearance.structure_at(self.target)
            raise ParameterError(
                f'the target is in {name} or {-1e3 * at_target:.2f} mm too near to it: its margin '
                f'and the radius of the needle, {1e3 * self.radius:.2f} mm, must be free'
            )

    def plan(self, bow: bool, progress: Callable[[str], object]) -> Plan:
        lines = self._search(progress)
        bevel = max(self.preset.steering.bevel_load) > 0.0
        if bevel and self.limits.guide_limit == 0.0:
            raise ParameterError('guide_limit must be > 0 m for a needle with a bevel')
        best = None
        if not bevel and len(lines.entries):
            best = self._straight(lines.entries[0])
        bound = lines.bound
        movable = self.limits.guide_limit > 0.0
        bows = movable and (bow or bevel)
        # Every path ends at the target: its clearance is a bound, too.
        limited = best is not None and best[3].clearance + self.resolution >= self.at_target
        if bows and limited:
            bound = self.at_target
        elif bows:
            profile = self._profile(progress)
            curved = self._search(progress, profile)
            # A needle in layers may bow more than the one of the profile.
            bound = self.at_target if self._layered else max(curved.bound, bound)
            best = self._bowed(best, self._candidates(lines, curved), profile, progress)
        if best is None:
            raise self._no_path(lines, bound, bows)
        if movable and not bows:
            # Bows are not searched, and so not excluded.
            bound = self.at_target
        line, guide, depths, found = best
        return Plan(
            needle=self.name,
            radius=self.radius,
            entry=line.entry,
            direction=line.axes[1],
            target=self.target,
            roll=self.roll,
            depths=depths,
            guide=guide,
            path=found.path,
            clearances=found.clearances,
            clearance=found.clearance,
            structure=self.clearance.structure_at(found.place),
            place=found.place,
            bow=found.bow,
            resolution=self.resolution,
            straight_bound=lines.bound,
            bound=bound,
            layers=self._layers(line),
            free=free_space(self.clearance, line, depths, found.path),
        )

    @property
    def _layered(self) -> bool:
        every = (one for anatomy in self.anatomies for one in anatomy.structures.values())
        return any(isfinite(one.stiffness) for one in every)

    def _layers(self, line: Line) -> FloatArray:
        return tissue_layers(self.anatomies, line.entry, self.target, self.preset.needle)

    def _needle(self, line: Line) -> tuple[NeedleParameters, SteeringParameters]:
        """Return the needle in the layers of tissue along a line."""
        return in_layers(self._layers(line), self.preset.needle, self.preset.steering)[:2]

    def _search(self, progress: Callable[[str], object], bow: FloatArray | None = None) -> Lines:
        kind = 'straight: ' if bow is None else 'with a bow: '
        return search_lines(
            self.clearance,
            self.region,
            self.target,
            self.reach,
            _SEARCHED * self.resolution,
            bow=np.zeros(1) if bow is None else bow,
            progress=lambda part: progress(kind + part),
        )

    def _line(self, entry: FloatArray) -> Line:
        return Line(entry, guide_axes(self.target - entry))

    def _insert(self, line: Line, guide: FloatArray) -> tuple[FloatArray, SimulatedInsertion]:
        needle, steering = self._needle(line)
        length = float(np.linalg.norm(self.target - line.entry))
        depths = np.linspace(0.0, length, len(guide) + 1)
        return depths, simulate_insertion(
            self.clearance, line, needle, steering, depths, guide, self.roll
        )

    def _straight(self, entry: FloatArray) -> _Best | None:
        line = self._line(entry)
        length = float(np.linalg.norm(self.target - entry))
        guide = np.zeros((len(step_depths(length, self.limits.step_length)) - 1, 2))
        depths, found = self._insert(line, guide)
        return (line, guide, depths, found) if found.clearance > 0.0 else None

    def _profile(self, progress: Callable[[str], object]) -> FloatArray:
        """Return the largest bow at equal fractions of a line of any length, shape (p,)."""
        needle, steering, _ = self.preset
        shortest = max(self.lengths.min() - self.region.radius, self.limits.step_length)
        longest = max(min(self.lengths.max() + self.region.radius, self.reach), shortest)
        count = max(2, int(np.ceil((longest - shortest) / _LENGTHS)) + 1)
        found = np.zeros(_PARTS + 1)
        for length in np.linspace(shortest, longest, count).tolist():
            progress(f'largest bow at {1e3 * length:.0f} mm')
            responses = path_responses(needle, steering, length, self.limits.step_length)
            profile = bow_profile(responses, self.limits, self.roll, _PARTS, self.skin_limit)
            found = np.maximum(found, profile)
        return _MORE * found

    def _candidates(self, *searches: Lines) -> list[FloatArray]:
        """Return entry points that are not close to each other, the most promising ones first."""
        found: list[FloatArray] = []
        for lines in searches:
            entries = lines.entries
            for _ in range(_CANDIDATES // len(searches)):
                if not len(entries):
                    break
                entry = entries[0]
                found.append(entry)
                away = np.linalg.norm(entries - entry, axis=1)
                entries = entries[away > _APART]
        return found

    def _bowed(
        self,
        best: _Best | None,
        entries: Sequence[FloatArray],
        profile: FloatArray,
        progress: Callable[[str], object],
    ) -> _Best | None:
        """Return the best plan with a bow, if it gains more than the resolution."""
        chosen, least = best, 0.0 if best is None else best[3].clearance + self.resolution
        for k, entry in enumerate(entries, 1):
            progress(f'best bow of line {k} of {len(entries)}')
            # Least clearance with the largest bow at each place.
            if self.clearance.lines(entry, self.target, bow=profile).least[0] <= least:
                continue
            line = self._line(entry)
            length = float(np.linalg.norm(self.target - entry))
            needle, steering = self._needle(line)
            responses = path_responses(needle, steering, length, self.limits.step_length)
            bow = best_bow(
                self.clearance, line, responses, self.limits, self.roll, self.skin_limit
            )
            if bow is None or bow.clearance <= least:
                continue
            depths, found = self._insert(line, bow.guide)
            off = float(np.linalg.norm(found.path[-1] - self.target))
            valid = off <= _OFF and found.slope <= _LINEAR * STEEPEST
            valid &= found.load <= _LINEAR * self.limits.load_limit
            valid &= found.skin <= _LINEAR * self.skin_limit
            if found.clearance > least and valid:
                chosen, least = (line, bow.guide, depths, found), found.clearance
        return chosen

    def _no_path(self, lines: Lines, bound: float, bows: bool) -> NoPathError:
        h = 1e3 * self.resolution
        entry = lines.entries[0] if len(lines.entries) else lines.nearest
        found = self.clearance.lines(entry, self.target)
        place = entry + float(found.places[0]) * (self.target - entry)
        name = self.clearance.structure_at(place)
        least, depth = 1e3 * float(found.least[0]), 1e3 * np.linalg.norm(place - entry)
        text = f'no straight path to a resolution of {h:g} mm'
        if least <= 0.0:
            text += (
                f': the best line is {-least:.2f} mm too near to {name}, at a depth of '
                f'{depth:.1f} mm'
            )
        elif max(self.preset.steering.bevel_load) > 0.0:
            text = (
                f'no path found for a needle with a bevel, a straight one has a clearance of '
                f'{least:.2f} mm'
            )
        slope = f'slopes up to {STEEPEST:g}, for which the model of the needle holds'
        if bows and bound <= self.resolution:
            text += f'; no path with a bow either, with {slope}'
        elif bows:
            text += (
                f'; no bow was found with {slope}, but it is not excluded (clearance up to '
                f'{1e3 * bound:.2f} mm)'
            )
        if lines.bound > RESOLUTION and not (lines.clearances > 0.0).any():
            text += (
                '; use a finer --resolution: a straight path with a clearance up to '
                f'{1e3 * lines.bound:.2f} mm is not excluded'
            )
        return NoPathError(text, bound)


def _point(name: str, values: ArrayLike) -> FloatArray:
    return floats(name, values, (3,))


def _usable(name: str) -> NeedlePreset:
    found = find_needle(name)
    if not found.needle.tissue_stiffness > 0.0:
        raise ParameterError(
            f'the needle {name} must be in tissue that bends it: tissue_stiffness > 0 N/m^2'
        )
    if found.steering.free_length >= found.needle.length:
        raise ParameterError(
            f'free_length must be < length = {found.needle.length:g} m, got '
            f'{found.steering.free_length:g} m'
        )
    return found


def _check_inside(anatomies: Sequence[Anatomy], target: FloatArray) -> None:
    if any(_contains(one, target) for one in anatomies):
        return
    at = ', '.join(f'{1e3 * one:.2f}' for one in target)
    corners = '; '.join(map(_corners, anatomies))
    hint = ''
    if np.abs(target).max() > _FAR and any(_contains(one, 1e-3 * target) for one in anatomies):
        hint = f'; numbers without a unit are m: {",".join(f"{one:g}mm" for one in target)}'
    raise ParameterError(
        f'the target {at} mm is outside the image, whose corners are within {corners} mm{hint}'
    )


def _contains(anatomy: Anatomy, point: FloatArray) -> bool:
    frame, shape = image_frame(anatomy), np.array(anatomy.labels.shape)
    index = frame.of_patient(point) / frame.spacing
    return bool((index >= -0.5).all() and (index <= shape - 0.5).all())


def _corners(anatomy: Anatomy) -> str:
    """Return the ranges of the corners of an image [mm]."""
    frame, shape = image_frame(anatomy), np.array(anatomy.labels.shape)
    corners = frame.to_patient((np.indices((2, 2, 2)).T * shape - 0.5) * frame.spacing)
    ends = zip(corners.min(axis=(0, 1, 2)), corners.max(axis=(0, 1, 2)), strict=True)
    return ', '.join(f'{1e3 * a:.2f} to {1e3 * b:.2f}' for a, b in ends)


def _region(
    anatomies: Sequence[Anatomy], target: FloatArray, entry: str | ArrayLike | None, radius: float
) -> EntryRegion:
    if entry is not None and not isinstance(entry, str):
        checked('entry_radius', radius, 'm', low=0.0)
        point = _point('entry', entry)
        if not np.linalg.norm(target - point) > radius:
            raise ParameterError(
                f'the entry point must be further from the target than entry_radius {radius:g} m'
            )
        return disc_region(point, float(radius), target)
    names = sorted({one.name for anatomy in anatomies for one in anatomy.structures.values()})
    if isinstance(entry, str) and entry not in names:
        raise ParameterError(f'entry must be one of {", ".join(names)}, got {entry!r}')
    every = (one for anatomy in anatomies for one in anatomy.structures.values())
    role = next((one.role for one in every if one.name == entry), '')
    if role in ('target', 'obstacle'):
        raise ParameterError(f'entry: {entry} has the role {role}: no needle enters there')
    found = []
    for anatomy in anatomies:
        labels = [
            label
            for label, one in anatomy.structures.items()
            if (one.role == 'entry' if entry is None else one.name == entry)
        ]
        region = voxel_region(anatomy, labels, target) if labels else None
        found += [] if region is None else [region]
    if len(found) > 1:
        raise ParameterError('the entry region must be in one image: name its structure')
    if found and not len(found[0].centers):
        raise ParameterError(
            'only a face of the image ends the entry region, which continues there: extend the '
            'image or the region'
        )
    if not found:
        raise ParameterError(
            f'no voxel belongs to the entry region {entry or "(role entry)"}: give an entry point'
        )
    return found[0]
