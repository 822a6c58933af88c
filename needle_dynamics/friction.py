# SPDX-License-Identifier: Apache-2.0
"""Friction between needle and tissue along the insertion axis, including equation (15)."""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Final

from needle_dynamics.compiled.friction import (
    dry_slope,
    friction_force,
    FRICTION_LAWS,
    FrictionConstants,
)
from needle_ros.errors import ParameterError
from needle_ros.settings import check_constants, choice, constant, positive
import numpy as np

#: Numbers of the friction laws for compiled functions, by name, with the laws of
#: `add_friction_law`.
LAW_NUMBERS: Final = {name: number for number, name in enumerate(FRICTION_LAWS)}

#: Compiled functions of `add_friction_law`, which must not be deleted.
_COMPILED: Final[list[object]] = []

#: Speeds at which a new law is checked [m/s].
_SPEEDS: Final = (0.0, *np.geomspace(1e-9, 1.0, 181).tolist())


def add_friction_law(name: str, law: Callable[[float, float], float]) -> None:
    """
    Compile a friction law, and add it to the valid names of ``friction_law`` in this process.

    Simulations, batches, closed loops, linearization and control laws use it like the laws of
    `Friction`. It is not available in nodes and commands, in worker processes, and for a steered
    needle.

    Parameters
    ----------
    name : str
        Name, other than those of the shipped laws; a law that was added under it is replaced.
    law : callable
        Function of Coulomb friction mu_s [N] and speed [m/s] that returns the dry friction [N]: a
        Python function that Numba can compile, or a compiled function. The value at speed 0 is the
        static friction limit. If it is zero, the law is smooth and must be continuous; otherwise
        the friction must be positive at every speed. Viscous friction and the ratio on withdrawal
        are added by the model.

    Examples
    --------
    >>> from needle_dynamics import add_friction_law, NeedleModel, NeedleParameters, simulate
    >>> def fading(coulomb, speed):
    ...     return coulomb * (1.0 + 0.5 / (1.0 + speed / 1e-3))
    >>> add_friction_law('fading', fading)
    >>> needle = NeedleParameters.preset('phantom', friction_law='fading')
    >>> run = simulate(needle, NeedleModel(needle).state_at(0.05), 3.0, duration=0.5)
    >>> bool(run.velocity[-1] > 0.0)
    True

    """
    if not name.isidentifier() or name in FRICTION_LAWS:
        raise ParameterError(
            f'name of a friction law must be an identifier other than {", ".join(FRICTION_LAWS)}, '
            f'got {name!r}'
        )
    if not callable(law):
        raise ParameterError(f'friction law {name} must be a function, got {law!r}')
    # Takes half a second to import.
    from numba import cfunc
    from numba.core.errors import NumbaError

    try:
        found = cfunc('float64(float64, float64)', error_model='numpy')(
            getattr(law, 'py_func', law)
        )
    except (NumbaError, TypeError) as error:
        lines = [line.strip() for line in str(error).splitlines()]
        reason = next((line for line in lines if line and not line.startswith('Failed in')), '')
        raise ParameterError(f'friction law {name} cannot be compiled: {reason}') from error
    rest = found.ctypes(1.0, 0.0)
    for speed in _SPEEDS:
        value = found.ctypes(1.0, speed)
        if not 0.0 <= value < inf or (rest > 0.0 and value == 0.0):
            least = '> 0' if rest > 0.0 else '>= 0'
            raise ParameterError(
                f'friction law {name} must be finite and {least}, got {value:g} N at '
                f'{speed:.3g} m/s for mu_s = 1 N'
            )
    _COMPILED.append(found)
    LAW_NUMBERS[name] = int(found.address)


@dataclass(frozen=True, slots=True, kw_only=True)
class Friction:
    """A friction law with its constants; the defaults are those in (15)."""

    #: ``coulomb``: dry friction mu_s, set-valued at rest. ``stribeck``: decreases from the
    #: break-away value at rest to mu_s, set-valued at rest. ``tanh``: smooth through zero
    #: velocity; a needle at rest creeps. Or the name of an `add_friction_law`.
    law: str = choice('coulomb', LAW_NUMBERS)
    coulomb: float = constant(0.56, 'N', 'Coulomb friction mu_s')
    viscous: float = constant(0.3, 'N s/m', 'viscous friction mu_v')
    withdrawal: float = constant(
        1.0, '1', 'ratio of friction on withdrawal to friction on insertion'
    )
    breakaway: float = constant(
        1.0, '1', 'ratio of friction at rest to Coulomb friction (law stribeck)', low=1.0
    )
    stribeck_speed: float = positive(
        1e-3, 'm/s', 'speed scale over which break-away friction decays (law stribeck)'
    )
    smoothing_speed: float = positive(
        1e-4, 'm/s', 'speed scale over which friction changes sign (law tanh)'
    )

    def __post_init__(self) -> None:
        check_constants(self)

    @property
    def constants(self) -> FrictionConstants:
        """Constants in the layout of the compiled functions."""
        names = FrictionConstants._fields[1:]
        return FrictionConstants(
            LAW_NUMBERS[self.law], *(float(getattr(self, name)) for name in names)
        )

    def force(self, velocity: float, drive: float) -> float:
        """Return the friction against insertion [N]; at rest it balances ``drive`` [N]."""
        # ``drive`` is the sum of the other forces, positive into the tissue.
        return friction_force(self.constants, float(velocity), float(drive))

    def slope(self, velocity: float, direction: float) -> float:
        """Return the slope by velocity [N s/m]; at rest, of insertion if ``direction`` > 0."""
        dry = dry_slope(self.constants, float(self.coulomb), abs(float(velocity)))
        return (1.0 if direction > 0.0 else self.withdrawal) * (self.viscous + dry)
