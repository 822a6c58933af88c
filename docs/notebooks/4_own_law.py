# SPDX-License-Identifier: Apache-2.0
"""
Your control law in a closed loop
=================================

Write a law of ten lines, close the loop with the simulated needle, and compare it with the
controller of the package.
"""

# %%
# The law
# -------
# A law is any object with a sample ``period`` [s], a ``delay`` in periods, and ``command``.

from needle_controller import Controller, ControllerOutput, Measurement, run_controller
from needle_dynamics import NeedleModel, NeedleParameters

TARGET = 0.05


class Spring:
    """Spring to the target, with damping."""

    period, delay = 1e-3, 1

    def command(self, measured: Measurement, load: float = 0.0) -> ControllerOutput:
        """Return the force for a measurement."""
        force = 2000.0 * (TARGET - measured.depth) - 20.0 * measured.velocity
        return ControllerOutput(force=force)


# %%
# Close the loop
# --------------

needle = NeedleParameters.preset('phantom')
start = NeedleModel(needle).state_at(depth=0.02)
own = run_controller(Spring(), needle, start, duration=5.0)
own.plot()
own

# %%
# The shipped controller
# ----------------------

shipped = Controller(needle)
shipped.set_target(TARGET)
reference = run_controller(shipped, needle, start, duration=5.0)
reference.plot()
reference

# %%
# The difference
# --------------
# A spring does not overcome dry friction near the target: it stops where its force is mu_s.

for name, run in (('own law', own), ('shipped', reference)):
    print(f'{name}: {1e3 * (TARGET - run.depth[-1]):+.3f} mm from the target')
print(f'mu_s over the stiffness: {1e3 * needle.coulomb_friction / 2000.0:.3f} mm')

# %%
# A different needle
# ------------------
# Friction is 20 % larger than the controller assumes.

other = NeedleParameters.preset('phantom', coulomb_friction=1.2 * needle.coulomb_friction)
shipped = Controller(needle)
shipped.set_target(TARGET)
run = run_controller(shipped, other, start, duration=5.0)
print(f'{1e3 * (TARGET - run.depth[-1]):+.3f} mm from the target')
