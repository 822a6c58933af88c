# SPDX-License-Identifier: Apache-2.0
"""Run the demo: insertions, identification of friction and stiffness, and one report."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
import shutil
import sys
from typing import Final

from needle_identification import (
    FrictionEstimate,
    identify_friction,
    identify_stiffness,
    read_friction_recording,
    read_indentation_recording,
    StiffnessEstimate,
    summarize,
    summarize_stiffness,
    write_result,
)
from needle_insertion.progress import ProgressLine
from needle_insertion.report import identify_figures
from needle_insertion.report.content import Picture, table
from needle_insertion.report.page import write_page
from needle_ros.errors import NeedleError
from reproduction.campaign import Campaign
from reproduction.content import Check, CHECK_HEADS
from reproduction.insertions import aiming, bending, insertion
from reproduction.plan import plan_insertion
from reproduction.protocol import PROTOCOLS
from reproduction.record import rig
from reproduction.truth import compare_friction, compare_stiffness, Coverage, TruthComparison

EXPERIMENT_SPEED: Final = 25.0  #: Speed of the recorded experiments, as a multiple of real time.

#: Largest error of a fresh estimate at every force, in half-widths of the 95 % interval. With new
#: noise one of the 22 estimates would exceed it in one of 20 runs, but the noise seed is fixed.
LARGEST_DISTANCE: Final = 2.0

_MARKER: Final = '.needle-demo'

_INTRODUCTION: Final = (
    f'Nodes over DDS at {insertion.RATE:g} Hz: insertion from '
    f'{insertion.START_DEPTH * 100:g} cm to {insertion.TARGET_DEPTH * 100:g} cm at '
    f'{insertion.SPEED * 1000:g} mm/s, of a needle that bends and under two control laws, and of '
    'one that is steered to a target, recorded to MCAP; a path planned in a synthetic liver '
    '(plan/plan.html); friction and tissue stiffness identified '
    'from the shipped simulated recordings and one fresh recording each, '
    f'made at {EXPERIMENT_SPEED:g} times real time.'
)


class DemoError(NeedleError):
    """The demo cannot run in this folder."""


def run(output: Path, bags: Path, *, lockstep: bool = True) -> int:
    """
    Run the demo; return 0 if every check passed, else 1.

    An earlier demo in `output` is replaced. `bags` is the folder of the shipped recordings. In
    lock-step the insertions are the same on any machine. Raises `DemoError` if there are no
    shipped recordings or `output` is not from a demo, and `JobError` if a node fails.
    """
    shipped = {name: _shipped(bags, name) for name in PROTOCOLS}
    _clear(output)
    insertions, bent = [], output / 'bending'
    with ProgressLine('insertion, bent needle') as show:
        bending.record_bending(bent, output / 'logs' / 'bending', show, lockstep=lockstep)
    for law in ('adaptive', 'pid'):
        with ProgressLine(f'insertion, {law}') as show:
            insertion.record_insertion(
                law, output / law, output / 'logs' / law, show, lockstep=lockstep
            )
            show('reading')
            insertions.append(insertion.read_insertion(law, output / law))
    aimed, alone = output / 'steered', output / 'guide_at_rest'
    for folder, steered in ((alone, False), (aimed, True)):
        with ProgressLine(f'insertion, {folder.name.replace("_", " ")}') as show:
            logs = output / 'logs' / folder.name
            aiming.record_aimed(folder, logs, show, steered=steered, lockstep=lockstep)
    for name, protocol in PROTOCOLS.items():
        # The noise is the same in each demo, and so is the verdict.
        campaign = Campaign(protocol=protocol, repeats=1, seed=1, fixed=True)
        (parameters,) = campaign.runs.values()
        with (
            ProgressLine(f'{name} experiment') as show,
            rig(output, protocol, show.note) as running,
        ):
            running.record(output / name, parameters, EXPERIMENT_SPEED, partial(show, 'recording'))

    with ProgressLine('plan') as show:
        show('synthetic liver')
        checks = plan_insertion(output / 'plan')

    friction: list[FrictionEstimate] = []
    stiffness: list[StiffnessEstimate] = []
    compared: dict[str, list[list[TruthComparison]]] = {'friction': [], 'stiffness': []}
    total = sum(map(len, shipped.values())) + 2
    with ProgressLine('identification') as show:
        for bag in (*shipped['friction'], output / 'friction'):
            show('friction', len(friction) / total)
            recording = read_friction_recording(bag)
            friction.append(identify_friction(recording))
            compared['friction'].append(_known(bag, compare_friction(recording, friction[-1])))
        for bag in (*shipped['stiffness'], output / 'stiffness'):
            show('stiffness', (len(friction) + len(stiffness)) / total)
            indentation = read_indentation_recording(bag)
            stiffness.append(identify_stiffness(indentation))
            compared['stiffness'].append(
                _known(bag, compare_stiffness(indentation, stiffness[-1]))
            )
    write_result(
        output / 'result.yaml', summarize(friction[:-1]), summarize_stiffness(stiffness[:-1])
    )

    with ProgressLine('report') as show:
        show('checking the bent needle')
        checks += bending.bending_checks(bent)
        show('checking the steered needle')
        checks += aiming.aiming_checks(aimed, alone)
        checks += [check for one in insertions for check in insertion.insertion_checks(one)]
        for *recorded, fresh in compared.values():
            checks += _shipped_checks(f'{len(recorded)} shipped bags', recorded)
            checks += _fresh_checks(fresh)
        passed = sum(check.passed for check in checks)
        # Failed checks first.
        rows = [check.row for check in sorted(checks, key=lambda check: check.passed)]
        page = output / 'report.html'
        show('drawing')
        write_page(
            page,
            'checks.html',
            title='Needle insertion: demo',
            introduction=_INTRODUCTION,
            cards=[
                ('Checks', f'{passed} of {len(checks)} pass', 'true values and results'),
                (
                    'Steered',
                    f'{1e3 * aiming.read_aimed(aimed).miss:.2f} mm from its target',
                    f'expected tip at {aiming.read_aimed(aimed).interval_text} (95 %)',
                ),
            ],
            rows=rows,
            heads=CHECK_HEADS,
            pictures=_pictures(bent, (aimed, alone), insertions, friction[-1], stiffness[-1]),
            animation=aiming.animate_aiming(aimed),
        )
    sys.stdout.write(f'{table(rows, CHECK_HEADS)}\n\nreport: {page}\n')
    return 0 if all(check.passed for check in checks) else 1


def _shipped(bags: Path, name: str) -> list[Path]:
    found = sorted(path for path in bags.glob(f'{name}_*') if path.is_dir())
    if not found:
        raise DemoError(
            f'{bags} holds no {name} recordings ({name}_*); run from a clone or give --bags'
        )
    return found


def _clear(output: Path) -> None:
    """Remove the results of an earlier demo; reject any other folder."""
    if output.exists():
        if not (output / _MARKER).is_file():
            raise DemoError(f'{output} exists and is not from a demo; name another folder')
        shutil.rmtree(output)
    output.mkdir(parents=True)
    (output / _MARKER).touch()


def _pictures(
    bent: Path,
    aimed: tuple[Path, Path],
    insertions: Sequence[insertion.RecordedInsertion],
    friction: FrictionEstimate,
    stiffness: StiffnessEstimate,
) -> list[Picture]:
    return [
        Picture(
            'bending',
            'Bending needle during the insertion, about the path that it cuts, to scale: the '
            'bevel pushes the tip along z until the needle is rotated, and the guide is displaced '
            'along x.',
            bending.draw_bending(bent),
        ),
        Picture(
            'steered',
            'Needle steered to a target off the axis, in tissue that is softer than the nominal '
            'model, and the same insertion with a guide at rest. To scale: the needle during the '
            'insertion, about the path that it cuts, and its target.',
            aiming.draw_aiming(*aimed),
        ),
        Picture(
            'insertion',
            'Insertion under both controllers. At the bottom, the tip sensor after the start: '
            f'{insertion.START_DEFLECTION * 1e3:g} mm that ring at 2 kHz and decay. The sensor '
            'averages over 1 ms, which leaves little more than its noise.',
            insertion.draw_insertions(insertions),
        ),
        Picture(
            'friction',
            'Friction, fresh recording. Force over time and against speed, with the fit of '
            'F = mu_s sgn(v) + mu_v v, (15), to steady motion.',
            identify_figures.friction_data(friction),
        ),
        Picture(
            'presses',
            'Presses, fresh recording. Left: force against displacement of each press. Right: '
            'rest positions of the end-effector, and those of the fitted matrix (ellipses).',
            identify_figures.stiffness_presses(stiffness),
        ),
        Picture(
            'stiffness',
            'Stiffness, fresh recording, by force. Entries of the matrix with 95 % intervals. The '
            'true values are the means of Table 2 (gray).',
            identify_figures.stiffness_levels(summarize_stiffness([stiffness])),
        ),
    ]


def _known(bag: Path, comparisons: list[TruthComparison]) -> list[TruthComparison]:
    """Require that the true values are available."""
    if any(one.truth is None for one in comparisons):
        raise DemoError(f'{bag} does not hold the configuration of its plant')
    return comparisons


def _by_symbol(comparisons: Sequence[TruthComparison]) -> Mapping[str, list[TruthComparison]]:
    groups: dict[str, list[TruthComparison]] = {}
    for one in comparisons:
        groups.setdefault(one.estimate.symbol, []).append(one)
    return groups


def _shipped_checks(source: str, bags: Sequence[Sequence[TruthComparison]]) -> list[Check]:
    """Check the number of 95 % intervals that contain the true value of their own bag."""
    checks = []
    for symbol, group in _by_symbol([one for bag in bags for one in bag]).items():
        found = Coverage.of(group)
        checks.append(
            Check(
                f'{symbol}, {source}',
                f'in 95 % of the intervals (>= {found.least} of {found.known})',
                f'in {found.held} of {found.known}',
                found.is_enough,
            )
        )
    return checks


def _fresh_checks(comparisons: Sequence[TruthComparison]) -> list[Check]:
    """Check the error in half-widths of the 95 % interval, at the force of the largest error."""
    checks = []
    for symbol, group in _by_symbol(comparisons).items():
        worst = max(group, key=_distance)
        found, where = worst.estimate, '' if worst.force is None else f' at {worst.force:.2g} N'
        checks.append(
            Check(
                f'{symbol}{where}, fresh recording',
                f'{worst.truth:.5g} {found.unit} within {LARGEST_DISTANCE:g} x 95 %',
                f'{found.value:.5g} ± {_half_width(worst):.2g} (95 %)',
                _distance(worst) <= LARGEST_DISTANCE,
            )
        )
    return checks


def _half_width(one: TruthComparison) -> float:
    low, high = one.estimate.interval
    return (high - low) / 2.0


def _distance(one: TruthComparison) -> float:
    """Return the error of an estimate in half-widths of its 95 % interval."""
    if not one.estimate.determined or one.truth is None:
        return float('inf')
    return abs(one.estimate.value - one.truth) / _half_width(one)
