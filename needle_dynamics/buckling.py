# SPDX-License-Identifier: Apache-2.0
"""Euler buckling loads of the part of the needle outside the tissue."""

from math import inf, pi
from typing import Final, NamedTuple

from needle_dynamics.errors import InsertionDepthError
from needle_dynamics.parameters import NeedleParameters

#: First root of tan(x) = x: column clamped at one end and pinned at the other.
_PINNED: Final = 4.493409457909064


class EulerLoads(NamedTuple):
    """Euler buckling loads of the part outside the tissue, clamped at the base [N]."""

    free: float  #: free end, as before the tip has entered
    pinned: float  #: pinned at the entry point: rotation is free, lateral displacement is zero


def euler_loads(parameters: NeedleParameters, depth: float) -> EulerLoads:
    """
    Return the Euler buckling loads of the part of the needle outside the tissue.

    A needle guide shortens the part that can buckle; it is not modeled.

    Parameters
    ----------
    parameters : NeedleParameters
        The needle.
    depth : float
        Insertion depth [m].

    Returns
    -------
    EulerLoads
        Both loads [N]; infinite if the needle is fully inserted.

    Examples
    --------
    >>> from needle_dynamics import euler_loads, NeedleParameters
    >>> loads = euler_loads(NeedleParameters.preset('phantom'), 0.02)
    >>> print(f'{loads.free:.1f} N, {loads.pinned:.1f} N')
    1.9 N, 16.0 N

    """
    if not 0.0 <= depth < inf:
        raise InsertionDepthError(f'insertion depth must be finite and >= 0, got {depth!r} m')
    outside = parameters.length - depth
    if outside <= 0.0:
        return EulerLoads(inf, inf)
    stiffness = parameters.bending_stiffness / outside**2
    return EulerLoads(0.25 * pi**2 * stiffness, _PINNED**2 * stiffness)
