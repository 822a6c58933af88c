# SPDX-License-Identifier: Apache-2.0
"""The newest samples of running topics as a recording."""

from collections import Counter
from math import isfinite, isnan, nan
from typing import Final

from needle_dynamics.arrays import IntArray
from needle_identification.errors import RecordingError
from needle_identification.recordings.merging import merged_recording
from needle_identification.recordings.recording import Recording
from needle_identification.recordings.samples import position_and_velocity, Samples, Series
from needle_ros.contract import BASE_WRENCH, JOINT_STATES
from needle_ros.settings import checked
from needle_ros.timing import NANOSECONDS
import numpy as np

#: Largest plausible force [N], and depth [m] or velocity [m/s].
_LARGEST: Final = {BASE_WRENCH.name: 1e4, JOINT_STATES.name: 100.0}
_JUMP: Final = NANOSECONDS  # step of a clock that was set, not of a late message [ns]
_MARGIN: Final = NANOSECONDS  # time before a motion that is kept [ns]
_WITH_RESTS: Final = 3  # largest duration with rests, as a multiple of the window
_MOVES: Final = 0.05  # smallest speed of a motion, as a fraction of the usual largest speed


class LiveRecording:
    """
    The newest samples of running topics, as a recording of their last motions.

    Invalid samples are counted in ``dropped``. A clock that is set back discards all earlier
    samples; a single stamp in the future is discarded. With receive times, a clock offset between
    the topics of up to a second is corrected as in a bag.

    Parameters
    ----------
    window : float
        Duration of the motion that is kept [s]; with rests, at most three times as long.

    Raises
    ------
    ParameterError
        If the duration is not finite and positive.

    Examples
    --------
    >>> import numpy as np
    >>> from needle_identification import identify_friction, LiveRecording
    >>> live = LiveRecording(window=10.0)
    >>> for time in np.arange(0.0, 20.0, 0.004):
    ...     velocity = 0.008 * np.sin(2.0 * time) + 0.006 * np.sin(3.1 * time)
    ...     stamp, depth = round(1e9 * time), 0.1 - 0.004 * np.cos(2.0 * time)
    ...     live.take_motion(stamp, depth, velocity)
    ...     live.take_force(stamp, 0.56 * np.sign(velocity) + 300.0 * velocity)
    >>> live.recording()
    <Recording the running topics: 2750 samples in 11 s>
    >>> print(f'{identify_friction(live.recording())["coulomb_friction"].value:.3f} N')
    0.560 N

    """

    path: Final = 'the running topics'

    def __init__(self, window: float) -> None:
        self._window = checked('window', window, 's', low=0.0, open_low=True) * NANOSECONDS
        #: Number of discarded samples by reason.
        self.dropped: Counter[str] = Counter()
        #: Discarded and repaired data of the last recording; stamps since the start.
        self.losses: list[str] = []
        self._restart()

    def _restart(self) -> None:
        #: Force, and depth, velocity and its validity; last the latency [ns].
        self._series = {BASE_WRENCH.name: Series(2), JOINT_STATES.name: Series(4)}
        #: Added samples: stamps and values.
        self._added: dict[str, tuple[list[int], list[tuple[float, ...]]]] = {
            name: ([], []) for name in self._series
        }
        #: Stamp of the newest sample of each topic [ns], and number of samples.
        self._newest: dict[str, int] = {}
        self._counts = dict.fromkeys(self._series, 0)
        self._checked = dict(self._counts)  #: Number of samples at the last check.
        #: Sample with a stamp far ahead, until the next sample of its topic.
        self._ahead: dict[str, tuple[int, tuple[float, ...]]] = {}
        self._unstamped: Counter[str] = Counter()
        self._has_depth = False

    @property
    def samples(self) -> int:
        """Number of samples since the start of the topic that has fewer of them."""
        return min(self._counts.values())

    def take_motion(
        self, stamp: int, depth: float, velocity: float = nan, received: int = 0
    ) -> None:
        """
        Add depth [m] and velocity [m/s], NaN if not measured, at a stamp [ns].

        ``received`` is the receive time [ns], 0 if unknown; it replaces a stamp of 0. Velocities
        without any depth are integrated.
        """
        known = abs(velocity) <= _LARGEST[JOINT_STATES.name]
        if isfinite(depth) and not self._has_depth:
            self._has_depth = True
            self._forget_motion()
        elif isnan(depth) and known and not self._has_depth:
            depth = 0.0
        values = depth, velocity if known else 0.0, float(known)
        self._take(JOINT_STATES.name, stamp, received, values)

    def _forget_motion(self) -> None:
        """Discard the velocities before the first depth."""
        name = JOINT_STATES.name
        if count := self._counts[name]:
            self.dropped['not finite'] += count
            self._series[name], self._added[name] = Series(4), ([], [])
            self._counts[name] = 0

    def take_force(self, stamp: int, force: float, received: int = 0) -> None:
        """
        Add the base force on the needle [N], positive into the tissue, at a stamp [ns].

        ``received`` is the receive time [ns], as of the motion.
        """
        self._take(BASE_WRENCH.name, stamp, received, (force,))

    def _take(self, name: str, stamp: int, received: int, measured: tuple[float, ...]) -> None:
        if not abs(measured[0]) <= _LARGEST[name]:
            self.dropped['implausible' if isfinite(measured[0]) else 'not finite'] += 1
            return
        if received and not stamp:
            self._unstamped[name] += 1
            stamp = received
        values = *measured, float(received - stamp) if received else 0.0
        newest, ahead = self._newest.get(name, stamp), self._ahead.pop(name, None)
        if stamp < newest - _JUMP:
            self._restart()
            self.dropped['clock set back'] += 1
            return
        if ahead is not None and stamp < ahead[0] - _JUMP:
            self.dropped['stamp in the future'] += 1
        elif ahead is not None:
            self._add(name, *ahead)
        elif stamp > newest + _JUMP:
            self._ahead[name] = stamp, values
            return
        self._add(name, stamp, values)

    def _add(self, name: str, stamp: int, values: tuple[float, ...]) -> None:
        self._newest[name] = max(self._newest.get(name, stamp), stamp)
        self._counts[name] += 1
        stamps, all_values = self._added[name]
        stamps.append(stamp)
        all_values.append(values)

    def check_current(self) -> None:
        """
        Check that both topics have new samples; to call at most once a second.

        Raises
        ------
        RecordingError
            If a topic has no new sample since the last call, or if the newest stamps of the topics
            differ by more than a second.

        """
        if not self.samples:
            return
        silent = [name for name, count in self._counts.items() if count == self._checked[name]]
        self._checked = dict(self._counts)
        (one, first), (other, second) = sorted(self._newest.items(), key=lambda item: item[1])
        if second - first > _JUMP:
            apart = (second - first) / NANOSECONDS
            raise RecordingError(
                f'{one} is {apart:.3g} s older than {other}: it is not published any more, or the '
                'clocks of the publishers differ: time receive uses one clock'
            )
        if silent:
            raise RecordingError(f'no new samples of {" and ".join(silent)}')

    def recording(self) -> Recording:
        """Return the kept samples; `RecordingError` if force and motion do not overlap in time."""
        self.losses = []
        for name, series in self._series.items():
            stamps, values = self._added[name]
            if stamps:
                series.add(np.array(stamps, dtype=np.int64), np.array(values))
                series.compact()
                self._added[name] = [], []
            if count := self._unstamped[name]:
                self.losses.append(f'{count} of {name} without a stamp, the receive time is used')
            self.losses += series.losses(name)
        self._discard()
        for name, series in self._series.items():
            if len(series.stamps) < 2:
                raise RecordingError(f'{self.path} have no samples of {name}')
        force, motion = (
            Samples(
                name, series.stamps, series.values[:, :-1], series.values[:, -1].astype(np.int64)
            )
            for name, series in self._series.items()
        )
        return merged_recording(self, force, position_and_velocity(motion, self))

    def _discard(self) -> None:
        """Discard the samples before the last motions."""
        moving = self._moving()
        if not len(moving):
            return
        steps = np.diff(moving)[::-1]
        elapsed = np.cumsum(np.where(steps <= _MARGIN, steps, 0))
        count = min(int(np.searchsorted(elapsed, self._window)) + 1, len(moving))
        oldest = max(self._newest.values()) - _WITH_RESTS * self._window
        begin = max(int(moving[-count]) - _MARGIN, oldest)
        for series in self._series.values():
            series.keep(series.stamps >= begin)

    def _moving(self) -> IntArray:
        """Return the stamps of the samples in motion [ns], and the newest one."""
        motion = self._series[JOINT_STATES.name]
        if len(motion.stamps) < 2:
            return motion.stamps
        depth, velocity, known, _ = motion.values.T
        slope = np.gradient(depth, (motion.stamps - motion.stamps[0]) / NANOSECONDS)
        speed = np.abs(np.where(known > 0.0, velocity / np.maximum(known, 1e-9), slope))
        moves = speed > _MOVES * np.quantile(speed, 0.99)
        moves[-1] = True
        return np.asarray(motion.stamps[moves])
