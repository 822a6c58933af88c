"""`needle steer`: steer a simulated needle to a target, and compare with a guide at rest."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import asdict, replace
from math import isfinite
from pathlib import Path
from typing import Any, Final, NamedTuple

from needle_controller import OutOfReachError, SIMULATION_LIMITS, SteeringModel, SteeringPrior
from needle_controller.steering.law import (
    build_law,
    DEFAULT_LAW,
    find_law,
    STEERING_LAWS,
)
from needle_controller.steering.limits import STEP_LENGTH
from needle_controller.steering.responses import OF_NEEDLE, OF_STEERING
from needle_controller.steering.simulation import (
    GroundTruth,
    sample_truth,
    simulate_steering,
    SteeringPlant,
    step_depths,
)
from needle_dynamics import (
    FloatArray,
    NeedleParameters,
    NeedlePath,
    NeedleShape,
    STEERING_PRESETS,
    SteeringParameters,
)
from needle_dynamics.steering.parameters import DEFAULT_STEERING_PRESET
from needle_insertion.commands.common import (
    add_constants,
    check_file,
    constants,
    print_each,
    print_result,
    Subcommand,
)
from needle_insertion.commands.simulate_steering import made
from needle_insertion.report.content import png
from needle_insertion.report.insertion import draw_needle, draw_reach, evenly
from needle_insertion.report.text import table
from needle_ros.errors import ParameterError
from needle_ros.files import write_whole
from needle_ros.settings import from_values, unknown_name
import numpy as np

TARGET = '0.004,0.1,-0.002'  #: default target [m]

#: Constants of needle and tissue with an effect here; unknown disturbances are in the prior.
CONSTANTS: Final = (*OF_NEEDLE, *OF_STEERING)

_DRAWN: Final = 0.5  #: standard deviation of the sampled disturbances, as a fraction of the prior
_SHOWN: Final = 4  #: number of needle shapes in the picture


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        'Insert a simulated needle that differs from the nominal model, in steps: measure the '
        'tip, move the guide, insert. For comparison, repeat the insertion with a guide at rest.'
    )
    parser.add_argument(
        '--target',
        default=TARGET,
        metavar='X,Y,Z',
        help=f'target of the tip [m], Y is the depth (default {TARGET})',
    )
    parser.add_argument(
        '--needle',
        choices=tuple(STEERING_PRESETS),
        default=DEFAULT_STEERING_PRESET,
        help=f'nominal model of needle and tissue (default {DEFAULT_STEERING_PRESET})',
    )
    parser.add_argument(
        '--law',
        default=DEFAULT_LAW,
        metavar='NAME',
        help=f'steering law, one of {", ".join(STEERING_LAWS)}, or module:Class of your own '
        f'(default {DEFAULT_LAW})',
    )
    words, prior = ', '.join(CONSTANTS), ', '.join(asdict(SteeringPrior()))
    add_constants(parser, '--set', f'constant of the nominal model, one of {words}')
    add_constants(parser, '--prior', f'prior uncertainty of the model, one of {prior}')
    parser.add_argument(
        '--step',
        type=float,
        default=STEP_LENGTH,
        metavar='M',
        help=f'depth per step (default {STEP_LENGTH:g} m)',
    )
    parser.add_argument(
        '--limit',
        type=float,
        default=SIMULATION_LIMITS.guide_limit,
        metavar='M',
        help='largest displacement of the guide along x and z '
        f'(default {SIMULATION_LIMITS.guide_limit:g} m)',
    )
    parser.add_argument(
        '--turns',
        type=int,
        default=SIMULATION_LIMITS.turns,
        help='largest number of needle rotations (default 0)',
    )
    parser.add_argument(
        '--load-limit',
        type=float,
        default=SIMULATION_LIMITS.load_limit,
        metavar='N',
        help='largest planned lateral force on the guide (default: no limit)',
    )
    parser.add_argument(
        '--seed', type=int, default=0, help='seed of the true needle and of all noise (default 0)'
    )
    parser.add_argument(
        '-o', '--output', type=Path, metavar='FILE', help='picture to write (.png)'
    )
    parser.add_argument('--json', action='store_true', help='print JSON instead of tables')


def _line(line: NeedleShape | NeedlePath) -> FloatArray:
    """Return a needle or its path as points x, y, z, shape (k, 3) [m]."""
    return np.insert(line.deflections, 1, line.depths, axis=1)


def _target(text: str) -> FloatArray:
    try:
        found = [float(word) for word in text.split(',')]
    except ValueError:
        found = []
    if len(found) != 3 or not all(map(isfinite, found)) or found[1] <= 0.0:
        raise ParameterError(f'--target takes X,Y,Z in m with a depth Y > 0, got {text!r}')
    return np.array(found)


class _Task(NamedTuple):
    """Inputs of a steered insertion, from the options."""

    target: FloatArray
    needle: NeedleParameters
    steering: SteeringParameters
    prior: SteeringPrior
    depths: FloatArray


def _task(options: argparse.Namespace) -> _Task:
    """Parse and check the options."""
    if options.output is not None:
        if options.output.suffix != '.png':
            raise ParameterError(f'{options.output}: the picture must be .png')
        check_file(options.output)
    find_law(options.law)
    if options.seed < 0:
        raise ParameterError(f'--seed must be >= 0, got {options.seed}')
    target = _target(options.target)
    if not 0.0 < options.step <= target[1]:
        raise ParameterError(
            f'--step must be in (0, {target[1]:g}] m, the depth of the target, got '
            f'{options.step!r} m'
        )
    for name in constants(options.set):
        if name not in CONSTANTS:
            raise ParameterError(unknown_name(name, CONSTANTS))
    given = {**asdict(SteeringPrior()), **constants(options.prior)}
    return _Task(
        target,
        *made(options.needle, options.set),
        from_values(SteeringPrior, given),
        step_depths(target[1], options.step),
    )


def sample_needle(
    needle: NeedleParameters, steering: SteeringParameters, prior: SteeringPrior, seed: int
) -> GroundTruth:
    """Sample the true needle; its bevel load is the nominal load plus the sampled deviation."""
    nearer = {name: _DRAWN * getattr(prior, name) for name in ('tilt', 'frame', 'bevel')}
    found = sample_truth(
        needle, steering, replace(prior, **nearer), np.random.default_rng(seed), seed
    )
    bevel = found.bevel + np.array([0.0, max(steering.bevel_load)])
    load = float(np.hypot(*bevel))
    return replace(found, bevel=bevel, steering=replace(found.steering, bevel_load=(load,)))


def _run(options: argparse.Namespace) -> int:
    """Steer, write the picture, and print the final tip positions of both needles."""
    target, needle, steering, prior, depths = _task(options)
    aim = target[[0, 2]]
    model = SteeringModel(needle, steering, depths, prior)
    limits = replace(
        SIMULATION_LIMITS,
        guide_limit=options.limit,
        turns=options.turns,
        load_limit=options.load_limit,
    )
    try:
        law = build_law(options.law, model, aim, limits)
    except OutOfReachError as error:
        if options.output is not None:
            write_whole(options.output, png(draw_reach(error.reach, aim)))
        raise
    truth = sample_needle(needle, steering, prior, options.seed)
    noise = np.random.default_rng([options.seed, 1])
    shapes = list[FloatArray]()

    def sensor(tip: FloatArray) -> FloatArray:
        return np.asarray(tip + prior.noise * noise.standard_normal(2))

    def watch(plant: SteeringPlant) -> None:
        shapes.append(_line(plant.needle.shape))

    ours, alone = truth.plant(depths), truth.plant(depths[[0, -1]])
    done = simulate_steering(law, ours, sensor, watch)
    alone.insert()
    tip, other, expected = ours.tip, alone.tip, law.expected()
    found: dict[str, Any] = {
        'target [m]': aim.tolist(),
        'tip [m]': tip.tolist(),
        'tip open loop [m]': other.tolist(),
        'expected tip [m]': None if expected is None else expected.mean.tolist(),
        'expected tip half width [m]': (
            None if expected is None else expected.half_width.tolist()
        ),
        'miss [m]': float(np.hypot(*(tip - aim))),
        'miss open loop [m]': float(np.hypot(*(other - aim))),
        'guide travel [m]': done.travel,
        'turns': done.turns,
        'largest load on the guide [N]': done.load,
        'bending length ratio': law.status().get('bending_length_ratio'),
        'warnings': [done.warning] if done.warning else [],
    }
    print_each('warning', found['warnings'])
    if options.output is not None:
        # In the frame of the needle, to which the sensor frame is rotated.
        mark = target - np.array([truth.frame[0], 0.0, truth.frame[1]]) * target[1]
        figure = draw_needle(
            evenly(shapes, min(_SHOWN, len(shapes))),
            _line(ours.needle.path),
            mark,
            _line(alone.needle.shape),
        )
        write_whole(options.output, png(figure))
    text = (
        f'{options.needle}, seed {options.seed}: {len(depths) - 1} steps to '
        f'{1e3 * target[1]:g} mm, the guide moved by {1e3 * done.travel:.1f} mm in total '
        f'with {done.load:.1f} N at most, the needle turned {done.turns} times\n\n'
        f'{_text(found)}'
    )
    print_result(found, text, filter(None, [options.output]), as_json=options.json)
    return 0


def _text(found: Mapping[str, Any]) -> str:
    """Return the final tip positions as a table, without values that the law does not have."""
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


COMMAND = Subcommand(_add_arguments, _run, signed=('--target',))
