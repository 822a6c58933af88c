# SPDX-License-Identifier: Apache-2.0
"""Control laws of the axial controller by name, and their gains by law and axis."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, TypeAlias

from needle_controller.laws.law import Law
from needle_controller.laws.sampled import (
    Adaptive,
    AdaptiveGains,
    InverseDynamics,
    InverseDynamicsGains,
    Pid,
    PidGains,
)
from needle_ros.errors import ParameterError

AXES: Final = ('insertion', 'rotation')  #: Controlled axes.

Gains: TypeAlias = InverseDynamicsGains | AdaptiveGains | PidGains
AllGains: TypeAlias = Mapping[str, Mapping[str, Gains]]  #: Gains by law and axis.

#: Default gains by law and axis. Those of rotation by PID make a closed loop of 20 rad/s on the
#: rotary inertia of the paper's needle.
DEFAULT_GAINS: Final[AllGains] = {
    'adaptive': {'insertion': AdaptiveGains(), 'rotation': AdaptiveGains()},
    'inverse_dynamics': {'insertion': InverseDynamicsGains(), 'rotation': InverseDynamicsGains()},
    'pid': {'insertion': PidGains(), 'rotation': PidGains(kp=2.1e-7, ki=0.0, kd=2.1e-8)},
}

#: Law of each class of gains.
LAW_OF: Final[Mapping[type[Gains], type[Law]]] = {
    AdaptiveGains: Adaptive,
    InverseDynamicsGains: InverseDynamics,
    PidGains: Pid,
}

LAWS: Final = tuple(DEFAULT_GAINS)  #: Control laws by name, the default first.


def completed(gains: AllGains, defaults: AllGains = DEFAULT_GAINS) -> dict[str, dict[str, Gains]]:
    """Return gains of every law and axis; reject unknown names and gains of another law."""
    found = {law: dict(axes) for law, axes in defaults.items()}
    for law, axes in gains.items():
        for axis, chosen in axes.items():
            if law not in found or axis not in found[law]:
                raise ParameterError(
                    f'unknown gains {law}.{axis}; valid: {", ".join(LAWS)} with '
                    f'{" and ".join(AXES)}'
                )
            kind = type(found[law][axis])
            if not isinstance(chosen, kind):
                raise ParameterError(f'{law}.{axis} must be {kind.__name__}, got {chosen!r}')
            found[law][axis] = chosen
    return found
