"""Identification of each medium from recorded insertions, and its prediction of others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

from benchmarks.page import PageSection
from needle_dynamics import FloatArray
from needle_identification import (
    identify_steering,
    ParameterEstimate,
    SteeringEstimate,
    SteeringRecording,
)
from needle_identification.steering.response import drift, responses
from needle_identification.steering.search import Search
import numpy as np

#: Depth of the measurements that determine the offset of a recording that is not fitted [m].
_OFFSET: Final = 0.015

#: Standard deviation of the rotation between frames, of `SteeringPrior` [rad].
_FRAME: Final = 0.06

#: Quantile of the 95 % interval of a normal distribution.
_NORMAL: Final = 1.96


class Prediction(NamedTuple):
    """Measured minus predicted tip of a recording that is not fitted, and the stated rms [m]."""

    errors: FloatArray  # (n, 2), of the depths beyond those of the offset
    rms: float

    @property
    def held(self) -> FloatArray:
        """Whether the 95 % interval of the stated rms contains the tip, shape (n, 2)."""
        return np.asarray(np.abs(self.errors) <= _NORMAL * self.rms)


def predict(
    fitted: Sequence[SteeringRecording],
    held_out: Sequence[SteeringRecording],
    terms: tuple[str, ...],
    order: str,
    near: FloatArray | None = None,
) -> list[Prediction]:
    """
    Fit recordings of a medium, and predict others, with the offset of their first depths.

    `near` is the start of the search, as of `Search.best`.
    """
    search = Search(fitted, terms, order, None)
    x, cost = search.best(near)
    free, [(length, skin)] = search.lengths(x)
    [(columns, left)] = search.design(x)
    constants = np.linalg.lstsq(columns, left)[0][: -2 * len(fitted)]
    rms = float(np.sqrt(2.0 * cost / len(left)))
    found = []
    for one in held_out:
        r = responses(one, free, length, skin, order)
        drifts = np.hstack([drift(term, one, r) for term in terms]) @ constants
        rest = one.tip - r.guide - drifts.reshape(2, -1).T
        first = one.known & (one.depth <= _OFFSET)
        offset = rest[first].mean(axis=0)
        found.append(Prediction(rest[one.known & ~first] - offset, rms))
    return found


def rms_of(predictions: Sequence[Prediction]) -> float:
    """Return the root mean square of the errors, per axis [m]."""
    return float(np.sqrt(np.mean(np.concatenate([one.errors for one in predictions]) ** 2)))


def constant(one: ParameterEstimate) -> dict[str, Any]:
    """Return value and interval of a constant for JSON, None if it is not determined."""
    if not one.determined:
        return {'value': None, 'interval': None}
    return {'value': one.value, 'interval': list(one.interval)}


def overlap(halves: Sequence[SteeringEstimate], medium: str) -> bool | None:
    """Whether the intervals of the bending length overlap; None if one is not determined."""
    one, other = (half[medium]['bending_length'] for half in halves)
    if not (one.determined and other.determined):
        return None
    return max(one.interval[0], other.interval[0]) <= min(one.interval[1], other.interval[1])


def identify_medium(recordings: Sequence[SteeringRecording]) -> dict[str, Any]:
    """Identify a medium from all recordings, from halves, and from all but one."""
    medium = recordings[0].medium
    whole = identify_steering(recordings)
    parts = recordings[::2], recordings[1::2]
    halves = [identify_steering(part) for part in parts]
    across = [
        predict(part, other, half.terms, half.order)
        for part, other, half in zip(parts, reversed(parts), halves, strict=True)
    ]
    near, _ = Search(recordings, whole.terms, whole.order, None).best()
    each = [
        predict(
            [other for other in recordings if other is not one],
            [one],
            whole.terms,
            whole.order,
            near,
        )[0]
        for one in recordings
    ]
    estimate = whole[medium]
    frames = [abs(one.value) for one in estimate.parameters if one.name.startswith('frame')]
    return {
        'medium': medium,
        'recordings': len(recordings),
        'terms': ', '.join(whole.terms),
        'order': whole.order,
        'lambda': constant(estimate['bending_length']),
        'L0': constant(whole.free_length),
        'skin': constant(estimate['skin']),
        'rms': estimate.rms,
        'held-out rms': rms_of(each),
        'held-out rms of halves': [rms_of(one) for one in across],
        'lambda of halves': [constant(half[medium]['bending_length']) for half in halves],
        'overlap': overlap(halves, medium),
        'coverage': float(np.mean(np.concatenate([one.held for one in each]))),
        'frame': max(frames, default=0.0),
        'frame without a warning': max(frames, default=0.0) > _FRAME
        and not any('frame' in warning for warning in whole.warnings),
    }


_HEADS: Final = (
    'medium', 'recordings', 'drift', 'lambda [mm]', 'L0 [mm]', 'skin [mm]', 'rms [mm]',
    'held-out rms [mm]', 'of halves [mm]', 'lambda of halves [mm]', 'overlap', 'coverage',
    'frame [rad]',
)  # fmt: skip


def section(rows: Sequence[dict[str, Any]]) -> PageSection:
    """Return the table of the media."""
    return PageSection(
        'Identification',
        _HEADS,
        [
            (
                one['medium'],
                str(one['recordings']),
                f'{one["terms"]}, {one["order"]}',
                *(_cell(one[name]) for name in ('lambda', 'L0', 'skin')),
                f'{1e3 * one["rms"]:.3f}',
                f'{1e3 * one["held-out rms"]:.3f}',
                ', '.join(f'{1e3 * rms:.3f}' for rms in one['held-out rms of halves']),
                ', '.join(_cell(half) for half in one['lambda of halves']),
                {True: 'yes', False: 'no', None: 'not determined'}[one['overlap']],
                f'{100.0 * one["coverage"]:.0f} %',
                f'{one["frame"]:.2f}',
            )
            for one in rows
        ],
        f'All constants of a medium are fitted to its recordings alone. Held out: each recording '
        'is predicted from all others of its medium, and each half (every second recording) from '
        f'the other; the offset is the mean up to {1e3 * _OFFSET:g} mm. Coverage: held-out tips '
        f'within {_NORMAL} times the stated rms, per axis.',
    )


def _cell(one: dict[str, Any]) -> str:
    if one['value'] is None:
        return 'not determined'
    low, high = one['interval']
    return f'{1e3 * one["value"]:.1f} [{1e3 * low:.1f}; {1e3 * high:.1f}]'
