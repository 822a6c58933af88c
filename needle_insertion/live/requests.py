# SPDX-License-Identifier: Apache-2.0
"""Services of the nodes by operator command."""

from collections.abc import Mapping
from typing import Final

from needle_ros.system_state import CLEAR_STOP, PAUSE, RETRACT, STOP

CONTROLLER: Final = 'controller'
STEERING: Final = 'steering'

#: Nodes with the services: each is called, since one of them may be busy or stopped. A node that
#: does not run is skipped, if another node offers the service.
NODES: Final = (CONTROLLER, STEERING, 'plant')

#: Service by command, and the request of a `SetBool`; None for a `Trigger`.
REQUESTS: Final[Mapping[str, tuple[str, bool | None]]] = {
    'pause': (PAUSE, True),
    'resume': (PAUSE, False),
    'retract': (RETRACT, None),
    'stop': (STOP, None),
    'clear': (CLEAR_STOP, None),
}

#: Commands that are not sent again without a response: another user may have paused or stopped the
#: system since.
ONCE: Final = ('resume', 'clear')
