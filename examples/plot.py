# SPDX-License-Identifier: Apache-2.0
"""
Plot depth and tip deflection of an insertion over time, and the shape of the needle.

The picture is written to `insertion.png`, or to the file given on the command line.
"""

import sys

from matplotlib.figure import Figure
from needle_dynamics import NeedleModel, NeedleParameters, simulate


def main(file: str = 'insertion.png') -> None:
    """Push with 4 N for 5 s, from 5 cm inside with the tip deflected by 0.5 mm."""
    parameters = NeedleParameters.preset('phantom')
    model = NeedleModel(parameters)
    run = simulate(
        parameters, model.state_at(0.05, tip_deflection=5e-4), 4.0, duration=5.0, interval=1e-4
    )

    figure = Figure(figsize=(6.0, 7.0), layout='constrained')
    depth, tip, shape = figure.subplots(3)
    depth.plot(run.time, 1e3 * run.depth)
    depth.set(xlabel='time [s]', ylabel='depth [mm]')
    first = run.time < 0.02
    tip.plot(1e3 * run.time[first], 1e3 * run.tip_deflection[first])
    tip.set(xlabel='time [ms]', ylabel='tip deflection [mm]')
    for sample in (0, 5, 10):
        y, deflection = 1e3 * model.shape(run.states[sample]).T
        shape.plot(y, deflection, label=f'{1e3 * run.time[sample]:.1f} ms')
    shape.set(xlabel='along the needle [mm]', ylabel='deflection [mm]')
    shape.legend()
    figure.savefig(file)
    print(f'wrote {file}')


if __name__ == '__main__':
    main(*sys.argv[1:2])
