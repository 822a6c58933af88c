"""
What a message must be to count, what may be measured, and what ends a motion for good.

`Stream` judges the messages of one topic by stamp, order, frame and values; `Guard` holds what
they say against `SafetyLimits`; `Safety` has one stream per topic and the stop that latches.
Times are integers in ns on the clock of the node, but for where a steady clock is named.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from typing import Final, NamedTuple

from needle_controller.controller import ControllerSettings, Measurement
from needle_dynamics import (
    NeedleParameters,
)
from needle_ros.errors import (
    ParameterError,
)
from needle_ros.settings import check_constants, constant
from needle_ros.timing import NANOSECONDS, RateCounter

#: Checks whose failures are counted but not reported: the messages do no harm.
REPEATED: Final = 'repeated'
DROPPED: Final = 'dropped'

#: Readings in a row that have to be beyond a limit: one alone may be a fault of the sensor.
_IN_A_ROW: Final = 2

#: Steps beyond noise that make a sensor a noisy one, of which identical readings are suspicious.
_LIVELY: Final = 10

#: Emergency stop by hand.
BY_HAND: Final = 'emergency stop'

#: Topics that the observer lives on.
SENSORS: Final = ('base_wrench', 'tip_deflection')


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyLimits:
    """
    Limits of what is measured; beyond them the controller stops until ``~/clear_stop``.

    The force sensor of the paper ends at 100 N and 5 N m. Friction keeps the needle of the
    presets `phantom` and `paper_mm` below 0.05 m/s at 15 N; `paper_si` has next to none.
    """

    speed: float = constant(
        0.1, 'm/s', 'largest insertion speed, in both directions', open_low=True
    )
    tracking_error: float = constant(
        0.01, 'm', 'largest distance of the needle from the reference', open_low=True
    )
    depth_tolerance: float = constant(
        2e-3, 'm', 'how far beyond lowest_depth and highest_depth the needle may be'
    )
    tip_deflection: float = constant(
        0.05, 'm', 'largest deflection of the tip, in both directions', open_low=True
    )
    axial_load: float = constant(
        30.0, 'N', 'largest axial force on the force sensor, in both directions', open_low=True
    )
    lateral_load: float = constant(
        10.0, 'N', 'largest lateral force on the force sensor, in both directions', open_low=True
    )
    moment_load: float = constant(
        1.0, 'N m', 'largest moment on the force sensor, in both directions', open_low=True
    )
    tip_jump: float = constant(
        0.02, 'm', 'change of tip_deflection from one sample to the next that is a fault of '
        'its sensor', open_low=True,
    )  # fmt: skip
    lateral_jump: float = constant(
        5.0, 'N', 'change of the lateral force from one sample to the next that is a fault of '
        'its sensor', open_low=True,
    )  # fmt: skip
    moment_jump: float = constant(
        0.5, 'N m', 'change of the moment from one sample to the next that is a fault of its '
        'sensor', open_low=True,
    )  # fmt: skip
    sensor_timeout: float = constant(
        1.0, 's', 'age at which base_wrench, tip_deflection and stamped targets no longer count; '
        'time without a reading, or without a change of a noisy one, that is reported',
        open_low=True, high=3600.0,
    )  # fmt: skip
    sensors_required: bool = field(
        default=False,
        metadata={
            'description': 'stop when base_wrench or tip_deflection, which the observer expects, '
            'are stale; else the observer goes on without them'
        },
    )

    def __post_init__(self) -> None:
        check_constants(self)
        if not isinstance(self.sensors_required, bool):
            raise ParameterError(
                f'sensors_required must be true or false, got {self.sensors_required!r}'
            )


class Refusal(NamedTuple):
    """Why a message does not count: a kind to count by, and a line for people."""

    kind: str
    line: str


class Stream:
    """
    Judges the messages of one topic.

    Parameters
    ----------
    name : str
        Topic.
    timeout : float
        Age from which a message no longer counts [s]; also how far its stamp may be ahead.
    frames : sequence of str
        Valid frames; none: any.
    stamped : bool
        False if a stamp of zero means now.
    jumps : sequence of float
        Change of each value from one message to the next that is not believed.
    noise : sequence of float
        Noise of each value: a stream that had it and is frozen is not believed. None: it may
        be as still as it likes.

    Attributes
    ----------
    last : int
        Stamp of the newest message that was in time [ns], -1 before the first.
    counted : int or None
        When the last message came that counts [ns].
    counts : Counter
        Messages by what became of them.
    frozen : bool
        Whether a noisy stream has had the same values for longer than the timeout.

    """

    def __init__(
        self,
        name: str,
        timeout: float,
        *,
        frames: Sequence[str] = (),
        stamped: bool = True,
        jumps: Sequence[float] = (),
        noise: Sequence[float] = (),
    ) -> None:
        self.name = name
        self.timeout = round(timeout * NANOSECONDS)
        self._frames = frames
        self._stamped = stamped
        self._jumps, self._noise = jumps, noise
        self.counts: Counter[str] = Counter()
        self.window = RateCounter()
        self.forget()

    def forget(self) -> None:
        """Forget what came before, but for the counts: a first message is the next one."""
        self.last = -1
        self.counted: int | None = None
        self._values: Sequence[float] | None = None
        self._lively, self._changed = 0, 0
        self.frozen = False

    def check(
        self, stamp: int, now: int, frame: str = '', values: Sequence[float] = ()
    ) -> Refusal | None:
        """
        Judge a message.

        Parameters
        ----------
        stamp, now : int
            Its stamp, and the time now [ns].
        frame : str
            Its frame.
        values : sequence of float
            Its numbers, always as many.

        Returns
        -------
        Refusal or None
            None for a message that counts.

        """
        self.window.add(now)
        refusal = self._judge(stamp, now, frame, values)
        if refusal is None:
            self.counts['taken'] += 1
            self.counted = now
        else:
            self.counts[refusal.kind] += 1
        return refusal

    def _judge(self, stamp: int, now: int, frame: str, values: Sequence[float]) -> Refusal | None:
        if self._stamped or stamp != 0:
            refusal = self._judge_stamp(stamp, now)
            if refusal is not None:
                return refusal
        if self._frames and frame not in self._frames:
            valid = ' or '.join(map(repr, self._frames))
            return Refusal('frame', f'{self.name} must be in frame {valid}, got {frame!r}')
        if not all(map(isfinite, values)):
            return Refusal('not finite', f'{self.name} must be finite, got {list(values)}')
        return self._judge_change(stamp, values)

    def _judge_stamp(self, stamp: int, now: int) -> Refusal | None:
        age = now - stamp
        if abs(age) > self.timeout:
            if stamp == 0:
                return Refusal('not stamped', f'{self.name} is stale: it is not stamped')
            when = f'{abs(age) / NANOSECONDS:.3f} s {"old" if age > 0 else "ahead"}'
            return Refusal('stale', f'{self.name} is stale: its stamp is {when}')
        if stamp == self.last:
            return Refusal(REPEATED, f'{self.name} came twice')
        if stamp < self.last:
            return Refusal(DROPPED, f'{self.name} came after a later one')
        self.last = stamp
        return None

    def _judge_change(self, stamp: int, values: Sequence[float]) -> Refusal | None:
        before, self._values = self._values, values
        if before is None or (not self._jumps and not self._noise):
            self._changed = stamp
            return None
        steps = [abs(value - old) for value, old in zip(values, before, strict=True)]
        if any(steps):
            noisy = any(step > 0.1 * one for step, one in zip(steps, self._noise, strict=False))
            self._lively = min(max(self._lively + (1 if noisy else -1), 0), _LIVELY)
            self._changed, self.frozen = stamp, False
        elif self._lively == _LIVELY and stamp - self._changed > self.timeout:
            self.frozen = True
            since = self.timeout / NANOSECONDS
            return Refusal('frozen', f'{self.name} has not changed for {since:g} s')
        for step, jump in zip(steps, self._jumps, strict=False):
            if step > jump:
                return Refusal('jump', f'{self.name} jumped by {step:.6g}, more than {jump:g}')
        return None

    def silence(self, now: int) -> float:
        """Return for how long nothing that counts has come [s]; zero before the first."""
        return (now - self.counted) / NANOSECONDS if self.counted is not None else 0.0

    def describe(self, now: int) -> str:
        """Return rate and counts in one line."""
        refused = {
            kind: count
            for kind, count in self.counts.items()
            if kind not in ('taken', REPEATED, DROPPED)
        }
        return (
            f'{self.window.rate(now):.1f} Hz; {self.counts["taken"]} taken, '
            f'{self.counts[REPEATED]} repeated, {self.counts[DROPPED]} dropped; refused: '
            f'{", ".join(f"{count} {kind}" for kind, count in refused.items()) or "none"}'
        )


class Guard:
    """
    Holds measurements against the limits; two in a row beyond one violate it.

    Parameters
    ----------
    limits : SafetyLimits
        Limits.
    depths : tuple of float
        Least and largest inserted length to control [m].

    """

    def __init__(self, limits: SafetyLimits, depths: tuple[float, float]) -> None:
        self.limits = limits
        low, high = depths
        self._depths = low - limits.depth_tolerance, high + limits.depth_tolerance
        #: What each topic is beyond, and for how many readings in a row.
        self._beyond: dict[str, tuple[str, int]] = {}

    def _hold(
        self, topic: str, readings: Iterable[tuple[str, float, float, str, str]]
    ) -> str | None:
        """Compare readings: quantity, value, limit, unit, name of the limit."""
        for quantity, value, limit, unit, name in readings:
            # Written so that what is not a number is beyond every limit.
            if not abs(value) <= limit:
                return self._count(
                    topic,
                    f'{quantity} {value:.6g} {unit} is beyond the limit of {limit:g} {unit} '
                    f'(safety.{name})',
                )
        self._beyond.pop(topic, None)
        return None

    def _count(self, topic: str, line: str) -> str | None:
        count = self._beyond.get(topic, ('', 0))[1] + 1
        self._beyond[topic] = line, count
        return line if count >= _IN_A_ROW else None

    def encoders(self, depth: float, speed: float) -> str | None:
        """Return the limit that inserted length [m] or insertion speed [m/s] violate."""
        low, high = self._depths
        if not low <= depth <= high:
            return self._count(
                'joint_states',
                f'inserted length {depth:.6g} m is outside [{low:g}, {high:g}] m '
                '(lowest_depth, highest_depth, safety.depth_tolerance)',
            )
        return self._hold(
            'joint_states', [('insertion speed', speed, self.limits.speed, 'm/s', 'speed')]
        )

    def tracking(self, error: float) -> str | None:
        """Return the limit that the distance from the reference [m] violates."""
        limit = self.limits.tracking_error
        return self._hold('reference', [('tracking error', error, limit, 'm', 'tracking_error')])

    def wrench(self, axial: float, lateral: float, moment: float) -> str | None:
        """Return the limit that forces [N] or the moment [N m] on the sensor violate."""
        return self._hold(
            'base_wrench',
            [
                ('axial force', axial, self.limits.axial_load, 'N', 'axial_load'),
                ('lateral force', lateral, self.limits.lateral_load, 'N', 'lateral_load'),
                ('moment', moment, self.limits.moment_load, 'N m', 'moment_load'),
            ],
        )

    def tip(self, deflection: float) -> str | None:
        """Return the limit that the deflection of the tip [m] violates."""
        limit = self.limits.tip_deflection
        return self._hold(
            'tip_deflection', [('tip deflection', deflection, limit, 'm', 'tip_deflection')]
        )

    def forget(self, topic: str) -> None:
        """Forget what a topic said last."""
        self._beyond.pop(topic, None)

    @property
    def violated(self) -> str | None:
        """What was last measured beyond a limit."""
        return next((line for line, _ in self._beyond.values()), None)


class Safety:
    """
    Everything that has to be well before a force may be commanded.

    Parameters
    ----------
    limits : SafetyLimits
        Limits.
    settings : ControllerSettings
        Timeout and range of depths.
    parameters : NeedleParameters
        Needle.
    expected : sequence of str
        Topics that should come all the time.
    noise : Mapping[str, Sequence[float]]
        Noise of what the sensors report, by topic.

    Attributes
    ----------
    stop : str or None
        Why nothing is commanded until it is cleared.
    stops : int
        How often it was latched.
    rivals : str or None
        Who else commands.
    streams : dict of str to Stream
        Inputs by topic.
    saturation : RateCounter
        Commands, those at their limit marked.

    """

    def __init__(
        self,
        limits: SafetyLimits,
        settings: ControllerSettings,
        parameters: NeedleParameters,
        *,
        expected: Sequence[str] = (),
        noise: Mapping[str, Sequence[float]] | None = None,
    ) -> None:
        self.limits = limits
        self.stop: str | None = None
        self.stops = 0
        self.rivals: str | None = None
        self.guard = Guard(limits, settings.depths(parameters))
        self.saturation = RateCounter()
        noise = noise or {}
        timeout, base = limits.sensor_timeout, ('', 'needle_entry')
        self.streams = {
            stream.name: stream
            for stream in (
                Stream('joint_states', settings.measurement_timeout),
                Stream('ground_truth', settings.measurement_timeout),
                Stream(
                    'base_wrench', timeout, frames=('needle_base',),
                    jumps=(limits.lateral_jump, limits.moment_jump),
                    noise=noise.get('base_wrench', ()),
                ),
                Stream(
                    'tip_deflection', timeout, frames=('needle_entry',),
                    jumps=(limits.tip_jump,), noise=noise.get('tip_deflection', ()),
                ),
                Stream('target', timeout, frames=base, stamped=False),
                Stream('joint_trajectory', timeout, frames=base, stamped=False),
            )
        }  # fmt: skip
        self._expected = expected
        self._back = round(settings.measurement_timeout * NANOSECONDS)
        self._seen = self._begun = 0
        self._told: dict[str, float] = {}
        self._stale: set[str] = set()

    def begin(self, now: int) -> None:
        """Forget all readings, and expect new ones from a time [ns] on; a stop stays."""
        self._seen = self._begun = now
        self._stale.clear()
        for stream in self.streams.values():
            stream.forget()
            self.guard.forget(stream.name)
        self.guard.forget('reference')

    def clock_went_back(self, now: int) -> float:
        """Return by how much the clock was set back since the last call [s], or zero."""
        back, self._seen = self._seen - now, now
        return back / NANOSECONDS if back > self._back else 0.0

    def latch(self, reason: str | None) -> bool:
        """Stop for a reason, if there is one; return whether it begins with this."""
        if reason is None or self.stop is not None:
            return False
        self.stop = reason
        self.stops += 1
        # There is no reference any more, so the distance from it no longer counts.
        self.guard.forget('reference')
        return True

    def clear(self, now: int) -> str | None:
        """Release the stop, or return why not."""
        for stream in self.streams.values():
            # Readings from before the silence say nothing about the present.
            if stream.silence(now) * NANOSECONDS > stream.timeout:
                self.guard.forget(stream.name)
        required = self.warning(now) if self.limits.sensors_required else None
        reason = self.guard.violated or required
        if reason is None:
            self.stop = None
        return reason

    def count_commanders(self, publishers: Mapping[str, int]) -> None:
        """Take in how many publish each topic of commands, this controller included."""
        several = [(count, topic) for topic, count in publishers.items() if count > 1]
        self.rivals = ', '.join(f'{n} nodes publish {t}' for n, t in several) or None

    def _silent(self, now: int) -> dict[str, str]:
        """Return a line for each expected topic that is silent while the encoders are not."""
        joints = self.streams['joint_states']
        if joints.counted is None or now - joints.counted > joints.timeout:
            self._begun = now
            return {}
        silences = {
            name: (now - max(self.streams[name].counted or 0, self._begun)) / NANOSECONDS
            for name in self._expected
        }
        return {
            name: f'{name} is stale: none that counts for {silence:.1f} s'
            for name, silence in silences.items()
            if silence > self.limits.sensor_timeout
        }

    def news(self, now: int) -> list[str]:
        """Return a line for each expected topic that has become stale since the last call."""
        silent = self._silent(now)
        lines = [line for name, line in silent.items() if name not in self._stale]
        self._stale = set(silent)
        return lines

    def warning(self, now: int) -> str | None:
        """Return which expected topics are stale or frozen."""
        frozen = (
            f'{name} has not changed for {self.limits.sensor_timeout:g} s'
            for name in self._expected
            if self.streams[name].frozen
        )
        silent = {
            name: line for name, line in self._silent(now).items() if not self.streams[name].frozen
        }
        return '; '.join((*frozen, *silent.values())) or None

    def due(self, kind: str, clock: float) -> bool:
        """Return whether to say something of a kind again: once a second of a steady clock [s]."""
        last = self._told.get(kind)
        if last is not None and clock - last < 1.0:
            return False
        self._told[kind] = clock
        return True

    def describe(self, now: int) -> dict[str, object]:
        """Return what diagnostics say of inputs, stops and saturation."""
        return {
            **{
                f'input {name}': stream.describe(now)
                for name, stream in self.streams.items()
                if stream.counts
            },
            'stop': self.stop or '',
            'stops latched': self.stops,
            'commands per second': f'{self.saturation.rate(now):.1f}',
            'share of commands at their limit': f'{self.saturation.share(now):.3f}',
        }


def read_encoders(
    time: float, names: Sequence[str], positions: Sequence[float], speeds: Sequence[float]
) -> Measurement:
    """
    Read a joint state; `rotation` may be missing.

    Parameters
    ----------
    time : float
        Time of the sample [s].
    names : sequence of str
        Joints.
    positions, speeds : sequence of float
        Their positions and speeds.

    Returns
    -------
    Measurement
        What it says, finite or not.

    Raises
    ------
    ParameterError
        If `insertion` is missing, or a joint has no position or speed.

    """
    try:
        i = names.index('insertion')
        depth, speed = positions[i], speeds[i]
        angle = angular_speed = 0.0
        if 'rotation' in names:
            j = names.index('rotation')
            angle, angular_speed = positions[j], speeds[j]
    except (ValueError, IndexError):
        raise ParameterError(
            f"joint_states needs position and velocity of 'insertion', got names {list(names)}, "
            f'{len(positions)} positions, {len(speeds)} velocities'
        ) from None
    return Measurement(
        time=time, depth=depth, speed=speed, angle=angle, angular_speed=angular_speed
    )
