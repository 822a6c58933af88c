# SPDX-License-Identifier: Apache-2.0
"""Identification of each medium from recorded insertions, and its prediction of others."""

from __future__ import annotations

from collections.abc import Sequence
import time
from typing import Any, Final

from benchmarks.page import PageSection
from needle_identification import (
    identify_steering,
    ParameterEstimate,
    SteeringEstimate,
    SteeringRecording,
)

#: Standard deviation of the rotation between frames, of `SteeringPrior` [rad].
_FRAME: Final = 0.06


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
    medium, begin = recordings[0].medium, time.process_time()
    whole = identify_steering(recordings)
    took = time.process_time() - begin
    halves = [identify_steering(part) for part in (recordings[::2], recordings[1::2])]
    estimate = whole[medium]
    frames = [abs(one.value) for one in estimate.parameters if one.name.startswith('frame')]
    held_out = estimate.held_out
    return {
        'medium': medium,
        'recordings': len(recordings),
        'terms': ', '.join(whole.terms),
        'order': whole.order,
        'lambda': constant(estimate['bending_length']),
        'L0': constant(whole.free_length),
        'skin': constant(estimate['skin']),
        'optima': whole.optima,
        'rms': estimate.rms,
        'path noise': estimate.path_noise,
        'held-out rms': None if held_out is None else held_out.rms,
        'coverage': None if held_out is None else held_out.coverage,
        'lambda of halves': [constant(half[medium]['bending_length']) for half in halves],
        'overlap': overlap(halves, medium),
        'frame': max(frames, default=0.0),
        'frame without a warning': max(frames, default=0.0) > _FRAME
        and not any('frame' in warning for warning in whole.warnings),
        'time': took,
    }


_HEADS: Final = (
    'medium', 'recordings', 'drift', 'lambda [mm]', 'L0 [mm]', 'skin [mm]', 'optima', 'rms [mm]',
    'path noise [rad^2/m]', 'held-out rms [mm]', 'coverage', 'lambda of halves [mm]', 'overlap',
    'frame [rad]', 'time [s]',
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
                str(one['optima']),
                f'{1e3 * one["rms"]:.3f}',
                f'{one["path noise"]:.1e}',
                '' if one['held-out rms'] is None else f'{1e3 * one["held-out rms"]:.3f}',
                '' if one['coverage'] is None else f'{100.0 * one["coverage"]:.0f} %',
                ', '.join(_cell(half) for half in one['lambda of halves']),
                {True: 'yes', False: 'no', None: 'not determined'}[one['overlap']],
                f'{one["frame"]:.2f}',
                f'{one["time"]:.0f}',
            )
            for one in rows
        ],
        'All constants of a medium are fitted to its recordings alone. Held out: each recording '
        'is predicted from all others of its medium and from its first 15 mm. Coverage: held-out '
        'tips within their predicted 95 % interval, per axis. Halves: every second recording.',
    )


def _cell(one: dict[str, Any]) -> str:
    if one['value'] is None:
        return 'not determined'
    low, high = one['interval']
    return f'{1e3 * one["value"]:.1f} [{1e3 * low:.1f}; {1e3 * high:.1f}]'
