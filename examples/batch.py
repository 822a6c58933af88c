# SPDX-License-Identifier: Apache-2.0
"""
Simulate many needles at once, on all cores.

Depth after one second of a needle with uncertain friction: mean and standard deviation over
twenty needles from Table 1 of the paper.
"""

from needle_dynamics import NeedleArray, NeedleModel, NeedleParameters, simulate_batch
import numpy as np


def main() -> None:
    """Draw 100 needles and push each with 3 N."""
    rng = np.random.default_rng(seed=1)
    mu_s, mu_v = rng.normal((0.56, 300.0), (0.0374, 44.7), size=(100, 2)).T
    base = NeedleParameters.preset('phantom')
    needles = NeedleArray(base, coulomb_friction=mu_s, viscous_friction=mu_v)
    start = NeedleModel(base).state_at(depth=0.02)

    # keep=False keeps the end of each run only.
    batch = simulate_batch(needles, start, 3.0, duration=1.0, interval=1e-2, keep=False)

    depth = 1e3 * batch.depth[:, -1]
    low, middle, high = np.percentile(depth, (2.5, 50.0, 97.5))
    print(f'{len(needles)} needles, depth after {batch.time[-1]:g} s:')
    print(f'median {middle:.1f} mm, 95 % of them between {low:.1f} and {high:.1f} mm')


if __name__ == '__main__':
    main()
