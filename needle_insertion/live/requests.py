# SPDX-License-Identifier: Apache-2.0
"""Services of the nodes by operator command."""

from collections.abc import Mapping
from typing import Final, NamedTuple

from needle_ros.system_state import CLEAR_STOP, PAUSE, RETRACT, STOP

CONTROLLER: Final = 'controller'
STEERING: Final = 'steering'
PLANT: Final = 'plant'


class Request(NamedTuple):
    """One service of an operator command."""

    node: str
    service: str
    data: bool | None = None  #: Request of a `SetBool`; None for a `Trigger`.


#: Service by command, and the request of a `SetBool`.
_SERVICES: Final[Mapping[str, tuple[str, bool | None]]] = {
    'pause': (PAUSE, True),
    'resume': (PAUSE, False),
    'retract': (RETRACT, None),
    'stop': (STOP, None),
    'clear': (CLEAR_STOP, None),
}

#: Services by command: of every node, since one of them may be busy or stopped. Nodes that do not
#: run are skipped, if another node offers the service.
REQUESTS: Final[Mapping[str, tuple[Request, ...]]] = {
    word: tuple(Request(node, service, data) for node in (CONTROLLER, STEERING, PLANT))
    for word, (service, data) in _SERVICES.items()
}
