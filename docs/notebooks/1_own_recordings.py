# SPDX-License-Identifier: Apache-2.0
"""
From your recording to friction
===============================

Read a table of force and motion with your own column names and units, and estimate the friction of
the needle, with a confidence interval.
"""

# %%
# A recording as your rig may write it
# ------------------------------------
# This cell writes a table from a recording of the clone: time in ms, position of a stage in mm
# that increases *out of* the tissue, force in N. Replace it by your own file. `BAGS` is the folder
# `bags` of the clone; with a notebook from elsewhere, set its path.

from pathlib import Path
from tempfile import gettempdir

from needle_identification import (
    FrictionSettings,
    identify_friction,
    inspect_recording,
    read_friction_recording,
    summarize,
)
import numpy as np

BAGS = next((one for one in map(Path, ('bags', '../../bags')) if one.is_dir()), Path('bags'))

bag = read_friction_recording(BAGS / 'friction_01')
table = Path(gettempdir(), 'stage.csv')
np.savetxt(
    table,
    np.column_stack([1e3 * bag.time, -1e3 * bag.depth, bag.force]),
    fmt='%.5f',
    delimiter=',',
    header='clock,stage,pull',
    comments='',
)
print(table.read_text(encoding='utf-8')[:120])

# %%
# The contents of the file
# ------------------------

inspection = inspect_recording(table)
for column in inspection.contents[0].columns:
    print(f'{column.name}: {column.low:g} to {column.high:g}')

# %%
# Read it
# -------
# A column is given by its role: sign, name and unit. The depth must increase into the tissue.

recording = read_friction_recording(
    table, columns={'time': 'clock[ms]', 'depth': '-stage[mm]', 'force': 'pull[N]'}
)
recording.plot()
recording

# %%
# Estimate friction
# -----------------
# The table has the value of each parameter, its standard error and its 95 % interval.

estimate = identify_friction(recording)
estimate

# %%
# Check the fit
# -------------
# The measured force and the force of the fitted model should differ by noise only. Warnings name
# what contradicts the model.

estimate.fit.plot()
print('warnings:', estimate.warnings or 'none')

# %%
# Is another term needed?
# -----------------------

identify_friction(recording, FrictionSettings(terms=('coulomb', 'viscous', 'stribeck')))

# %%
# Several recordings
# ------------------
# The interval over recordings includes their differences, and is the number to report.

summary = summarize(
    [identify_friction(read_friction_recording(path)) for path in sorted(BAGS.glob('friction_0*'))]
)
for one in summary.statistics:
    low, high = one.interval
    print(f'{one.name}: {one.mean:.4g} {one.unit}, 95 % interval {low:.4g} to {high:.4g}')

# %%
summary.plot()
summary
