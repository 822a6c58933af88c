# SPDX-License-Identifier: Apache-2.0
"""Inputs of a controller, the latched stop, and duplicate publishers."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import Enum
from typing import Final

from needle_controller.controller import ControllerSettings
from needle_controller.safety.guard import Guard
from needle_controller.safety.input_monitor import InputMonitor
from needle_controller.safety.limits import SafetyLimits
from needle_dynamics import NeedleParameters
from needle_ros.contract import BASE, ENTRY
from needle_ros.status import ControllerStatus
from needle_ros.timing import NANOSECONDS, RateCounter

_VITAL: Final = ('wrench_command', 'joint_states')  #: Topics that need exactly one publisher.
_LATE: Final = 0.5  #: Fraction of messages out of order for a warning.
_MIXED: Final = 0.9  #: Fraction of messages out of order for a stop.
_FEW: Final = 10.0  #: Least rate for both [Hz].


class FaultKind(Enum):
    """Kind of a fault: no force is commanded, or the reference waits."""

    STOP = 'stop'
    WAITING = 'no measurement yet'
    CLOCK = 'clock'
    INPUT = 'joint_states'
    PUBLISHERS = 'duplicate publishers'
    CONTROL = 'control'
    RESPONSE = 'response'


class Safety:
    """
    Conditions for a force command: valid inputs, limits, no latched stop, one publisher per topic.

    `expected` are the topics that must be published continuously, `noise` is the noise of the
    sensor values by topic, and `wrench_frame` the frame of the force sensor. With `simulated` time
    a message may arrive before the /clock of its stamp.
    """

    def __init__(
        self,
        limits: SafetyLimits,
        settings: ControllerSettings,
        parameters: NeedleParameters,
        *,
        expected: Sequence[str] = (),
        noise: Mapping[str, Sequence[float]] | None = None,
        wrench_frame: str = BASE,
        simulated: bool = False,
    ) -> None:
        self.limits = limits
        self.stop: str | None = None  #: Reason of the latched stop.
        self.stops = 0  #: Number of stops so far.
        #: Topics with duplicate publishers of commands or measurements.
        self.duplicate_publishers: str | None = None
        self.guard = Guard(limits, settings.depths(parameters))
        self.saturation = RateCounter()
        noise = noise or {}
        #: Timeout, valid frames and implausible changes of each input.
        inputs: dict[str, tuple[float, tuple[str, ...], tuple[float, ...]]] = {
            'joint_states': (settings.measurement_timeout, (), ()),
            'ground_truth': (settings.measurement_timeout, (), ()),
            'base_wrench': (
                limits.sensor_timeout,
                (wrench_frame,),
                (limits.lateral_jump, limits.moment_jump),
            ),
            'tip_deflection': (limits.sensor_timeout, (ENTRY,), (limits.tip_jump,)),
        }
        # A stamp in the future would make the stamps of the true source late.
        ahead = settings.measurement_timeout if simulated else 1.0 / settings.rate
        self.streams = {
            name: InputMonitor(
                name, timeout, frames=frames, jumps=jumps, noise=noise.get(name, ()), ahead=ahead
            )
            for name, (timeout, frames, jumps) in inputs.items()
        }
        self._expected = expected
        #: Start of encoder measurements without a gap [ns]; 0: no /clock yet.
        self._begun: int | None = None
        self._stale: set[str] = set()

    def begin(self, now: int) -> None:
        """Discard all readings, and expect new readings from a time [ns] on; a stop stays."""
        self._begun = now or None
        self._stale.clear()
        for stream in self.streams.values():
            stream.forget()
            self.guard.forget(stream.name)
        self.guard.forget('reference')

    @property
    def watch_period(self) -> float:
        """Longest time between two checks for missing inputs [s]."""
        return min(0.1, 0.5 * self.streams['joint_states'].timeout / NANOSECONDS)

    def latch(self, reason: str | None) -> bool:
        """Latch a stop for a reason, if not None; return whether the stop begins now."""
        if reason is None or self.stop is not None:
            return False
        self.stop = reason
        self.stops += 1
        # A stop discards the reference, and so the tracking error.
        self.guard.forget('reference')
        return True

    def clear(self, now: int) -> str | None:
        """Release the stop, or return why not; see `obstacle`."""
        reason = self.obstacle(now)
        if reason is None:
            self.stop = None
        return reason

    def obstacle(self, now: int) -> str | None:
        for stream in self.streams.values():
            # Readings from before the silence are outdated.
            if stream.silence(now) * NANOSECONDS > stream.timeout:
                self.guard.forget(stream.name)
        required = self.warning(now) if self.limits.sensors_required else None
        return self.guard.violated or required

    def count_publishers(self, publishers: Mapping[str, int]) -> None:
        """Set the number of publishers by topic, including this controller."""
        for name, count in publishers.items():
            if name in self.streams:
                self.streams[name].publishers = count
        vital = (
            f'{count} nodes publish {name}'
            for name, count in publishers.items()
            if count > 1 and name in _VITAL
        )
        self.duplicate_publishers = ', '.join(vital) or None

    def mixed_sources(self, now: int) -> str | None:
        """Return a fault if nearly all encoder messages are out of order (several sources)."""
        window = self.streams['joint_states'].window
        share = window.share(now)
        if share <= _MIXED or window.rate(now) < _FEW:
            return None
        return f'joint_states has {share:.0%} of its messages out of order'

    def _silent(self, now: int) -> dict[str, str]:
        """Return a line for each expected topic that is silent while the encoders are not."""
        joints = self.streams['joint_states']
        if joints.counted is None or now - joints.counted > joints.timeout:
            self._begun = now or None
            return {}
        begun = self._begun = self._begun or joints.counted
        return {
            name: f'{name} is stale: no valid message for {silence:.1f} s'
            for name in self._expected
            if (silence := (now - max(self.streams[name].counted or 0, begun)) / NANOSECONDS)
            > self.limits.sensor_timeout
        }

    def new_warnings(self, now: int) -> dict[str, str]:
        """Return a line for each expected topic that has become stale since the last call."""
        silent = self._silent(now)
        lines = {name: line for name, line in silent.items() if name not in self._stale}
        self._stale = set(silent)
        return lines

    def warning(self, now: int) -> str | None:
        """Return the expected topics that are stale or frozen, and the topics out of order."""
        frozen = (
            f'{name} has not changed for {self.limits.sensor_timeout:g} s'
            for name in self._expected
            if self.streams[name].frozen
        )
        silent = {
            name: line for name, line in self._silent(now).items() if not self.streams[name].frozen
        }
        late = (
            f'{name} has {share:.0%} of its messages out of order'
            for name, stream in self.streams.items()
            if (share := stream.window.share(now)) > _LATE and stream.window.rate(now) >= _FEW
        )
        return '; '.join((*frozen, *silent.values(), *late)) or None

    def status(self, status: ControllerStatus, now: int) -> ControllerStatus:
        return replace(
            status,
            stop=self.stop or '',
            stops=self.stops,
            duplicate_publishers=self.duplicate_publishers or '',
            command_rate=self.saturation.rate(now),
            saturated_fraction=self.saturation.share(now),
            input={name: one.status(now) for name, one in self.streams.items() if one.counts},
        )
