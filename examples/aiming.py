# SPDX-License-Identifier: Apache-2.0
"""
Steer the tip of a needle to a target, in tissue that is softer than the nominal model.

The guide moves after each tip measurement. With a fixed guide the error is several millimeters.
"""

from dataclasses import replace

from needle_controller import MultiHypothesisLaw, SIMULATION_LIMITS, SteeringModel
from needle_dynamics import NEEDLES, SteeredNeedle
import numpy as np

TARGET = np.array([2e-3, -3e-3])
DEPTHS = np.linspace(0.0, 0.1, 21)


def main() -> None:
    """Insert to 100 mm in steps of 5 mm, to x = 2 mm and z = -3 mm."""
    needle, steering, _ = NEEDLES['bending_35mm']
    model = SteeringModel(needle, steering, DEPTHS)
    controller = MultiHypothesisLaw(model, TARGET, SIMULATION_LIMITS)

    softer = replace(needle, tissue_stiffness=0.6 * needle.tissue_stiffness)
    one, alone = (SteeredNeedle(softer, steering, tilt=(0.03, 0.02)) for _ in range(2))
    noise = np.random.default_rng(1)
    guide = (0.0, 0.0)
    for depth in DEPTHS:
        one.move(guide=guide)
        one.move(depth=float(depth))
        controller.update(one.tip[[0, 2]] + 4e-5 * noise.standard_normal(2), controller.step)
        guide = controller.plan()[:2]
    alone.move(depth=0.1)

    for name, tip in (('steered', one.tip), ('open loop', alone.tip)):
        print(f'{name}: {1e3 * np.hypot(*(tip[[0, 2]] - TARGET)):.2f} mm from the target')
    print(f'estimated bending length: {100.0 * controller.bending:.0f} % of the nominal value')


if __name__ == '__main__':
    main()
