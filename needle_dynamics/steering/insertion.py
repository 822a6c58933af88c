# SPDX-License-Identifier: Apache-2.0
"""Insertion of a steered needle: dynamics along the axis, quasi-static lateral bending."""

from math import copysign, inf, isfinite
from typing import Any

from needle_dynamics.arrays import FloatArray
from needle_dynamics.compiled.axis import AxisConstants, carry_on, DEPTH, push, VELOCITY
from needle_dynamics.display import Displayed
from needle_dynamics.errors import InsertionDepthError
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.needle import Placement, SteeredNeedle
from needle_dynamics.steering.parameters import by_layer, SteeringParameters
from needle_ros.errors import ParameterError
from needle_ros.settings import checked
import numpy as np
from numpy.typing import ArrayLike

DEFAULT_AXIS_STEP = 1e-4  #: default step along the axis [s]


def axis_of(needle: NeedleParameters, steering: SteeringParameters) -> AxisConstants:
    if not needle.hub_stop:
        raise ParameterError(
            'hub_stop must be true: the hub of a steered needle stops on the guide'
        )

    def layered(name: str) -> FloatArray:
        return by_layer(name, getattr(steering, name), len(needle.tissue.starts))

    membranes = np.array(steering.membrane_depths)
    order = np.argsort(membranes)
    return AxisConstants(
        mass=needle.moving_mass,
        coulomb=needle.coulomb_friction,
        viscous=needle.viscous_friction,
        withdrawal=needle.withdrawal_friction,
        reach=needle.length - steering.free_length,
        starts=np.array(needle.tissue.starts),
        coulomb_per_length=layered('coulomb_per_length'),
        viscous_per_length=layered('viscous_per_length'),
        cutting=layered('cutting_force'),
        membranes=membranes[order],
        strengths=np.array(steering.membrane_strengths)[order],
        stiffness=np.full(len(membranes), steering.membrane_stiffness),
    )


class Insertion(Displayed):
    """
    Time simulation of a steered needle: axial dynamics and quasi-static lateral bending.

    The axial dynamics include mass, friction that may grow with insertion depth, and at the
    tip the cutting force and membranes that resist until they are punctured. The lateral motion is
    a `SteeredNeedle`: lateral mass and damping are neglected, because their transients decay
    within a few tens of milliseconds at the speeds of an insertion.

    Parameters
    ----------
    needle : NeedleParameters
        Needle and tissue; Coulomb friction, no swelling.
    steering : SteeringParameters, optional
        Additional constants of a steered needle.
    depth : float
        Initial insertion depth, straight [m]. Membranes above it are punctured.
    step : float
        Longest step along the axis [s].
    seed : int
        Seed of the path noise.

    Examples
    --------
    >>> from needle_dynamics import Insertion, NeedleParameters, SteeringParameters
    >>> one = Insertion(
    ...     NeedleParameters.preset('phantom', tissue_stiffness=2e4),
    ...     SteeringParameters(bevel_load=(0.3,), cutting_force=(1.0,)),
    ... )
    >>> force = one.carry(2.0, velocity=0.01)
    >>> print(f'{one.depth:.3f} m, {force:.2f} N')
    0.010 m, 3.06 N

    """

    def __init__(
        self,
        needle: NeedleParameters,
        steering: SteeringParameters | None = None,
        *,
        depth: float = 0.0,
        step: float = DEFAULT_AXIS_STEP,
        seed: int = 0,
    ) -> None:
        checked('step', step, 's', low=0.0, open_low=True)
        #: Lateral model of the needle.
        self.needle = SteeredNeedle(needle, steering, seed=seed)
        self.change(needle)
        self.needle.move(depth=depth)
        self.time = 0.0  #: time [s]
        self._step = float(step)
        self._state = np.array([depth, 0.0, depth])
        self._punctured = np.asarray(self.axis.membranes < depth)
        self._tissue = np.zeros(3)
        self._drift = 0.0

    def __repr__(self) -> str:
        return f'<Insertion: {self.time:.4g} s, {self.velocity:.4g} m/s, {self.needle!r}>'

    def columns(self) -> dict[str, FloatArray]:
        return self.needle.columns()

    @property
    def depth(self) -> float:
        """Depth s of the tip [m]."""
        return float(self._state.item(DEPTH) + self._tissue.item(1))

    @property
    def velocity(self) -> float:
        """Insertion velocity relative to the guide [m/s]."""
        return float(self._state.item(VELOCITY) + self._drift)

    @property
    def punctured(self) -> tuple[bool, ...]:
        """Whether each membrane is punctured, by depth."""
        return tuple(bool(one) for one in self._punctured)

    def change(self, needle: NeedleParameters) -> None:
        """Change the constants along the axis, such as friction, but not the lateral model."""
        from needle_dynamics.compiled.boxed import Boxed

        #: Constants along the axis.
        self.axis = axis_of(needle, self.needle.steering)
        self._boxed = Boxed(self.axis)

    def push(
        self,
        duration: float,
        force: float,
        *,
        speed_limit: float = inf,
        guide: ArrayLike | None = None,
        tilt: ArrayLike | None = None,
        roll: float | None = None,
        tissue: ArrayLike | None = None,
    ) -> float:
        """
        Advance for a duration [s] under a constant force; return the mean force of the base [N].

        A needle faster than the ``speed_limit`` [m/s] of the pushing device is carried at this
        speed. ``guide``, ``tilt``, ``roll`` and ``tissue`` are values at the end, as in
        `SteeredNeedle.move`; the tissue moves linearly in time, guide and roll with the depth.
        InsertionDepthError if the needle left the tissue.
        """
        placement = self._begin(duration, 'force', force, guide, tilt, roll, tissue)
        state, punctured = self._state, self._punctured
        before = state.copy(), punctured.copy()
        left = push(self._boxed, state, punctured, float(force), float(duration), self._step)
        velocity = self.velocity
        if abs(velocity) > speed_limit:
            state[:], punctured[:] = before
            velocity, mean = copysign(speed_limit, velocity), np.empty(1)
            left = carry_on(
                self._boxed, state, punctured, velocity - self._drift, float(duration),
                self._step, mean,
            )  # fmt: skip
            force = mean.item()
        self._move_needle(duration, left, placement)
        return float(force)

    def carry(
        self,
        duration: float,
        velocity: float,
        *,
        forces: FloatArray | None = None,
        guide: ArrayLike | None = None,
        tilt: ArrayLike | None = None,
        roll: float | None = None,
        tissue: ArrayLike | None = None,
    ) -> float:
        """
        Advance for a duration [s] with a linear change of the base velocity to ``velocity`` [m/s].

        Return the mean force of the base on the needle [N], without a limit, and write the mean
        over each of equal parts into ``forces``. Other arguments and errors are those of `push`;
        it is also an error if the hub reaches the guide.
        """
        placement = self._begin(duration, 'velocity', velocity, guide, tilt, roll, tissue)
        forces = np.empty(1) if forces is None else forces
        left = carry_on(
            self._boxed, self._state, self._punctured, float(velocity) - self._drift,
            float(duration), self._step, forces,
        )  # fmt: skip
        self._move_needle(duration, left, placement)
        return float(forces.mean())

    def _begin(self, duration: float, name: str, value: float, *pose: Any) -> Placement:
        """Check the arguments, and begin a linear motion of the tissue, the frame of the axis."""
        if not 0.0 < duration < inf:
            raise ParameterError(f'duration must be positive and finite, got {duration!r} s')
        if not isfinite(value):
            raise ParameterError(f'{name} must be finite, got {value!r}')
        placement = self.needle.checked(*pose)
        drift = (placement.tissue.item(1) - self._tissue.item(1)) / duration
        self._state[VELOCITY] += self._drift - drift
        self._drift = drift
        return placement

    def _move_needle(self, duration: float, left: float, placement: Placement) -> None:
        """Move the needle to the depth of the axis; an error if the axis has time left [s]."""
        self._tissue = placement.tissue
        self.time += duration - left
        depth = self.depth
        lowest = float(placement.tissue[1])
        self.needle.bring(min(max(depth, lowest), self.axis.reach), placement)
        if left > 0.0:
            limit = (
                f'{1e3 * self.axis.reach:.4g} mm, where its hub stops on the guide'
                if depth > 0.5 * self.axis.reach
                else 'the skin'
            )
            raise InsertionDepthError(f'the needle reached {limit}')

    @property
    def wrench(self) -> FloatArray:
        """Lateral wrench of the base: force x, z [N] and torque x, y, z [N m]; shape (5,)."""
        # The torque about y is the windup torque, with the stiffness of a needle that is fixed at
        # the mean position of the friction of its inserted part.
        across = self.needle
        (force_x, force_z), (moment_x, moment_z) = across.guide_load.tolist()
        shaft = across.needle.length - 0.5 * across.depth
        twist = (across.roll - across.tip_roll) * across.steering.torsional_stiffness / shaft
        # A slope in z turns about x; a slope in x turns about z in the opposite direction.
        return np.array([-force_x, -force_z, -moment_z, twist, moment_x])
