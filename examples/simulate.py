# SPDX-License-Identifier: Apache-2.0
"""
Simulate the insertion of a needle into tissue with a constant force.

The preset `phantom` has the constants of the paper with damping added. Units are SI: m, N, s.
"""

from needle_dynamics import NeedleModel, NeedleParameters, simulate


def main() -> None:
    """Push with 3 N for one second, from 2 cm inside with the tip deflected by 0.5 mm."""
    parameters = NeedleParameters.preset('phantom')
    start = NeedleModel(parameters).state_at(depth=0.02, tip_deflection=5e-4)
    run = simulate(parameters, start, 3.0, duration=1.0, interval=1e-3)

    print(f'depth at the end: {1e3 * run.depth[-1]:.2f} mm')
    print(f'largest tip deflection: {1e3 * abs(run.tip_deflection).max():.3f} mm')

    # A run can be evaluated at any time, not only at its samples.
    state = run.at(0.12345)
    print(f'depth at 0.12345 s: {1e3 * (parameters.length - state[0]):.3f} mm')


if __name__ == '__main__':
    main()
