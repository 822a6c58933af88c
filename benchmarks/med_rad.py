# SPDX-License-Identifier: Apache-2.0
"""
Plans in the anatomies of Med-RAD, from start to target: ``python -m benchmarks.med_rad FOLDER``.

The dataset (github.com/UNC-Robotics/Med-RAD, CC BY-NC-SA) has segmentations of brain, liver and
lungs with start poses and targets; it is not part of this project. Obstacles are vessels, and in
the brain the ventricles, with a margin. Each pair is planned from the given start point, with a
bow if it helps, and with entry points around it, straight and with a bow.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import re
import sys
from tempfile import TemporaryDirectory
from time import process_time
from typing import Final, NamedTuple

from benchmarks.page import table
from needle_dynamics import FloatArray
from needle_planning import Anatomy, find_plan, NoPathError, Plan, read_anatomy
from needle_ros.errors import ParameterError
import numpy as np
import yaml

#: Steel of 1.27 mm, as 18 gauge, like `bending_35mm`, but long enough for all pairs.
_NEEDLE: Final = {'length': 0.3}
_OBSTACLE: Final = re.compile(r'vessel|artery|vein|ventricle', re.IGNORECASE)
_MARGIN, _AROUND = 2e-3, 20e-3  #: Margin of the obstacles, and radius around the start [m].


class StartAndTarget(NamedTuple):
    """Start pose and target of a patient."""

    name: str
    start: FloatArray  #: start point [m], shape (3,)
    slope: float  #: of the line to the target against the start direction
    target: FloatArray  #: target [m], shape (3,)


def pairs(folder: Path) -> Iterator[StartAndTarget]:
    """Yield the pairs of the folder of a patient."""
    for file in sorted(folder.glob('*start*.txt')):
        pose = np.loadtxt(file)
        number = re.match(r'\D*(\d)_', file.stem)
        names = [f'target{number[1]}.txt'] if number else ['target.txt', 'target1.txt']
        target = next(folder / name for name in names if (folder / name).exists())
        start, end = 1e-3 * pose[:3, 3], 1e-3 * np.loadtxt(target).ravel()
        line = (end - start) / np.linalg.norm(end - start)
        along = abs(float(line @ pose[:3, 2]))
        slope = float(np.tan(np.arccos(min(1.0, along))))
        yield StartAndTarget(f'{folder.parent.name} {folder.name} {file.stem}', start, slope, end)


def anatomy_of(folder: Path) -> tuple[Anatomy, ...]:
    """Read the obstacles of a patient."""
    files = [file for file in sorted(folder.glob('*.nii.gz')) if _OBSTACLE.search(file.name)]
    roles = {file.name.split('.')[0]: {'role': 'obstacle', 'margin': _MARGIN} for file in files}
    with TemporaryDirectory() as written:
        labels = Path(written) / 'labels.yaml'
        labels.write_text(yaml.safe_dump({'structures': roles}))
        return read_anatomy(files, labels)


def found(
    anatomy: tuple[Anatomy, ...], pair: StartAndTarget, needle: Path, radius: float, *, bow: bool
) -> tuple[Plan | None, str]:
    """Return a plan from entry points within a radius [m], or the reason why there is none."""
    try:
        return find_plan(
            anatomy,
            pair.target,
            entry=pair.start,
            entry_radius=radius,
            needle=str(needle),
            bow=bow,
        ), ''
    except (NoPathError, ParameterError) as error:
        return None, str(error)


def main(folder: Path, needle: Path) -> None:
    """Plan all pairs, and print a table and the reasons where there is no plan."""
    rows, reasons = [], []
    folders = sorted({file.parent for file in folder.glob('**/*start*.txt')})
    for patient in folders:
        anatomy = anatomy_of(patient)
        for pair in pairs(patient):
            begin = process_time()
            plans = [
                found(anatomy, pair, needle, radius, bow=bow)
                for radius, bow in ((0.0, True), (_AROUND, False), (_AROUND, True))
            ]
            used = process_time() - begin
            length = 1e3 * np.linalg.norm(pair.target - pair.start)
            shown = [f'{1e3 * plan.clearance:.2f}' if plan else '-' for plan, _ in plans]
            size = f'{length:.0f}', f'{pair.slope:.2f}'
            rows.append((pair.name, *size, *shown, f'{used:.1f}'))
            reasons += [
                f'- {pair.name}, {where}: {plan[1]}'
                for where, plan in (('from the start', plans[0]), ('within 20 mm', plans[-1]))
                if plan[0] is None
            ]
    head = (
        'pair', 'length [mm]', 'slope', 'from the start, bowed [mm]',
        'straight, within 20 mm [mm]', 'bowed, within 20 mm [mm]', 'processor time [s]',
    )  # fmt: skip
    sys.stdout.write('\n'.join([table(head, rows), '', *reasons, '']))


if __name__ == '__main__':
    with TemporaryDirectory() as own:
        file = Path(own) / 'needle.yaml'
        file.write_text(yaml.safe_dump(_NEEDLE))
        main(Path(sys.argv[1]), file)
