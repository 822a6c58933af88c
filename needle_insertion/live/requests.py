"""What nodes can be asked for, in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

CONTROLLER: Final = 'controller'
STEERING: Final = 'steering'


class Request(NamedTuple):
    """
    One service that a word stands for.

    Attributes
    ----------
    node, service : str
        Names.
    data : bool or None
        What a `SetBool` is asked to set; None for a `Trigger`.

    """

    node: str
    service: str
    data: bool | None = None


#: What can be asked for. A node that is not there is left out, if another one answers.
REQUESTS: Final[Mapping[str, tuple[Request, ...]]] = {
    'pause': (Request(CONTROLLER, 'pause', data=True),),
    'resume': (Request(CONTROLLER, 'pause', data=False),),
    'retract': (Request(CONTROLLER, 'retract'),),
    'stop': (Request(STEERING, 'stop'), Request(CONTROLLER, 'emergency_stop')),
    'clear': (Request(CONTROLLER, 'clear_stop'),),
}
