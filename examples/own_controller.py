"""
Drive the simulated needle with a control law of your own.

A law is any function of what is measured. It is called once per sample, and its force acts until
the next one.
"""

from needle_dynamics import Integrator, NeedleModel, NeedleParameters

#: Sample period [s], and what the law aims at [m].
PERIOD = 1e-3
TARGET = 0.05


def law(depth: float, velocity: float) -> float:
    """Return the insertion force [N]: a spring to the target, and damping."""
    return 2000.0 * (TARGET - depth) - 20.0 * velocity


def main() -> None:
    """Insert from 2 cm for 4 s, and print the depth on the way."""
    parameters = NeedleParameters.preset('phantom')
    needle = Integrator(parameters, NeedleModel(parameters).state_at(depth=0.02))
    for sample in range(4001):
        if sample % 1000 == 0:
            print(f'{sample * PERIOD:.0f} s: {1e3 * needle.depth:.3f} mm')
        force = law(needle.depth, needle.speed)
        # The motor has a limit.
        needle.advance(PERIOD, max(-15.0, min(15.0, force)))

    # A spring does not overcome dry friction near the target: it stops mu_s / 2000 N/m short.
    rest = 1e3 * parameters.coulomb_friction / 2000.0
    print(f'{1e3 * (TARGET - needle.depth):.3f} mm short of the target; mu_s / k is {rest:.3f} mm')


if __name__ == '__main__':
    main()
