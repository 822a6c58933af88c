# SPDX-License-Identifier: Apache-2.0
"""`needle steer`: steer a simulated needle to a target, and compare with a guide at rest."""

import argparse
from collections.abc import Mapping
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from needle_controller import OutOfReachError, SIMULATION_LIMITS, SteeringModel, SteeringPrior
from needle_controller.steering import simulation
from needle_controller.steering.checked_law import expected_of, report_of
from needle_controller.steering.law import build_law, DEFAULT_LAW, find_law, STEERING_LAWS
from needle_controller.steering.responses import OF_NEEDLE, OF_STEERING
from needle_controller.steering.settings import step_depths
import needle_dynamics as dynamics
from needle_dynamics.needles import DIAMETERS, NeedlePreset
from needle_dynamics.steering.needle import NeedlePath, NeedleShape
from needle_dynamics.steering.parameters import bending_length, longest_insertion, with_bevel
from needle_insertion.commands import common
from needle_insertion.progress import ProgressLine
from needle_insertion.report.content import png, table
from needle_insertion.report.insertion import draw_needle, draw_reach, evenly
from needle_ros.errors import ParameterError
from needle_ros.files import write_whole
from needle_ros.quantities import target as read_target
from needle_ros.quantities import TARGET_HELP
from needle_ros.settings import check_whole, from_values, LARGEST_SEED
from needle_study.scenario import check_names
import numpy as np

TARGET = '4mm,100mm,-2mm'  #: default target

#: Constants of needle and tissue with an effect here; unknown disturbances are in the prior.
CONSTANTS: Final = (*OF_NEEDLE, *OF_STEERING)

_DRAWN: Final = 0.5  #: standard deviation of the sampled disturbances, as a fraction of the prior
_SHOWN: Final = 4  #: number of needle shapes in the picture


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        'Insert a simulated needle that differs from the nominal model, in steps: measure the '
        'tip, move the guide, insert. For comparison, repeat the insertion with a guide at rest.'
    )
    parser.add_argument(
        '--target',
        nargs='+',
        default=[TARGET],
        metavar='X,Y,Z',
        help=f'target of the tip: {TARGET_HELP} (default {TARGET})',
    )
    common.add_needle(parser, dynamics.DEFAULT_NEEDLE)
    parser.add_argument(
        '--law',
        default=DEFAULT_LAW,
        metavar='NAME',
        help=f'steering law, one of {", ".join(STEERING_LAWS)}, or module:Class of your own '
        f'(default {DEFAULT_LAW})',
    )
    words, prior = ', '.join(CONSTANTS), ', '.join(asdict(SteeringPrior()))
    common.add_constants(parser, '--set', f'constant of the nominal model, one of {words}')
    common.add_constants(parser, '--prior', f'prior uncertainty of the model, one of {prior}')
    errors = ', '.join(asdict(simulation.SteppedTipErrors()))
    common.add_constants(
        parser, '--sensor', f'error of the tip sensor beyond noise, one of {errors}'
    )
    limits = SIMULATION_LIMITS
    add = partial(common.add_quantity, parser)
    step = limits.step_length
    add('--step', 'm', f'depth per step (default {1e3 * step:g}mm)', step)
    most = f'along x and z (default {1e3 * limits.guide_limit:g}mm)'
    add('--limit', 'm', f'largest displacement of the guide {most}', limits.guide_limit)
    load = 'largest planned lateral force on the guide (default: no limit)'
    add('--load-limit', 'N', load, limits.load_limit)
    parser.add_argument(
        '--turns',
        type=int,
        default=limits.turns,
        help='largest number of needle rotations (default 0)',
    )
    parser.add_argument(
        '--seed', type=int, default=0, help='seed of the true needle and of all noise (default 0)'
    )
    parser.add_argument(
        '-o', '--output', type=Path, metavar='FILE', help='picture to write (.png)'
    )
    common.add_flag(parser, '--json', 'print JSON instead of tables')


def _line(line: NeedleShape | NeedlePath, frame: dynamics.FloatArray) -> dynamics.FloatArray:
    """Return a needle or its path in the frame of the sensor, as points x, y, z, (k, 3) [m]."""
    shape = line.deflections + np.outer(line.depths, frame)
    return np.insert(shape, 1, line.depths, axis=1)


def _target(options: argparse.Namespace, needle: NeedlePreset) -> dynamics.FloatArray:
    """Return the target, x, y and z [m]; raise `ParameterError` for options that are not valid."""
    if options.output is not None:
        if options.output.suffix != '.png':
            raise ParameterError(f'{options.output}: the picture must be .png')
        common.check_file(options.output)
    find_law(options.law)
    check_whole('--seed', options.seed, 0, LARGEST_SEED)
    target = np.array(read_target(' '.join(options.target)))
    reach = longest_insertion(needle.needle, needle.steering)
    if not 0.0 < target[1] <= reach:
        raise ParameterError(
            f'--target: the depth must be in (0, {1e3 * reach:g}] mm with the needle '
            f'{options.needle}, got {1e3 * target[1]:g} mm; lengths without a unit are in m'
        )
    if not 0.0 < options.step <= target[1]:
        raise ParameterError(
            f'--step must be in (0, {target[1]:g}] m, the depth of the target, got '
            f'{options.step!r} m'
        )
    return target


def sample_needle(
    needle: dynamics.NeedleParameters,
    steering: dynamics.SteeringParameters,
    prior: SteeringPrior,
    seed: int,
) -> simulation.GroundTruth:
    """Sample the true needle; its bevel load is the nominal load plus the sampled deviation."""
    nearer = {name: _DRAWN * getattr(prior, name) for name in ('tilt', 'frame', 'bevel')}
    found = simulation.sample_truth(
        needle, steering, replace(prior, **nearer), np.random.default_rng(seed), seed
    )
    bevel = found.bevel + np.array([0.0, max(steering.bevel_load)])
    # Not of the sampled loads, which may be 0 in all layers.
    loads = with_bevel(steering, float(np.hypot(*bevel))).bevel_load
    return replace(found, bevel=bevel, steering=replace(found.steering, bevel_load=loads))


def run(options: argparse.Namespace) -> int:
    changes = common.constants(options.set)
    check_names('', changes, (*CONSTANTS, *DIAMETERS))
    nominal = dynamics.find_needle(options.needle).changed(changes)
    target = _target(options, nominal)
    depths, aim = step_depths(target[1], options.step, name='--step'), target[[0, 2]]
    needle, steering, _ = nominal
    prior = from_values(SteeringPrior, common.constants(options.prior, '--prior'))
    errors = from_values(simulation.SteppedTipErrors, common.constants(options.sensor, '--sensor'))
    limits = replace(
        SIMULATION_LIMITS,
        guide_limit=options.limit,
        turns=options.turns,
        load_limit=options.load_limit,
    )
    try:
        with ProgressLine('model and first plan', brief=True):
            model = SteeringModel(needle, steering, depths, prior)
            law = build_law(options.law, model, aim, limits)
    except OutOfReachError as error:
        if options.output is not None:
            write_whole(options.output, png(draw_reach(error.reach, aim)))
        raise
    truth = sample_needle(needle, steering, prior, options.seed)
    noise, losses = (np.random.default_rng([options.seed, stream]) for stream in (1, 3))
    shapes = list[dynamics.FloatArray]()

    def watch(plant: simulation.SteeringPlant) -> None:
        shapes.append(_line(plant.needle.shape, truth.frame))
        show(f'step {len(shapes)} of {len(depths) - 1}')

    ours, alone = truth.plant(depths), truth.plant(depths[[0, -1]])
    sensor = simulation.SteppedTipSensor(ours, prior.noise, errors, options.seed, noise, losses)
    with ProgressLine('steering', brief=True) as show:
        done = simulation.simulate_steering(law, ours, sensor, watch, limits)
        alone.insert()
    tip, other, expected = ours.tip, alone.tip, expected_of(law)
    found: dict[str, Any] = {
        'target [m]': aim.tolist(),
        'tip [m]': tip.tolist(),
        'tip open loop [m]': other.tolist(),
        'expected tip [m]': expected and expected.mean.tolist(),
        'expected tip half width [m]': expected and expected.half_width.tolist(),
        'miss [m]': float(np.hypot(*(tip - aim))),
        'miss open loop [m]': float(np.hypot(*(other - aim))),
        'bending length [m]': bending_length(needle.bending_stiffness, needle.tissue_stiffness),
        'free length [m]': steering.free_length,
        'skin stiffness [N/m]': steering.skin_stiffness,
        'bevel load [N]': max(steering.bevel_load),
        'guide travel [m]': done.travel,
        'turns': done.turns,
        'largest load on the guide [N]': done.load,
        'bending length ratio': report_of(law).status.get('bending_length_ratio'),
        'warnings': [done.warning] if done.warning else [],
    }
    common.print_each('warning', found['warnings'])
    if options.output is not None:
        figure = draw_needle(
            evenly(shapes, min(_SHOWN, len(shapes))),
            _line(ours.needle.path, truth.frame),
            target,
            _line(alone.needle.shape, truth.frame),
        )
        write_whole(options.output, png(figure))
    text = (
        f'{options.needle}, seed {options.seed}: {len(depths) - 1} steps to '
        f'{1e3 * target[1]:g} mm, guide travel {1e3 * done.travel:.1f} mm, load on the guide up '
        f'to {done.load:.1f} N, {done.turns} turns of the needle\n'
        f'nominal: lambda {1e3 * found["bending length [m]"]:.1f} mm, free length '
        f'{1e3 * steering.free_length:g} mm, skin {steering.skin_stiffness:g} N/m, bevel load '
        f'{found["bevel load [N]"]:g} N\n\n'
        f'{_text(found)}'
    )
    common.print_result(found, text, filter(None, [options.output]), as_json=options.json)
    return 0


def _text(found: Mapping[str, Any]) -> str:
    rows = [
        (name, f'{1e3 * x:.3f}', f'{1e3 * z:.3f}', '' if miss is None else f'{1e3 * miss:.3f}')
        for name, at, miss in (
            ('target', found['target [m]'], None),
            ('tip', found['tip [m]'], found['miss [m]']),
            ('expected tip', found['expected tip [m]'], None),
            ('± (95 %)', found['expected tip half width [m]'], None),
            ('open loop', found['tip open loop [m]'], found['miss open loop [m]']),
        )
        if at is not None
        for x, z in (at,)
    ]
    return table(rows, ('', 'x [mm]', 'z [mm]', 'miss [mm]'))
