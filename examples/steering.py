# SPDX-License-Identifier: Apache-2.0
"""
Steer a needle with its guide, in tissue that it cuts.

The guide moves when the tip is 30 mm deep. The response of the tip depends on the depth: a shift
of the guide moves the tip in the same direction near the skin, and in the opposite direction at
larger depths.
"""

from needle_dynamics import NEEDLES, SteeredNeedle


def main() -> None:
    """Insert to 100 mm, with a shift of the guide by 2 mm at a depth of 30 mm."""
    needle, steering, source = NEEDLES['bending_35mm']
    print(f'needle and tissue: {source}')

    one = SteeredNeedle(needle, steering)
    for millimeters in (10, 30, 60, 100):
        one.move(depth=1e-3 * millimeters)
        print(f'{millimeters} mm deep, the tip shifts by {one.authority[0, 0]:+.2f} of the guide')

    other = SteeredNeedle(needle, steering)
    other.move(depth=0.03)
    other.move(guide=(0.0, 2e-3))
    other.move(depth=0.1)
    x, y, z = 1e3 * other.tip
    print(f'tip at ({x:.2f}, {y:.2f}, {z:.2f}) mm')


if __name__ == '__main__':
    main()
