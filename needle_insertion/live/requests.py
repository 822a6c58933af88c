"""Services of the nodes by the word that calls them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

CONTROLLER: Final = 'controller'
STEERING: Final = 'steering'


class Request(NamedTuple):
    """
    One service of a word.

    Attributes
    ----------
    node, service : str
        Names.
    data : bool or None
        Value of the request of a `SetBool`; None for a `Trigger`.

    """

    node: str
    service: str
    data: bool | None = None


#: Services by word. A node that does not run is left out, if another node has a service.
REQUESTS: Final[Mapping[str, tuple[Request, ...]]] = {
    'pause': (Request(CONTROLLER, 'pause', data=True),),
    'resume': (Request(CONTROLLER, 'pause', data=False),),
    'retract': (Request(CONTROLLER, 'retract'),),
    'stop': (Request(STEERING, 'stop'), Request(CONTROLLER, 'emergency_stop')),
    'clear': (Request(CONTROLLER, 'clear_stop'),),
}
