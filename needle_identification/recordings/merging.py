# SPDX-License-Identifier: Apache-2.0
"""
Force and motion on the time base of the force.

Samples are sorted by stamp. Samples at more than 800 Hz are averaged over bins of 1/400 s, stamps
and values alike, which causes no delay. The motion is interpolated to the stamps of the force.

Different clocks of force and motion are detected from the receive times, all by the clock of the
recorder: receive time minus stamp is the latency minus the clock offset. Its 5 % quantile varies
little. If the quantiles of the two topics differ by more than `LARGEST_LATENCY`, the clocks
differ, and the stamps of the force are shifted. A smaller difference may be a latency, and the
stamps stay unchanged.
"""

from typing import Final

from needle_dynamics.arrays import FloatArray, IntArray
from needle_identification.errors import RecordingError
from needle_identification.recordings.recording import Recording
from needle_identification.recordings.samples import are_covered, SampleOrigin, Samples
import numpy as np

#: Largest plausible difference of the latencies of two topics [s]. Optical trackers and imagers
#: have up to 0.2 s; unsynchronized clocks differ by more.
LARGEST_LATENCY: Final = 0.25

_NOTABLE_LATENCY: Final = 0.05  # smallest difference of latencies that is reported [s]
_CERTAINTY: Final = 3.0  # smallest clock offset, as a multiple of the variation of the latencies
_NOTABLE_DRIFT: Final = 2e-3  # smallest drift of clocks that is reported [s]
_PARTS, _FEW = 5, 20  # of the latencies, of which the first and last are compared; fewest in each


def merged_recording(
    origin: SampleOrigin, force: Samples, motion: Samples, configuration: str = ''
) -> Recording:
    """Return force, and depth with its velocity, if measured, on the time base of the force."""
    times, forces, motions, clock_offset = merge(origin, force, motion)
    return Recording(
        name=str(origin.path),
        time=times,
        depth=motions[:, 0],
        velocity=motions[:, 1] if motions.shape[1] > 1 else None,
        force=forces[:, 0],
        losses=tuple(origin.losses),
        configuration=configuration,
        clock_offset=clock_offset,
    )


def span_of(stamps: IntArray) -> str:
    """Describe the time from the first to the last stamp [ns]."""
    return f'from {stamps[0] * 1e-9:.3f} to {stamps[-1] * 1e-9:.3f} s'


def merge(
    bag: SampleOrigin, force: Samples, motion: Samples
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return time [s], force, motion at the stamps of the force, and its clock offset [s]."""
    offset, loss = clock_offset(force, motion)
    if loss:
        bag.losses.append(loss)
    stamps = force.stamps - offset
    covered = are_covered(stamps, motion.stamps)
    if np.count_nonzero(covered) < 2:
        raise RecordingError(
            f'{bag.path}: {force.topic} and {motion.topic} do not overlap in time; they last '
            f'{span_of(stamps)} and {span_of(motion.stamps)}'
        )
    if not covered.all():
        bag.losses.append(
            f'{np.count_nonzero(~covered)} of {force.topic} not covered by {motion.topic}'
        )
    start = stamps[covered][0]
    time = (stamps[covered] - start) * 1e-9
    # A float of seconds does not resolve nanoseconds far from the start.
    distinct = np.diff(time, prepend=-1.0) > 0.0
    time = time[distinct]
    motion_time = (motion.stamps - start) * 1e-9
    columns = [np.interp(time, motion_time, column) for column in motion.values.T]
    return time, force.values[covered][distinct], np.column_stack(columns), offset * 1e-9


def clock_offset(force: Samples, motion: Samples) -> tuple[int, str]:
    """Estimate the clock offset of force to motion [ns], 0 if explained by latency; and a loss."""
    quantiles = [
        np.quantile(samples.latency, (0.05, 0.5), method='lower') for samples in (force, motion)
    ]
    (force_low, force_mid), (motion_low, motion_mid) = quantiles
    offset = int(motion_low - force_low)
    variation = _CERTAINTY * (float(force_mid - force_low) + float(motion_mid - motion_low))
    drifts = _drift(force, motion)
    words = f'by the receive times {force.topic} is stamped {offset * 1e-9:.3f} s after '
    if abs(offset) > max(1e9 * LARGEST_LATENCY, variation):
        return offset, '; '.join([f'{words}{motion.topic}: clocks differ, corrected', *drifts])
    if abs(offset) > max(1e9 * _NOTABLE_LATENCY, variation):
        return 0, (
            f'{words}{motion.topic}: may be latency, not corrected; time receive would correct it'
        )
    return 0, ''.join(drifts)


def _drift(force: Samples, motion: Samples) -> list[str]:
    """Return a loss if the clock of the force runs faster or slower than that of the motion."""
    growth = variation = 0.0
    for sign, samples in ((-1.0, force), (1.0, motion)):
        first, *_, last = np.array_split(samples.latency, _PARTS)
        if len(last) < _FEW:
            return []
        low, mid = np.transpose([np.quantile(one, (0.05, 0.5)) for one in (first, last)])
        growth += sign * float(low[1] - low[0])
        variation += float((mid - low).sum())
    if abs(growth) < max(1e9 * _NOTABLE_DRIFT, _CERTAINTY * variation):
        return []
    words = f'by the receive times the clock of {force.topic} gains {1e-6 * growth:.1f} ms on that'
    return [f'{words} of {motion.topic}, not corrected; time receive would correct it']
