"""What the inputs steer and the tip deflection shows, at operating points and as a map."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from itertools import product
import json
from pathlib import Path
import sys
from typing import Any

from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from needle_dynamics import (
    FORMULATIONS,
    NeedleModel,
    NeedleParameters,
    ParameterError,
    PRESETS,
)
from needle_dynamics.analysis import (
    Analysis,
    analyze,
    controllability_map,
    ControllabilityMap,
    linearize,
    LinearSystem,
    operating_point,
    SLIDING,
    Structure,
)
from needle_insertion.commands.options import constants
from needle_insertion.report.page import Picture, png, table, write_whole
from needle_insertion.report.section import Grid, Section
import numpy as np
from tqdm import tqdm

#: Grid of the map: depths from this part of the needle on, and points each way.
SHALLOWEST, DEPTHS, DEFLECTIONS = 0.05, 41, 31

#: Largest tip deflection of the map if none is given [m].
LARGEST_DEFLECTION = 2e-3

_MAPPED = ('rank', 'distance', 'observed_rank', 'observed_margin', 'output_gain')

#: Operating points of `section`: depths [m], tip deflections [m], speed [m/s].
_POINTS = (0.02, 0.1, 0.2), (0.0, 5e-4), 5e-3

_PANELS = (
    ('distance', 'distance from losing state controllability'),
    ('output_gain', 'tip deflection per base travel'),
    ('observed_margin', 'distance from seeing less of the state'),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
    Add the options of `needle analyze`.

    Parameters
    ----------
    parser : ArgumentParser
        Parser of the subcommand.

    """
    parser.add_argument('--preset', choices=tuple(PRESETS), default='phantom')
    parser.add_argument('--formulation', choices=FORMULATIONS, default='complete')
    parser.add_argument('--modes', type=int, default=2, metavar='N', help='shape modes')
    parser.add_argument(
        '--set',
        action='append',
        default=[],
        metavar='NAME=VALUE',
        help='any other constant of the preset, SI units; may be repeated',
    )
    points = parser.add_argument_group(
        'operating points', 'every combination of the values given; SI units'
    )
    for name, unit, default, text in (
        ('depth', 'm', [0.1], 'inserted lengths (default 0.1)'),
        ('tip-deflection', 'm', [0.0, 5e-4], 'deflections of the tip (default 0 5e-4)'),
        ('speed', 'm/s', [5e-3], 'insertion speeds, negative out of the tissue (default 5e-3)'),
    ):
        points.add_argument(
            f'--{name}', type=float, nargs='+', default=default, metavar=unit, help=text
        )
    points.add_argument(
        '--force', type=float, default=0.0, metavar='N', help='insertion force (default 0)'
    )
    points.add_argument(
        '--sliding',
        choices=tuple(SLIDING),
        help='branch of dry friction at speed 0, where it has no derivative',
    )
    parser.add_argument('--json', action='store_true', help='print JSON instead of a table')
    parser.add_argument(
        '--map',
        action='store_true',
        help='also map depth and deflection, up to the largest deflection given',
    )
    parser.add_argument('-o', '--output', type=Path, metavar='DIR', help='folder for the map')


def run(options: argparse.Namespace) -> int:
    """
    Analyze the operating points and print what was found.

    Parameters
    ----------
    options : Namespace
        As declared by `add_arguments`.

    Returns
    -------
    int
        0.

    Raises
    ------
    NeedleError
        If an option is not valid.

    """
    if options.map and (options.output is None or len(options.speed) > 1):
        raise ParameterError('--map needs a folder, -o DIR, and a single --speed')
    if options.output is not None and not options.map:
        raise ParameterError('-o DIR is the folder of the map: it needs --map')
    changes = constants(options.set)
    for name in ('formulation', 'modes'):
        if name in changes:
            raise ParameterError(f'{name} is given by --{name}, not by --set')
    parameters = NeedleParameters.preset(
        options.preset,
        **{
            'formulation': options.formulation,
            'modes': options.modes,
            **changes,
        },
    )
    model = NeedleModel(parameters)
    points: list[tuple[float, ...]] = list(
        product(options.depth, options.tip_deflection, options.speed)
    )
    systems = [
        linearize(model, operating_point(model, *point), options.force, sliding=options.sliding)
        for point in points
    ]
    results = [analyze(system) for system in systems]
    files = _write_map(parameters, options) if options.map else []
    if options.json:
        found = {
            'preset': options.preset,
            'parameters': asdict(parameters),
            'unit': 'SI',
            'points': [
                _as_json(*entry, options.force)
                for entry in zip(points, systems, results, strict=True)
            ],
            'files': [str(path) for path in files],
        }
        sys.stdout.write(f'{json.dumps(found, indent=2)}\n')
    else:
        sys.stdout.write(f'{_as_table(points, results)}\n')
        for path in files:
            sys.stdout.write(f'wrote {path}\n')
    return 0


def section() -> Section:
    """
    Return controllability and observability of the paper's needle for the page of results.

    Returns
    -------
    Section
        Plain data.

    """
    parameters = NeedleParameters.preset('paper_si')
    model = NeedleModel(parameters)
    depths, deflections, speed = _POINTS
    points: list[tuple[float, ...]] = [(s, w, speed) for w in deflections for s in depths]
    results = [analyze(linearize(model, operating_point(model, *point))) for point in points]
    straight, bent = results[: len(depths)], results[len(depths) :]
    figure = _figure(parameters, _map(parameters, LARGEST_DEFLECTION, speed), speed)
    return Section(
        title='Controllability and observability',
        paragraphs=(
            (
                'Linearized about a straight needle, f_y and tau steer '
                f'{straight[0].state.rank} of {straight[0].state.order} states and the tip shows '
                f'{straight[0].observed.rank}; with a deflection of {1e3 * deflections[-1]:g} mm '
                f'they steer {bent[0].state.rank} and it shows {bent[0].observed.rank}. Ranks are '
                'taken in natural units: in SI units the columns of [B, AB, ...] span more '
                'decades than doubles have digits. The margin is the change of the pair that '
                'takes away a rank.'
            ),
        ),
        tables=(
            Grid(
                caption='States steered by f_y and tau, and seen in the tip deflection '
                '(0.3 N s/m, complete equations)',
                heads=_HEADS,
                rows=tuple(_rows(points, results)),
            ),
        ),
        pictures=(
            Picture(
                'controllability',
                'How far the linearized needle is from losing controllability and observability, '
                'and how far the base moves the tip, by inserted length and deflection.',
                figure,
            ),
        ),
    )


_HEADS = (
    'depth, tip, speed',
    *('steered', 'not steered', 'margin', 'next to lose'),
    *('seen', 'not seen', 'margin', 'next to lose'),
    'tip / base travel',
)


def _as_table(points: list[tuple[float, ...]], results: list[Analysis]) -> str:
    return table(_rows(points, results), _HEADS)


def _rows(points: list[tuple[float, ...]], results: list[Analysis]) -> list[tuple[str, ...]]:
    return [
        (
            f'{1e2 * depth:g} cm, {1e3 * deflection:g} mm, {1e3 * speed:g} mm/s',
            *_cells(result.state),
            *_cells(result.observed),
            f'{result.output_gain:.2g}' if result.output_controllable else 'not steered',
        )
        for (depth, deflection, speed), result in zip(points, results, strict=True)
    ]


def _cells(found: Structure) -> tuple[str, ...]:
    return f'{found.rank}/{found.order}', found.loss, f'{found.margin:.1e}', found.weakest


def _as_json(
    point: tuple[float, ...], system: LinearSystem, result: Analysis, force: float
) -> dict[str, Any]:
    return {
        **dict(zip(('depth', 'tip_deflection', 'speed'), point, strict=True)),
        'force': force,
        'states': system.names,
        'inputs': ('f_y', 'tau'),
        **{name: getattr(system, name).tolist() for name in ('A', 'B', 'C', 'D', 'drift')},
        'natural_frequencies': system.frequencies.tolist(),
        'controllability': _structure(result.state),
        'observability': _structure(result.observed),
        'output_controllability': {
            'controllable': result.output_controllable,
            'gain': result.output_gain,
        },
    }


def _structure(found: Structure) -> dict[str, Any]:
    return {
        'order': found.order,
        'rank': found.rank,
        'deficiency': found.deficiency,
        'lost': found.lost,
        'combined': found.combined,
        'loss': found.loss,
        'distance': found.distance,
        'margin': found.margin,
        'weakest': found.weakest,
        'eigenvalues': [[value.real, value.imag] for value in found.eigenvalues.tolist()],
        'distances': found.distances.tolist(),
    }


def _write_map(parameters: NeedleParameters, options: argparse.Namespace) -> list[Path]:
    """Write the map as a table and a picture."""
    try:
        options.output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ParameterError(f'{options.output} cannot be written: {error.strerror}') from error
    whole = _map(
        parameters,
        max(abs(value) for value in options.tip_deflection),
        options.speed[0],
        options.sliding,
        options.force,
    )
    depths, deflections = np.meshgrid(whole.depths, whole.deflections, indexing='ij')
    columns = (depths, deflections, *(getattr(whole, name) for name in _MAPPED))
    lines = [','.join(('depth_m', 'tip_deflection_m', *_MAPPED))]
    lines += [
        ','.join(f'{value:.6g}' for value in line)
        for line in zip(*(column.flat for column in columns), strict=True)
    ]
    contents = {
        'controllability.csv': '\n'.join([*lines, '']).encode(),
        'controllability.png': png(_figure(parameters, whole, options.speed[0])),
    }
    for name, content in contents.items():
        write_whole(options.output / name, content)
    return [options.output / name for name in contents]


def _map(
    parameters: NeedleParameters,
    largest: float,
    speed: float,
    sliding: str | None = None,
    force: float = 0.0,
) -> ControllabilityMap:
    """Map inserted lengths and deflections up to the largest [m]."""
    length = parameters.length
    rows = [
        controllability_map(
            parameters,
            [depth],
            np.linspace(0.0, largest or LARGEST_DEFLECTION, DEFLECTIONS),
            speed,
            sliding,
            force,
        )
        for depth in tqdm(
            np.linspace(max(SHALLOWEST * length, parameters.minimum_depth), length, DEPTHS),
            desc='depths',
            disable=None,
            leave=False,
        )
    ]
    return ControllabilityMap(
        depths=np.concatenate([row.depths for row in rows]),
        deflections=rows[0].deflections,
        **{name: np.concatenate([getattr(row, name) for row in rows]) for name in _MAPPED},
    )


def _figure(parameters: NeedleParameters, found: ControllabilityMap, speed: float) -> Figure:
    figure = Figure(figsize=(13.0, 4.6), layout='constrained')
    order = 2 * (2 + parameters.modes)
    lost = found.rank < order
    for axes, (name, title) in zip(figure.subplots(1, 3, sharey=True), _PANELS, strict=True):
        shown = np.ma.masked_array(getattr(found, name), lost).T
        axes.set_facecolor('0.75')
        mesh = axes.pcolormesh(
            1e2 * found.depths,
            1e3 * found.deflections,
            shown,
            norm=LogNorm() if shown.count() else None,
            shading='nearest',
        )
        figure.colorbar(mesh, ax=axes, location='bottom')
        axes.set(title=title, xlabel='inserted length [cm]')
        axes.title.set_fontsize('medium')
    figure.axes[0].set_ylabel('tip deflection [mm]')
    figure.suptitle(
        f'{parameters.formulation}, {parameters.modes} modes, {1e3 * speed:g} mm/s; '
        'dimensionless; gray: the inputs do not move all of the state'
    )
    return figure
