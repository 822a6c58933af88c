"""What a robot and a tracker would have seen of a steered insertion of a study."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from needle_dynamics import FloatArray, SteeredNeedle
from needle_insertion.study.protocol import Figure, Quantity, Seen
from needle_insertion.study.steering import SteeringProtocol
from needle_ros import contract
from needle_ros.timing import NANOSECONDS
import numpy as np

#: Velocity by which the depths of the looks become times [m/s].
_SPEED: Final = 0.01

#: The joints of a guide, without forces.
_STATES: Final = contract.steered_states()
_JOINTS: Final = replace(_STATES, joints=tuple(one._replace(effort='') for one in _STATES.joints))


class SeenSteering:
    """
    The protocol `SteeringProtocol`, and its messages.

    They are stamped as if the needle had gone in at 1 cm/s, one of each topic after each step.

    Parameters
    ----------
    settings : dict
        As for `SteeringProtocol`.

    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self._steering = SteeringProtocol(settings)
        self.quantities: Mapping[str, Quantity] = self._steering.quantities
        self.figures: Mapping[str, Figure] = self._steering.figures

    def run(
        self, drawn: Mapping[str, FloatArray], streams: Sequence[np.random.Generator]
    ) -> dict[str, FloatArray]:
        """
        Insert some needles.

        Parameters
        ----------
        drawn, streams
            As in `Protocol.run`.

        Returns
        -------
        dict of str to ndarray, shape (n,)
            Figures of merit.

        """
        return self._steering.run(drawn, streams)

    def replay(self, drawn: Mapping[str, float], rng: np.random.Generator) -> Iterator[Seen]:
        """
        Insert one needle again.

        Parameters
        ----------
        drawn, rng
            As in `Protocol.replay`.

        Yields
        ------
        Seen
            Joints, tip and target.

        """
        seen: list[Seen] = []
        tilt = [drawn.get(name, 0.0) for name in ('tilt_x', 'tilt_z')]
        frame = np.array([drawn.get(name, 0.0) for name in ('frame_x', 'frame_z')])
        still = [0.0] * len(_JOINTS.joints)

        def watch(one: SteeredNeedle) -> None:
            stamp = round(one.depth / _SPEED * NANOSECONDS)
            at = (one.depth, *one.guide, *tilt, one.roll)
            seen.append(Seen(_JOINTS, stamp, (*at, *still)))
            x, z = (one.tip[[0, 2]] + frame * one.depth).tolist()
            seen.append(Seen(contract.TIP_DEFLECTION, stamp, (x, one.depth, z)))

        target = self._steering.replay(drawn, rng, watch)
        yield Seen(contract.TARGET, 0, target.tolist())
        yield from seen
