# SPDX-License-Identifier: Apache-2.0
"""
Estimate the deflection of the needle from measurements of encoders and a slow tip sensor.

The measurements here are simulated: 1000 samples per second of depth and velocity, and 50 of the
tip, with a noise of 0.1 mm. Replace them by your own.
"""

from needle_controller import Observer, ObserverSettings
from needle_dynamics import Integrator, NeedleModel, NeedleParameters
import numpy as np

PERIOD = 1e-3


def main() -> None:
    """Observe an insertion of one second, and compare the estimate with the ground truth."""
    rng = np.random.default_rng(seed=1)
    parameters = NeedleParameters.preset('phantom')
    needle = Integrator(parameters, NeedleModel(parameters).state_at(0.1, tip_deflection=2e-3))
    observer = Observer(parameters, ObserverSettings(tip_noise=1e-4), PERIOD)
    observer.update(0, needle.depth, needle.velocity)
    for sample in range(1, 1001):
        time = sample * PERIOD
        stamp = round(1e9 * time)
        seen = needle.advance(PERIOD, force=4.0)
        # The third argument is the velocity; a fourth would be the wrench at the base.
        observer.update(stamp, needle.depth, needle.velocity)
        if sample % 20 == 0:
            observer.add_tip(stamp, seen.tip_deflection + rng.normal(0.0, 1e-4))
        if sample in (20, 100, 1000):
            estimate, deviation = observer.tip_deflection
            true = needle.model.tip_deflection(needle.state)
            print(
                f'{time:.2f} s: estimate {1e3 * estimate:.3f} mm, true {1e3 * true:.3f} mm, '
                f'standard deviation {1e3 * deviation:.3f} mm'
            )


if __name__ == '__main__':
    main()
