"""`needle steer`: the guide moves so that the tip hits a target, beside one that rests."""

from __future__ import annotations

import argparse
from dataclasses import asdict, dataclass, replace
import json
from math import hypot, isfinite, sqrt
from pathlib import Path
import sys
from typing import Any, Final

from needle_controller import SteeringBelief, SteeringController, SteeringModel
from needle_dynamics import (
    FloatArray,
    NeedleParameters,
    SteeredNeedle,
    STEERING_PRESETS,
    SteeringParameters,
)
from needle_identification.result import write_whole
from needle_insertion.commands.common import check_file, Command, constants
from needle_insertion.commands.simulate_steering import made
from needle_insertion.report.content import png
from needle_insertion.report.insertion import draw_needle
from needle_insertion.report.text import table
from needle_ros.errors import ParameterError
from needle_ros.settings import from_values
import numpy as np

#: Target [m], step [m] and limit of the guide [m] by default.
TARGET, STEP, LIMIT = '0.004,0.1,-0.002', 5e-3, 6e-3

#: What nobody knows is drawn with this part of the deviations that are believed.
_DRAWN: Final = 0.5

#: Needles that are drawn.
_SHOWN: Final = 4

#: Half of an interval of 95 % over the standard deviation.
_NORMAL: Final = 1.96


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `needle steer`."""
    parser.description = (
        'Insert a simulated needle that differs from what is believed of it, in steps: look at '
        'the tip, move the guide, go on. Beside it the same insertion with a guide at rest.'
    )
    parser.add_argument(
        '--target',
        default=TARGET,
        metavar='X,Y,Z',
        help=f'where the tip shall be [m], Y the depth (default {TARGET})',
    )
    parser.add_argument(
        '--needle',
        choices=tuple(STEERING_PRESETS),
        default='bending_35mm',
        help='needle and tissue as they are believed (default bending_35mm)',
    )
    parser.add_argument(
        '--set',
        action='append',
        default=[],
        metavar='NAME=VALUE',
        help='any constant of these, SI units; repeatable',
    )
    parser.add_argument(
        '--belief',
        action='append',
        default=[],
        metavar='NAME=VALUE',
        help='how far they may be wrong, of '
        f'{", ".join(asdict(SteeringBelief()))}, SI units; repeatable',
    )
    parser.add_argument(
        '--step', type=float, default=STEP, metavar='M', help=f'way of a step (default {STEP:g} m)'
    )
    parser.add_argument(
        '--limit',
        type=float,
        default=LIMIT,
        metavar='M',
        help=f'farthest position of the guide along x and z (default {LIMIT:g} m)',
    )
    parser.add_argument(
        '--seed', type=int, default=0, help='seed of the true needle and of all noise (default 0)'
    )
    parser.add_argument(
        '-o', '--output', type=Path, metavar='FILE', help='picture to write (.png)'
    )
    parser.add_argument('--json', action='store_true', help='print JSON instead of tables')


@dataclass(frozen=True, slots=True)
class _Truth:
    """The needle as it is, and the turn of the sensor's frame."""

    needle: NeedleParameters
    steering: SteeringParameters
    tilt: tuple[float, float]
    roll: float
    frame: FloatArray
    seed: int

    def start(self) -> SteeredNeedle:
        return SteeredNeedle(
            self.needle, self.steering, tilt=self.tilt, roll=self.roll, seed=self.seed
        )

    def seen(self, one: SteeredNeedle) -> FloatArray:
        """Return where the tip is in the frame of the sensor."""
        return np.asarray(one.tip[[0, 2]] + self.frame * one.depth)


def _drawn(
    needle: NeedleParameters, steering: SteeringParameters, belief: SteeringBelief, seed: int
) -> _Truth:
    """Draw a needle of the belief."""
    rng = np.random.default_rng(seed)
    longer, skin = 1.0 + belief.spread * rng.uniform(-1.0, 1.0, 2)
    stiffer = float(longer**-4.0)
    tilt, frame, bevel = (
        _DRAWN * size * rng.standard_normal(2)
        for size in (belief.tilt, belief.frame, belief.bevel)
    )
    return _Truth(
        replace(
            needle,
            tissue_stiffness=needle.tissue_stiffness * stiffer,
            layer_stiffnesses=tuple(k * stiffer for k in needle.layer_stiffnesses),
        ),
        replace(
            steering,
            skin_stiffness=float(steering.skin_stiffness * skin * stiffer),
            bevel_load=(hypot(*bevel),),
            path_noise=belief.path_noise,
            path_noise_length=belief.path_noise_length,
        ),
        (float(tilt[0]), float(tilt[1])),
        float(np.arctan2(*bevel)),
        frame,
        seed,
    )


def _target(text: str) -> FloatArray:
    try:
        found = [float(word) for word in text.split(',')]
    except ValueError:
        found = []
    if len(found) != 3 or not all(map(isfinite, found)):
        raise ParameterError(f'--target takes X,Y,Z in m, got {text!r}')
    return np.array(found)


def _run(options: argparse.Namespace) -> int:
    """Steer, write the picture, and print where both needles end."""
    if options.output is not None:
        if options.output.suffix != '.png':
            raise ParameterError(f'{options.output}: the picture must be .png')
        check_file(options.output)
    target = _target(options.target)
    needle, steering = made(options.needle, options.set)
    given = {**asdict(SteeringBelief()), **constants(options.belief)}
    belief: SteeringBelief = from_values(SteeringBelief, given)
    if not 0.0 < options.step <= target[1]:
        raise ParameterError(
            f'--step must be in (0, {target[1]:g}] m, the depth of the target, got '
            f'{options.step!r} m'
        )
    depths = np.linspace(0.0, target[1], max(1, round(target[1] / options.step)) + 1)
    model = SteeringModel(needle, steering, depths, belief)
    controller = SteeringController(model, target[[0, 2]], options.limit)
    truth = _drawn(needle, steering, belief, options.seed)
    ours, warnings = truth.start(), list[str]()
    rng = np.random.default_rng([options.seed, 1])
    guide, way, shapes = (0.0, 0.0), 0.0, []
    for k, depth in enumerate(depths.tolist()):
        if k:
            ours.move(depth=depth, guide=guide)
            shapes.append(np.insert(ours.shape.deflections, 1, ours.shape.depths, axis=1))
        to = controller.next(truth.seen(ours) + belief.noise * rng.standard_normal(2))
        way += hypot(to[0] - guide[0], to[1] - guide[1])
        guide = to
        if controller.warning and not warnings and k < len(depths) - 1:
            warnings.append(f'at a depth of {1e3 * depth:.4g} mm: {controller.warning}')
    alone = truth.start()
    alone.move(depth=float(target[1]))
    there = controller.expected()
    found: dict[str, Any] = {
        'target [m]': target[[0, 2]].tolist(),
        'tip [m]': truth.seen(ours).tolist(),
        'tip open loop [m]': truth.seen(alone).tolist(),
        'expected tip [m]': there.mean.tolist(),
        'its interval of 95 % [m]': [_NORMAL * sqrt(there.covariance[k, k]) for k in range(2)],
        'miss [m]': float(np.hypot(*(truth.seen(ours) - target[[0, 2]]))),
        'miss open loop [m]': float(np.hypot(*(truth.seen(alone) - target[[0, 2]]))),
        'way of the guide [m]': way,
        'bending length over the believed one': float(controller.weights @ model.lengths),
        'warnings': warnings,
    }
    for words in warnings:
        sys.stderr.write(f'warning: {words}\n')
    if options.output is not None:
        at = np.linspace(0, len(shapes) - 1, min(_SHOWN, len(shapes))).round().astype(int)
        path = np.insert(ours.path.deflections, 1, ours.path.depths, axis=1)
        beside = np.insert(alone.shape.deflections, 1, alone.shape.depths, axis=1)
        # In the frame of the needle: the sensor's is turned against it.
        mark = target - np.array([truth.frame[0], 0.0, truth.frame[1]]) * target[1]
        drawn = draw_needle([shapes[k] for k in at.tolist()], path, mark, beside)
        write_whole(options.output, png(drawn))
    if options.json:
        sys.stdout.write(f'{json.dumps(found, indent=2)}\n')
        return 0
    rows = [
        (name, f'{1e3 * x:.3f}', f'{1e3 * z:.3f}', '' if miss is None else f'{1e3 * miss:.3f}')
        for name, (x, z), miss in (
            ('target', found['target [m]'], None),
            ('tip', found['tip [m]'], found['miss [m]']),
            ('as it was expected', found['expected tip [m]'], None),
            ('± (95 %)', found['its interval of 95 % [m]'], None),
            ('open loop', found['tip open loop [m]'], found['miss open loop [m]']),
        )
    ]
    sys.stdout.write(
        f'{options.needle}, seed {options.seed}: {len(depths) - 1} steps to '
        f'{1e3 * target[1]:g} mm, the guide moved by {1e3 * way:.1f} mm in all\n\n'
        f'{table(rows, ("", "x [mm]", "z [mm]", "miss [mm]"))}\n'
    )
    if options.output is not None:
        sys.stdout.write(f'wrote {options.output}\n')
    return 0


COMMAND = Command(_add_arguments, _run, signed=('--target',))
