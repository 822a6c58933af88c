"""All inputs of a controller, the stop that latches, and who else publishes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from needle_controller.controller import ControllerSettings
from needle_controller.safety.guard import Guard
from needle_controller.safety.limits import SafetyLimits
from needle_controller.safety.stream import Stream
from needle_dynamics import NeedleParameters
from needle_ros.contract import BASE
from needle_ros.timing import NANOSECONDS, RateCounter

#: Topics without which, and with several sources of which, there is no force.
_VITAL: Final = ('wrench_command', 'joint_states')

#: Topics whose messages come in the order of their stamps.
_MEASURED: Final = ('joint_states', 'ground_truth', 'base_wrench', 'tip_deflection')

#: Shares of messages after later ones: what is said, and what is not borne; of so many [Hz].
_LATE: Final = 0.5
_MUDDLED: Final = 0.9
_FEW: Final = 10.0


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
    wrench_frame : str
        Frame of the force sensor.

    Attributes
    ----------
    stop : str or None
        Why nothing is commanded until it is cleared.
    stops : int
        How often it was latched.
    rivals : str or None
        Why nobody knows whose command, or whose measurement, it is.
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
        wrench_frame: str = BASE,
    ) -> None:
        self.limits = limits
        self.stop: str | None = None
        self.stops = 0
        self.rivals: str | None = None
        self.guard = Guard(limits, settings.depths(parameters))
        self.saturation = RateCounter()
        noise = noise or {}
        timeout = limits.sensor_timeout
        # A stamp that is ahead would make those of the true source late.
        ahead = 1.0 / settings.rate
        self.streams = {
            stream.name: stream
            for stream in (
                Stream('joint_states', settings.measurement_timeout, ahead=ahead),
                Stream('ground_truth', settings.measurement_timeout, ahead=ahead),
                Stream(
                    'base_wrench', timeout, frames=(wrench_frame,),
                    jumps=(limits.lateral_jump, limits.moment_jump),
                    noise=noise.get('base_wrench', ()), ahead=ahead,
                ),
                Stream(
                    'tip_deflection', timeout, frames=('needle_entry',),
                    jumps=(limits.tip_jump,), noise=noise.get('tip_deflection', ()),
                    ahead=ahead,
                ),
            )
        }  # fmt: skip
        self._expected = expected
        self._back = round(settings.measurement_timeout * NANOSECONDS)
        self._seen = 0
        #: Since when the encoders have come without a gap [ns]; at 0 there is no /clock yet.
        self._begun: int | None = None
        self._stale: set[str] = set()

    def begin(self, now: int) -> None:
        """
        Forget all readings, and expect new ones from a time [ns] on; a stop stays.

        Parameters
        ----------
        now : int
            Time [ns].

        """
        self._seen, self._begun = now, now or None
        self._stale.clear()
        for stream in self.streams.values():
            stream.forget()
            self.guard.forget(stream.name)
        self.guard.forget('reference')

    def clock_went_back(self, now: int) -> float:
        """
        Return by how much the clock was set back since the last call [s], or zero.

        Parameters
        ----------
        now : int
            Time now [ns].

        Returns
        -------
        float
            Step back [s].

        """
        back, self._seen = self._seen - now, now
        return back / NANOSECONDS if back > self._back else 0.0

    def latch(self, reason: str | None) -> bool:
        """
        Stop for a reason, if there is one; return whether it begins with this.

        Parameters
        ----------
        reason : str or None
            The reason.

        Returns
        -------
        bool
            Whether the stop begins now.

        """
        if reason is None or self.stop is not None:
            return False
        self.stop = reason
        self.stops += 1
        # There is no reference any more, so the distance from it no longer counts.
        self.guard.forget('reference')
        return True

    def clear(self, now: int) -> str | None:
        """
        Release the stop, or return why not.

        Parameters
        ----------
        now : int
            Time [ns].

        Returns
        -------
        str or None
            Why the stop stays; None if it is released.

        """
        for stream in self.streams.values():
            # Readings from before the silence say nothing about the present.
            if stream.silence(now) * NANOSECONDS > stream.timeout:
                self.guard.forget(stream.name)
        required = self.warning(now) if self.limits.sensors_required else None
        reason = self.guard.violated or required
        if reason is None:
            self.stop = None
        return reason

    def count_publishers(self, publishers: Mapping[str, int]) -> None:
        """
        Take in how many nodes publish what may have one source only, this controller included.

        Parameters
        ----------
        publishers : Mapping[str, int]
            Number of nodes by topic.

        """
        for name, count in publishers.items():
            if name in self.streams:
                self.streams[name].publishers = count
        vital = (
            f'{count} nodes publish {name}'
            for name, count in publishers.items()
            if count > 1 and name in _VITAL
        )
        self.rivals = ', '.join(vital) or None

    def muddled(self, now: int) -> str | None:
        """
        Return why the encoders are not those of one robot with one clock.

        Parameters
        ----------
        now : int
            Time [ns].

        Returns
        -------
        str or None
            Which share of their messages came after later ones, if that is nearly all.

        """
        window = self.streams['joint_states'].window
        share = window.share(now)
        if share <= _MUDDLED or window.rate(now) < _FEW:
            return None
        return f'joint_states has {share:.0%} of its messages after later ones'

    def _silent(self, now: int) -> dict[str, str]:
        """Return a line for each expected topic that is silent while the encoders are not."""
        joints = self.streams['joint_states']
        if joints.counted is None or now - joints.counted > joints.timeout:
            self._begun = now or None
            return {}
        begun = self._begun = self._begun or joints.counted
        silences = {
            name: (now - max(self.streams[name].counted or 0, begun)) / NANOSECONDS
            for name in self._expected
        }
        return {
            name: f'{name} is stale: none that counts for {silence:.1f} s'
            for name, silence in silences.items()
            if silence > self.limits.sensor_timeout
        }

    def news(self, now: int) -> list[str]:
        """
        Return a line for each expected topic that has become stale since the last call.

        Parameters
        ----------
        now : int
            Time [ns].

        Returns
        -------
        list of str
            The lines.

        """
        silent = self._silent(now)
        lines = [line for name, line in silent.items() if name not in self._stale]
        self._stale = set(silent)
        return lines

    def warning(self, now: int) -> str | None:
        """
        Return which expected topics are stale or frozen, and which come out of order.

        Parameters
        ----------
        now : int
            Time [ns].

        Returns
        -------
        str or None
            The topics and since when; None if all are well.

        """
        frozen = (
            f'{name} has not changed for {self.limits.sensor_timeout:g} s'
            for name in self._expected
            if self.streams[name].frozen
        )
        silent = {
            name: line for name, line in self._silent(now).items() if not self.streams[name].frozen
        }
        late = (
            f'{name} has {share:.0%} of its messages after later ones'
            for name, stream in self.streams.items()
            if name in _MEASURED
            and (share := stream.window.share(now)) > _LATE
            and stream.window.rate(now) >= _FEW
        )
        return '; '.join((*frozen, *silent.values(), *late)) or None

    def describe(self, now: int) -> dict[str, object]:
        """
        Return what diagnostics say of inputs, stops and saturation.

        Parameters
        ----------
        now : int
            Time [ns].

        Returns
        -------
        dict
            Values by name.

        """
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
