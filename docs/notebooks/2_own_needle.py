# SPDX-License-Identifier: Apache-2.0
"""
Your needle: from a file to a bent shape
========================================

Describe your needle in a YAML file, insert it, and measure how its tip responds to the guide.
"""

# %%
# Write the file
# --------------
# Only constants that differ from a needle of the package are needed, in SI units or with a unit.

from pathlib import Path
from tempfile import gettempdir

from needle_dynamics import bending_length, find_needle, ParameterError, SteeredNeedle

file = Path(gettempdir(), 'mine.yaml')
file.write_text(
    """\
needle: bending_35mm
length: 150mm
free_length: 30mm
tissue_stiffness: 9000
bevel_load: [0.05]
""",
    encoding='utf-8',
)
needle, steering, source = find_needle(str(file))
length = bending_length(needle.bending_stiffness, needle.tissue_stiffness)
print(f'bending length: {1e3 * length:.1f} mm')

# %%
# A wrong name or value is reported with the valid ones.

wrong = file.with_name('wrong.yaml')
wrong.write_text('lenght: 150mm\n', encoding='utf-8')
try:
    find_needle(str(wrong))
except ParameterError as error:
    print(error)

# %%
# Insert it
# ---------
# The guide is at rest, and tilted by 0.02 rad in x. The bevel pushes the tip along z.

one = SteeredNeedle(needle, steering, tilt=(0.02, 0.0))
one.move(depth=0.1)
one.plot()
one

# %%
# Move the guide
# --------------
# The guide moves by 3 mm when the tip is 30 mm deep. ``authority`` is the motion of the tip per
# motion of the guide: its sign changes with depth.

other = SteeredNeedle(needle, steering, tilt=(0.02, 0.0))
for depth in (0.03, 0.06, 0.1):
    other.move(depth=depth)
    print(f'{1e3 * depth:.0f} mm deep: authority {other.authority[0, 0]:+.3f}')
    if depth == 0.03:
        other.move(guide=(0.003, 0.0))
other.plot()
other
