"""What a supervisor says to command, and how it answers a service."""

from __future__ import annotations

from typing import NamedTuple


class Answer(NamedTuple):
    """
    What to command now.

    Attributes
    ----------
    stamp : int
        Stamp of the measurement that it answers; the time now if it answers none [ns].
    force, torque : float
        Insertion force [N] and torque [N m].
    reference : tuple of float
        Inserted length [m] and velocity [m/s] that it aims at; empty without a motion.
    error : tuple of float
        The reference less the measurement; empty without a motion.

    """

    stamp: int
    force: float = 0.0
    torque: float = 0.0
    reference: tuple[float, ...] = ()
    error: tuple[float, ...] = ()


class Reply(NamedTuple):
    """The answer of a service, and what to command now, if anything."""

    success: bool
    message: str
    answer: Answer | None = None
