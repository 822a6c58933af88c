# SPDX-License-Identifier: Apache-2.0
"""
Aim a needle at a target
========================

Steer a needle in tissue that is softer than the nominal model, and compare it with a needle whose
guide is at rest.
"""

# %%
# The nominal model and the law
# -----------------------------
# The law knows the nominal needle and its uncertainty, and not the true tissue. The target is at
# x = 2 mm, z = -3 mm in a depth of 100 mm.

from dataclasses import replace

from needle_controller import MultiHypothesisLaw, SIMULATION_LIMITS, SteeringModel
from needle_dynamics import find_needle, SteeredNeedle
import numpy as np

target = np.array([2e-3, -3e-3])
depths = np.linspace(0.0, 0.1, 21)

needle, steering, _ = find_needle('bending_35mm')
model = SteeringModel(needle, steering, depths)
law = MultiHypothesisLaw(model, target, SIMULATION_LIMITS)

# %%
# The true needle
# ---------------
# Its tissue has 60 % of the nominal stiffness, and its guide is tilted by a degree or two.

softer = replace(needle, tissue_stiffness=0.6 * needle.tissue_stiffness)
tilt = (0.03, 0.02)

# %%
# Insert in steps
# ---------------
# At each depth: measure the tip with a noise of 0.04 mm, plan, move the guide.

steered = SteeredNeedle(softer, steering, tilt=tilt)
rng = np.random.default_rng(1)
guide = (0.0, 0.0)
for depth in depths:
    steered.move(guide=guide)
    steered.move(depth=float(depth))
    tip = steered.tip[[0, 2]] + 4e-5 * rng.standard_normal(2)
    law.update(tip, law.step)
    guide = law.plan()[:2]

print(f'estimated bending length: {100.0 * law.bending:.0f} % of the nominal value')


# %%
# The miss
# --------
# Crosses are the target in x and z.


def miss(one: SteeredNeedle) -> float:
    """Return the distance of the tip from the target [mm]."""
    return 1e3 * float(np.hypot(*(one.tip[[0, 2]] - target)))


deflection, *_ = steered.plot()
deflection.plot([100.0, 100.0], 1e3 * target, 'x', color='black')
deflection.set_title(f'steered: {miss(steered):.2f} mm from the target')

# %%
# The same needle with the guide at rest:

alone = SteeredNeedle(softer, steering, tilt=tilt)
alone.move(depth=0.1)
deflection, *_ = alone.plot()
deflection.plot([100.0, 100.0], 1e3 * target, 'x', color='black')
deflection.set_title(f'guide at rest: {miss(alone):.2f} mm from the target')

# %%
# Where the law expects the tip
# -----------------------------
# The 95 % half width at the end, in x and z [mm]; the last column is the true error.

expected = law.expected()
for axis, half, error in zip(
    'xz', expected.half_width, steered.tip[[0, 2]] - expected.mean, strict=True
):
    print(f'{axis}: ± {1e3 * half:.3f} mm, error {1e3 * error:+.3f} mm')
