# SPDX-License-Identifier: Apache-2.0
"""
Close the loop with the simulated needle and your own control law.

A law is any object with a sample period, a delay and a method `command`. The shipped controller
is such an object, so that both run in the same loop.
"""

from needle_controller import Controller, ControllerOutput, Measurement, run_controller
from needle_dynamics import NeedleModel, NeedleParameters

#: Depth to reach [m].
TARGET = 0.05


class Spring:
    """Spring to the target with damping; the delay is in periods."""

    period, delay = 1e-3, 1

    def command(self, measured: Measurement, load: float = 0.0) -> ControllerOutput:
        """Compute the force for a measurement; `load` [N] is the force of a bent needle."""
        return ControllerOutput(
            force=2000.0 * (TARGET - measured.depth) - 20.0 * measured.velocity
        )


def main() -> None:
    """Insert from 2 cm for 5 s with both, and print their final distances from the target."""
    needle = NeedleParameters.preset('phantom')
    start = NeedleModel(needle).state_at(depth=0.02)
    shipped = Controller(needle)
    shipped.set_target(TARGET)
    for name, controller in (('shipped controller', shipped), ('own law', Spring())):
        run = run_controller(controller, needle, start, duration=5.0)
        print(f'{name}: {1e3 * (TARGET - run.depth[-1]):.3f} mm short of the target')

    # A spring does not overcome dry friction near the target.
    print(
        f'mu_s over the stiffness of the spring: {1e3 * needle.coulomb_friction / 2000.0:.3f} mm'
    )


if __name__ == '__main__':
    main()
