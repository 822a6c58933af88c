# SPDX-License-Identifier: Apache-2.0
"""
Estimate friction from NumPy arrays, without a bag.

The arrays here are synthetic: a needle that moves in and out at four velocities, with noise on
the force. Replace them by your own: time, insertion depth, velocity (or None) and force.
"""

from needle_identification import identify_friction, Recording
import numpy as np

RATE = 500.0


def strokes(rng: np.random.Generator) -> Recording:
    """Return strokes of one second at 5 to 20 mm/s with mu_s = 0.5 N and mu_v = 250 N s/m."""
    pattern = [
        0.0,
        *(sign * speed for speed in (5e-3, 1e-2, 1.5e-2, 2e-2) for sign in (1.0, -1.0)),
        0.0,
    ]
    velocity = np.repeat(pattern, int(RATE))
    # The acceleration of a real robot is finite.
    velocity = np.convolve(velocity, np.full(50, 1.0 / 50.0), mode='same')
    force = 0.5 * np.sign(velocity) + 250.0 * velocity
    return Recording(
        name='my recording',
        time=np.arange(velocity.size) / RATE,
        depth=0.1 + np.cumsum(velocity) / RATE,
        velocity=velocity,
        force=force + rng.normal(0.0, 0.01, velocity.size),
    )


def main() -> None:
    """Identify friction, and print each parameter with its interval and each warning."""
    estimate = identify_friction(strokes(np.random.default_rng(seed=1)))
    for parameter in estimate.parameters:
        low, high = parameter.interval
        print(f'{parameter.name}: {parameter.value:.4g} {parameter.unit}')
        print(f'  95 % interval {low:.4g} to {high:.4g}')
    for warning in estimate.warnings:
        print(f'warning: {warning}')


if __name__ == '__main__':
    main()
