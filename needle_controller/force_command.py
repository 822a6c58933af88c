# SPDX-License-Identifier: Apache-2.0
"""Force command of the axial supervisor."""

from typing import NamedTuple


class ForceCommand(NamedTuple):
    """Force command in response to a measurement."""

    stamp: int  #: of the measurement that it answers, or the present time [ns]
    force: float = 0.0  #: insertion force [N]
    torque: float = 0.0  #: [N m]
    reference: tuple[float, ...] = ()  #: depth [m] and velocity [m/s]; empty without a motion
    error: tuple[float, ...] = ()  #: reference minus measurement; empty without a motion
