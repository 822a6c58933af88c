# SPDX-License-Identifier: Apache-2.0
"""`needle plan`: entry point and needle path with the largest clearance in a segmented image."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, Final, TYPE_CHECKING

from needle_controller.steering.insertion_plan import Plan, write_plan
from needle_controller.steering.settings import SteeringLimits
from needle_dynamics.needles import DEFAULT_NEEDLE, find_needle
from needle_dynamics.steering.parameters import longest_insertion
from needle_insertion.commands import common
from needle_insertion.progress import ProgressLine
from needle_insertion.report.content import table
from needle_planning.anatomy import plan_warnings
from needle_planning.clearance import LIMIT
from needle_planning.paths import SKIN_LIMIT
from needle_planning.planner import find_plan, RESOLUTION
from needle_ros.errors import ParameterError
from needle_ros.quantities import point
from needle_ros.settings import check_whole, checked, LARGEST_SEED
import numpy as np

if TYPE_CHECKING:
    # Takes half a second to import.
    from needle_planning.chance import Chance

_SHOWN: Final = 50  #: Inserted needles on the page.

#: Options whose value may begin with a minus sign.
SIGNED = ('--target', '--entry')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        'Find the entry point from which a needle reaches a target with the largest clearance, '
        'straight or bowed by the guide, and prove that no other straight needle is better by '
        'more than a resolution. Positions are in patient coordinates, RAS.'
    )
    parser.add_argument(
        'segmentation',
        type=Path,
        nargs='+',
        metavar='SEGMENTATION',
        help='segmented image or surfaces (.nrrd, .nii, .nii.gz, .stl), several for one patient',
    )
    parser.add_argument(
        '--labels',
        type=Path,
        required=True,
        metavar='LABELS.yaml',
        help='role of each label: obstacle with a margin, tissue, target or entry',
    )
    parser.add_argument(
        '--target',
        required=True,
        metavar='R,A,S',
        help='target of the tip, such as 40mm,-12mm,105mm; m without a unit',
    )
    parser.add_argument(
        '--entry',
        metavar='REGION',
        help='name of the structure where the needle may enter, or an entry point R,A,S (default: '
        'all structures with the role entry)',
    )
    common.add_quantity(
        parser,
        '--entry-radius',
        'm',
        'radius of the disc of entry points around an entry point (default 10mm)',
    )
    common.add_needle(parser, DEFAULT_NEEDLE)
    limits = SteeringLimits()
    for name, unit, meaning, value in (
        ('--step', 'm', 'longest step of the insertion', limits.step_length),
        ('--limit', 'm', 'largest displacement of the guide along x and z', limits.guide_limit),
        ('--guide-step', 'm', 'largest motion of the guide in a step', limits.guide_step),
        ('--load-limit', 'N', 'largest lateral force on the guide', limits.load_limit),
        ('--skin-limit', 'm', 'largest displacement of the needle at the skin', SKIN_LIMIT),
        ('--roll', 'rad', 'roll of the needle', 0.0),
        ('--resolution', 'm', 'resolution of the search', RESOLUTION),
    ):
        shown = f'{1e3 * value:g}mm' if unit == 'm' else f'{value:g}{unit}'
        common.add_quantity(parser, name, unit, f'{meaning} (default {shown})', value)
    common.add_flag(parser, '--straight', 'plan a straight needle only')
    parser.add_argument(
        '--insertions',
        type=int,
        default=0,
        metavar='N',
        help='simulate N insertions along the plan with uncertain needle, tissue, poses and '
        'sensor, and print the probability of success, such as 1000 (default 0)',
    )
    parser.add_argument(
        '--population',
        type=Path,
        metavar='FILE',
        help='uncertainty of these insertions, in the format of a study (default: documented)',
    )
    common.add_quantity(
        parser, '--radius', 'm', 'largest distance of the tip from a hit target (default 1mm)'
    )
    parser.add_argument('--seed', type=int, help='seed of the insertions (default 1)')
    parser.add_argument('-o', '--output', type=Path, metavar='FILE', help='plan to write (.yaml)')
    parser.add_argument(
        '--page',
        type=Path,
        metavar='FILE.html',
        help='page to write: anatomy and needle in 3D and in sections, with the needles of the '
        'simulated insertions, and all numbers; its pictures are written to the same folder',
    )
    parser.add_argument(
        '--slicer',
        type=Path,
        metavar='FOLDER',
        help='folder of files for 3D Slicer to write: needle as a curve (needle.mrk.json) and as '
        'a model (needle.vtk), entry point and target (points.mrk.json)',
    )
    common.add_flag(parser, '--json', 'print JSON instead of a table')


def run(options: argparse.Namespace) -> int:
    _check_outputs(options)
    target = _position('--target', options.target)
    limits = SteeringLimits(
        step_length=options.step,
        guide_limit=options.limit,
        guide_step=options.guide_step,
        load_limit=options.load_limit,
    )
    needle = find_needle(options.needle)
    reach = longest_insertion(needle.needle, needle.steering)
    checked('--step', options.step, 'm', low=0.0, high=reach, open_low=True)
    entry = _entry(options)
    simulate = _simulation(options)
    begin = perf_counter()
    with ProgressLine('plan', brief=True) as show:
        show('reading the segmentation')
        # Imported here: readers of images are optional.
        from needle_planning.labels import read_anatomy

        anatomies = read_anatomy(options.segmentation, options.labels)
        plan = find_plan(
            anatomies,
            target,
            **entry,
            needle=options.needle,
            limits=limits,
            roll=options.roll,
            skin_limit=options.skin_limit,
            bow=not options.straight,
            resolution=options.resolution,
            progress=show,
        )
        seconds = perf_counter() - begin

        def advance(done: int, total: int) -> None:
            show(f'{done} of {total} insertions', done / total)

        chance = simulate and simulate(plan, anatomies, limits=limits, progress=advance)
    files = []
    if options.output is not None:
        write_plan(plan, options.output, chance.document() if chance else None)
        files.append(options.output)
    if options.page is not None:
        with ProgressLine('page', brief=True):
            from needle_insertion.report.plan_page import write_plan_page

            write_plan_page(plan, anatomies, options.page, chance or None)
        files.append(options.page)
    if options.slicer is not None:
        from needle_insertion.slicer.plan_files import write_slicer

        common.make_folder(options.slicer)
        files += write_slicer(plan, anatomies, options.slicer)
    warnings = plan_warnings(anatomies, plan.target, plan.entry, plan.direction)
    common.print_each('warning', warnings)
    document, text = document_of(plan, seconds), text_of(plan, seconds)
    document['warnings'] = warnings
    if chance:
        document['simulation'] = chance.document()
        text += f'\n\n{chance_text(chance)}'
    common.print_result(document, text, files, as_json=options.json)
    return 0


def _check_outputs(options: argparse.Namespace) -> None:
    """Raise `ParameterError` if an output has a wrong ending, or is an input or another one."""
    inputs = *options.segmentation, options.labels, options.population, Path(options.needle)
    taken = {path.expanduser().resolve() for path in inputs if path is not None}
    for name, path, endings in (
        ('--output', options.output, ('.yaml', '.yml')),
        ('--page', options.page, ('.html', '.htm')),
    ):
        common.check_file(path)
        if path is None:
            continue
        if path.resolve() in taken:
            raise ParameterError(f'{path} cannot be written: it is an input')
        if path.suffix.lower() not in endings:
            raise ParameterError(f'{name} must be a file {endings[0]}, got {path}')
    common.check_folder(options.slicer)


def _simulation(options: argparse.Namespace) -> Callable[..., Chance] | None:
    """Check the options of the simulated insertions; return the function, None for none."""
    if not options.insertions:
        for name in ('population', 'radius', 'seed'):
            if getattr(options, name) is not None:
                raise ParameterError(f'--{name} is of simulated insertions: add --insertions 1000')
        return None
    # Imported here: Sobol sequences take half a second, and the output of studies is optional.
    from needle_planning.chance import chance_of, MOST_INSERTIONS, read_population

    check_whole('--insertions', options.insertions, 0, MOST_INSERTIONS)
    given: dict[str, Any] = {}
    if options.seed is not None:
        check_whole('--seed', options.seed, 0, LARGEST_SEED)
        given['seed'] = options.seed
    if options.radius is not None:
        given['radius'] = checked('--radius', options.radius, 'm', low=0.0, open_low=True)
    if options.population is not None:
        given['population'], given['correlations'] = read_population(options.population)
    return partial(
        chance_of,
        insertions=options.insertions,
        shafts=min(options.insertions, _SHOWN) if options.page is not None else 0,
        **given,
    )


def _position(name: str, text: str) -> list[float]:
    return point(text, f'{name} must be R,A,S, such as 40mm,-12mm,105mm')


def _entry(options: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments of `find_plan` for the name of a structure, or an entry point."""
    text, radius = options.entry, options.entry_radius
    if text is None or ',' not in text:
        if radius is not None:
            raise ParameterError('--entry-radius is of an entry point: add --entry R,A,S')
        return {'entry': text}
    point_of = {'entry': _position('--entry', text)}
    return point_of if radius is None else {**point_of, 'entry_radius': radius}


def document_of(plan: Plan, seconds: float) -> dict[str, Any]:
    """Return the results for `--json`, in SI units."""
    return {
        'entry [m]': plan.entry.tolist(),
        'direction': plan.direction.tolist(),
        'target [m]': plan.target.tolist(),
        'length [m]': plan.length,
        'clearance [m]': plan.clearance,
        'clearance may be larger': plan.at_limit,
        'structure': plan.structure,
        'place [m]': plan.place.tolist(),
        'bow [m]': plan.bow,
        'largest straight clearance [m]': plan.straight_bound,
        'largest clearance [m]': plan.bound,
        'resolution [m]': plan.resolution,
        'time [s]': seconds,
    }


def text_of(plan: Plan, seconds: float) -> str:
    """Return the results as text and a table, lengths in mm."""
    rows = [
        (name, *(f'{factor * one:.{digits}f}' for one in at))
        for name, at, factor, digits in (
            ('entry', plan.entry, 1e3, 2),
            ('target', plan.target, 1e3, 2),
            ('least clearance', plan.place, 1e3, 2),
            ('direction', plan.direction, 1.0, 4),
        )
    ]
    kind = f'bowed by up to {1e3 * plan.bow:.2f} mm' if plan.guide.any() else 'straight'
    travel = 1e3 * np.abs(plan.guide).max(initial=0.0)
    return (
        f'path found in {seconds:.1f} s: {plan.needle}, {len(plan.guide)} steps to '
        f'{1e3 * plan.length:.1f} mm, {kind}, guide within {travel:.2f} mm\n'
        f'{_clearance(plan)}\n\n'
        f'{table(rows, ("", "R [mm]", "A [mm]", "S [mm]"))}'
    )


def _clearance(plan: Plan) -> str:
    found, limit = f'{1e3 * plan.clearance:.2f} mm', f'{1e3 * LIMIT:g} mm'
    if plan.at_limit:
        return f'clearance at least {found} to all obstacles, searched up to {limit}'
    straight = f'no straight needle has more than {1e3 * plan.straight_bound:.2f} mm'
    every = f'no needle within the limits of the guide more than {1e3 * plan.bound:.2f} mm'
    # Clearances above the limit are not distinguished.
    if plan.straight_bound >= LIMIT:
        straight = f'a straight needle may have {limit} or more'
    if plan.bound >= LIMIT:
        every = f'a needle within the limits of the guide may have {limit} or more'
    return f'clearance {found} to {plan.structure}, beyond its margin; {straight},\n{every}'


def chance_text(chance: Chance) -> str:
    """Return the results of simulated insertions as a table and text."""
    heads = f'{chance.insertions} insertions', 'probability', '95 % interval'
    return (
        f'{table(chance.rows(), heads)}\n\n'
        f'largest causes of failure, fraction of its variance: {chance.causes_text()}\n'
        f'tolerated error of the entry point: {chance.tolerance_text()}'
    )
