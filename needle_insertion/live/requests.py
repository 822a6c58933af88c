"""Services of the nodes by operator command."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

CONTROLLER: Final = 'controller'
STEERING: Final = 'steering'


class Request(NamedTuple):
    """One service of an operator command."""

    node: str
    service: str
    #: Request of a `SetBool`; None for a `Trigger`.
    data: bool | None = None


#: Services by command. Nodes that do not run are skipped, if another node offers a service.
REQUESTS: Final[Mapping[str, tuple[Request, ...]]] = {
    'pause': (Request(CONTROLLER, 'pause', data=True),),
    'resume': (Request(CONTROLLER, 'pause', data=False),),
    'retract': (Request(CONTROLLER, 'retract'),),
    'stop': (Request(STEERING, 'stop'), Request(CONTROLLER, 'emergency_stop')),
    'clear': (Request(CONTROLLER, 'clear_stop'),),
}
