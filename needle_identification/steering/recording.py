# SPDX-License-Identifier: Apache-2.0
"""Recording of a steered insertion, and its simulated response to guide, tilt and bevel."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from math import ceil
from pathlib import Path
from typing import Final, NamedTuple

from needle_dynamics.arrays import BoolArray, FloatArray
from needle_dynamics.compiled.cut import insert, NO_FORCES
from needle_dynamics.display import Displayed
from needle_dynamics.steering.needle import empty_cut
from needle_identification.errors import RecordingError
from needle_identification.recordings.recording import freeze
from needle_identification.sensor.checks import zero_rows
from needle_ros.errors import ShapeError
from needle_ros.quantities import DEVIATION_OVER_MEDIAN
import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

DEEPEST: Final = 1.0  #: largest depth [m]

_FROZEN: Final = 3  # number of equal consecutive tip measurements that indicate a frozen sensor
_GONE: Final = 5e-4  # change of depth over these, above the noise of robots [m]
_REST: Final = 1e-5  # largest motion between rows at rest [m]
_LEVER: Final = 0.01  # motion for a roll of 1 rad [m]
_MOST: Final = 100  # readings of a recording: one per millimeter of a path of 100 mm
_JUMP: Final = 0.01  # smallest guide position after rows of zeros that is no motion [m]
_AT_THE_SKIN: Final = 0.03  # largest first depth that is measured from the skin [m]
JITTER: Final = 1e-3  #: Largest motion of a robot at rest [m].
_ASIDE: Final = 0.03  # lateral tip position beyond the guide and half the depth [m]
_FAR: Final = 10.0  # deviation of a single tip position from the rows around [robust deviations]
_APART: Final = 3e-3  # its least deviation, without the motion of the guide there [m]
_AROUND: Final = 5  # rows of this motion
_NAMED: Final = 5  # most depths in a message

ORDERS: Final = ('together', 'guide first')  #: order of guide motion and insertion between samples

#: Drift terms and their constants.
TERMS: Final = {
    'tilt': ('tilt_x', 'tilt_z'),
    'frame': ('frame_x', 'frame_z', 'frame_y'),
    'bevel': ('curvature_z', 'curvature_x'),
}

#: Prior standard deviation of the constants of each term [rad or 1/m], for tilt and frame as in
#: the steering controller; its bevel load of 0.3 N is 0.4 1/m for a bending length of 35 mm.
DEVIATIONS: Final = {'tilt': 0.04, 'frame': 0.06, 'bevel': 0.5}

#: Longest element [m]: accurate to a micrometer, and equal for all bending lengths, so that the
#: responses are smooth functions of them.
_ELEMENT: Final = 1.5e-3

_CAUSES: Final = np.arange(3)


class NominalLayers(NamedTuple):
    """Depth at which each layer of tissue begins, and its nominal bending length [m]."""

    starts: tuple[float, ...]
    lengths: tuple[float, ...]


UNIFORM: Final = NominalLayers((0.0,), (1.0,))  #: the bending length is unknown
_NO_WANDER: Final = np.zeros((1, 0, 2))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class SteeringRecording(Displayed):
    """Recorded insertion: depth, guide, roll and tip position."""

    name: str = 'recording'  #: for messages
    medium: str = ''  #: name of the tissue; recordings in one tissue share its constants
    depth: FloatArray  #: (n,) below the skin [m]; straight up to the first depth
    guide: FloatArray  #: (n, 2) position of the guide in x and z [m], with any origin
    roll: FloatArray  #: (n,) roll of the base, right-handed about y [rad]
    tip: FloatArray  #: (n, 2) position of the tip in x and z [m], any origin; NaN if missing
    losses: tuple[str, ...] = ()  #: discarded and corrected data

    def __post_init__(self) -> None:
        freeze(self, 'depth', 'tip', guide=2, roll=None, tip=2)
        if (self.depth < 0.0).any():
            raise ShapeError(f'{self.name}: depth must be >= 0, got {self.depth.min():.4g} m')

    def __repr__(self) -> str:
        deepest = 1e3 * self.depth.max(initial=0.0)
        return f'<SteeringRecording {self.name}: {self.samples} samples to {deepest:.4g} mm>'

    def columns(self) -> dict[str, FloatArray]:
        (guide_x, guide_z), (tip_x, tip_z) = self.guide.T, self.tip.T
        return {
            'depth [m]': self.depth,
            'guide_x [m]': guide_x,
            'guide_z [m]': guide_z,
            'roll [rad]': self.roll,
            'tip_x [m]': tip_x,
            'tip_z [m]': tip_z,
        }

    @property
    def digest(self) -> bytes:
        """SHA-256 of motion and tip, to detect copies of a recording."""
        parts = (self.depth, self.guide, self.roll, self.tip)
        return sha256(b''.join(part.tobytes() for part in parts)).digest()

    @property
    def known(self) -> BoolArray:
        """Whether a tip position is present, shape (n,)."""
        return np.asarray(np.isfinite(self.tip).all(axis=1))

    @property
    def samples(self) -> int:
        return int(np.count_nonzero(self.known))


def readings(recording: SteeringRecording) -> SteeringRecording:
    """
    Average successive rows at rest, and as many other rows as needed for at most 100.

    Of a rest, the second half counts for the tip: tissue and filters settle.
    """
    moved = np.column_stack([recording.depth, recording.guide, _LEVER * recording.roll])
    starts = [0]
    for k, row in enumerate(moved):
        if np.abs(row - moved[starts[-1]]).max() > _REST:
            starts.append(k)
    rests = np.diff([*starts, len(moved)])
    place = np.arange(len(moved)) - np.repeat(starts, rests)
    late = recording.known & (place >= np.repeat(rests // 2, rests))
    starts = starts[:: ceil(len(starts) / _MOST)]
    rows = np.diff([*starts, len(moved)])
    group = np.repeat(np.arange(len(starts)), rows)
    # Without a late reading, all readings of the rest.
    used = late | (recording.known & ~np.isin(group, group[late]))
    count = np.bincount(group[used], minlength=len(starts))[:, np.newaxis]
    sums = np.add.reduceat(np.where(used[:, np.newaxis], recording.tip, 0.0), starts)
    tip = np.divide(sums, count, out=np.full_like(sums, np.nan), where=count > 0)
    means = np.add.reduceat(moved, starts) / rows[:, np.newaxis]
    return replace(
        recording, depth=means[:, 0], guide=means[:, 1:3], roll=means[:, 3] / _LEVER, tip=tip
    )


def credible(depth: FloatArray, guide: FloatArray, tip: FloatArray) -> tuple[BoolArray, list[str]]:
    """Return which tip samples (n,) are neither frozen nor implausible, and messages."""
    # Guide and tip (n, 2) are x and z [m] relative to their start, NaN if missing.
    there = np.isfinite(tip).all(axis=1)
    same = np.zeros(len(depth), dtype=np.bool_)
    same[1:] = (tip[1:] == tip[:-1]).all(axis=1)
    frozen = np.zeros(len(depth), dtype=np.bool_)
    # Runs of equal values; the first value of a run is valid.
    starts = np.flatnonzero(~same)
    for begin, end in zip(starts, [*starts[1:], len(depth)], strict=True):
        if end - begin >= _FROZEN and np.ptp(depth[begin:end]) > _GONE:
            frozen[begin + 1 : end] = True
    far = np.abs(guide).max(initial=0.0) + 0.5 * depth + _ASIDE
    wild = there & ~frozen & (np.abs(np.nan_to_num(tip)) > far[:, np.newaxis]).any(axis=1)
    good = there & ~frozen & ~wild
    single = np.zeros_like(good)
    single[good] = _single(depth[good], guide[good], tip[good])
    depths = [f'{1e3 * one:.4g}' for one in depth[single]]
    named = ', '.join(depths[:_NAMED]) + ', ...' * (len(depths) > _NAMED)
    losses = [
        f'{count} samples of the tip {why}, left out'
        for count, why in (
            (np.count_nonzero(frozen), 'repeated during the insertion (frozen sensor)'),
            (np.count_nonzero(wild), 'at implausible positions'),
            (np.count_nonzero(single), f'far from the rows around, at depths [mm] of {named}'),
            (np.count_nonzero(~there), 'that are not numbers'),
        )
        if count
    ]
    return good & ~single, losses


def _single(depth: FloatArray, guide: FloatArray, tip: FloatArray) -> BoolArray:
    """Return which tip positions are far from the rows before and after, which are alike."""
    single = np.zeros(len(depth), dtype=np.bool_)
    if len(depth) < _AROUND:
        return single
    steps = np.abs(np.diff(depth))
    way = steps[:-1] + steps[1:]
    part = np.divide(steps[:-1], way, out=np.full_like(way, 0.5), where=way > 0.0)[:, np.newaxis]
    between = tip[2:] - tip[:-2]
    off = np.hypot(*(tip[1:-1] - tip[:-2] - part * between).T)
    moved = maximum_filter1d(guide, _AROUND, axis=0) - minimum_filter1d(guide, _AROUND, axis=0)
    # The tip follows the guide, late or in part, in all but a quarter of the rows.
    least = max(_APART, _FAR * DEVIATION_OVER_MEDIAN * float(np.quantile(off, 0.25)))
    beyond = off - np.hypot(*moved[1:-1].T) > least
    # If the tip moves on, the rows before and after are farther apart.
    single[1:-1] = beyond & (off > np.hypot(*between.T))
    return single


def _unset(values: Mapping[str, FloatArray]) -> int:
    """Return the number of first rows of zeros before a jump of the guide."""
    moved = np.column_stack([values[role] for role in ('depth', 'guide_x', 'guide_z')])
    (there,) = np.nonzero((moved != 0.0).any(axis=1))
    jumps = len(there) and np.abs(moved[there[0], 1:]).max() > _JUMP
    return int(there[0]) if jumps else 0


def recorded_insertion(
    path: Path, medium: str, values: Mapping[str, FloatArray], losses: Sequence[str], advice: str
) -> SteeringRecording:
    """Create a recording from values of a file by role, (n,) each, without implausible samples."""
    losses, zeros = list(losses), _unset(values)
    if zeros:
        losses.append(f'{zeros} rows of zeros before the first position of the guide, left out')
        values = {role: column[zeros:] for role, column in values.items()}
    depth = values['depth']
    if not 0.0 <= depth[0] <= _AT_THE_SKIN or depth.min() < 0.0:
        losses.append(f'depths relative to the first depth, {1e3 * depth[0]:.4g} mm, at the skin')
        depth = depth - depth[0]
    elif depth[0] > JITTER:
        losses.append(
            f'the first depth is {1e3 * depth[0]:.4g} mm: the needle counts as straight to it; if '
            'the tip was at the skin there, subtract it from the depth'
        )
    outside = np.flatnonzero(depth[: np.argmax(depth)] < -JITTER)
    if len(outside) and depth.min() >= -_AT_THE_SKIN:
        first = int(outside[-1]) + 1
        losses.append(f'{first} rows before the needle enters the skin, left out')
        values = {role: column[first:] for role, column in values.items()}
        depth = depth[first:]
    if depth.min() < -JITTER:
        raise RecordingError(
            f'{path}: depth goes from the first row to {1e3 * depth.min():.4g} mm, out of the '
            f'skin: if it is positive out of the tissue, use --columns depth=-NAME'
        )
    if depth.max() > DEEPEST:
        raise RecordingError(
            f'{path}: depth goes to {depth.max():.4g} m, a needle to at most {DEEPEST:g} m: '
            f'{advice}'
        )
    guide = np.column_stack([values['guide_x'], values['guide_z']])
    tip = np.column_stack([values['tip_x'], values['tip_z']])
    measured = ~zero_rows(tip)
    if zeros := int(np.count_nonzero(~measured)):
        losses.append(f'{zeros} samples of the tip are zero: not measured, left out')
    known = tip[measured & np.isfinite(tip).all(axis=1)]
    if not len(known):
        raise RecordingError(f'{path}: no row has a position of the tip')
    if len(known) > 1 and not np.ptp(known, axis=0).any() and np.ptp(depth) > _GONE:
        raise RecordingError(
            f'{path}: the tip never moves: all {len(known)} positions are equal while the needle '
            f'moves by {1e3 * np.ptp(depth):.3g} mm: check its sensor, topic or columns'
        )
    good = np.zeros_like(measured)
    good[measured], wrong = credible(
        depth[measured], (guide - guide[0])[measured], tip[measured] - known[0]
    )
    tip[~good] = np.nan
    return SteeringRecording(
        name=str(path),
        medium=medium,
        depth=np.maximum(depth, 0.0),
        guide=guide,
        roll=values.get('roll', np.zeros(len(depth))),
        tip=tip,
        losses=(*losses, *wrong),
    )


class TipResponses(NamedTuple):
    """Tip motion at the samples by cause."""

    guide: FloatArray  # (n, 2) x and z, by the motion of the guide [m]
    tilt: FloatArray  # (n,) per tilt of the guide, in its plane [m]
    bevel: FloatArray  # (n, 2) x and z, per curvature of a long needle by the bevel [m^2]


class SimulatedCauses:
    """A recorded insertion for each cause, in one order; the lengths are given later."""

    def __init__(self, recording: SteeringRecording, order: str, starts: Sequence[float]) -> None:
        self._starts = starts
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

    def responses(self, free: float, length: float, skin: float, *deeper: float) -> TipResponses:
        """Simulate the insertion for lengths in m by layer, and skin over tissue stiffness."""
        # The response depends only on lengths: unit bending stiffness.
        reach, element, tissue = self._deepest + free, self._element, 4.0 / length**4
        constants = np.array([[1.0, element, skin * tissue, 0.0, 0.0, reach, free]])
        layers = np.zeros((3, 3, len(self._starts)))
        layers[:, 0] = self._starts
        layers[:, 1] = [tissue, *(4.0 / one**4 for one in deeper)]
        layers[2, 2] = 1.0 / length
        tips = np.empty((3, self._poses.shape[1], 2))
        cut = empty_cut(reach, element, len(self._starts))
        insert(constants, layers, 1.0, _NO_WANDER, self._poses, _CAUSES, cut, tips, NO_FORCES)
        guide, tilt, bevel = tips[:, :: self._every]
        return TipResponses(guide=guide, tilt=tilt[:, 1], bevel=bevel)


def drift(terms: Sequence[str], recording: SteeringRecording, r: TipResponses) -> FloatArray:
    """Return the tip motion in x and z per unit of each constant of the terms, (2, n, c)."""
    zero, depth = np.zeros(len(r.tilt)), recording.depth
    (guide_x, guide_z), (bevel_x, bevel_z) = r.guide.T, r.bevel.T
    pairs = {
        'tilt': [(r.tilt, zero), (zero, r.tilt)],
        # Rotations about z and x appear as a drift with depth; a rotation about y mixes x and z.
        'frame': [(depth, zero), (zero, depth), (guide_z, -guide_x)],
        # Load along z at zero roll, and rotated by a quarter turn.
        'bevel': [(bevel_x, bevel_z), (bevel_z, -bevel_x)],
    }
    return np.array([pair for term in terms for pair in pairs[term]]).transpose(1, 2, 0)
