# SPDX-License-Identifier: Apache-2.0
"""Force command of the axial supervisor."""

from typing import NamedTuple


class ForceCommand(NamedTuple):
    """
    Force command in response to a measurement.

    Attributes
    ----------
    stamp : int
        Stamp of the measurement that it answers; the present time if it answers none [ns].
    force, torque : float
        Insertion force [N] and torque [N m].
    reference : tuple of float
        Reference of insertion depth [m] and velocity [m/s]; empty without a motion.
    error : tuple of float
        Reference minus measurement; empty without a motion.

    """

    stamp: int
    force: float = 0.0
    torque: float = 0.0
    reference: tuple[float, ...] = ()
    error: tuple[float, ...] = ()
