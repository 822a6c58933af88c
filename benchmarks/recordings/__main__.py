# SPDX-License-Identifier: Apache-2.0
"""
Steering and identification on recorded insertions of a folder.

Run as ``python -m benchmarks.recordings FOLDER``; the tables are described in
`benchmarks.recordings.folder`. Prints the tables, and the last line begins with met or missed.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
import json
from pathlib import Path
import sys
import time
from typing import Any, Final

from benchmarks.measure import Bar
from benchmarks.page import conclusion, PageSection
from benchmarks.recordings import identification, replay
from benchmarks.recordings.folder import read_folder
from benchmarks.recordings.identification import identify_medium
from benchmarks.recordings.replay import figures, follow, LAWS, PLANTS, ReplaySettings, SETTINGS
from needle_identification import SteeringRecording
from needle_ros.errors import NeedleError
from needle_ros.process_pool import processes
from tqdm import tqdm

_Media = Mapping[str, Sequence[SteeringRecording]]

#: Parts of the benchmark.
PARTS: Final = ('follow', 'steering', 'identification')


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(prog='python -m benchmarks.recordings', description=__doc__)
    add = parser.add_argument
    add('folder', type=Path, help='folder with the tables')
    add('--media', nargs='+', default=[], metavar='NAME', help='only these media')
    add('--tuned', nargs='+', default=[], metavar='NAME', help='media for tuning: totals without')
    add('--most', type=int, metavar='N', help='files with a fixed guide, and with a moving one')
    add('--part', choices=PARTS, action='append', help='only this part')
    add('--law', action='append', default=[], metavar='MODULE:CLASS', help='another law')
    add('--workers', type=int, default=1, metavar='N', help='processes')
    add('-o', '--output', type=Path, metavar='FILE', help='write JSON, too')
    return parser


def main(words: Sequence[str] | None = None) -> int:
    """Run the benchmark; return 0 if no bar is missed, 1 if one is, and 2 after an error."""
    options = arguments().parse_args(words)
    try:
        return _run(options)
    except NeedleError as error:
        sys.stderr.write(f'{error}\n')
        return 2


def _run(options: argparse.Namespace) -> int:
    media, left_out = read_folder(options.folder, options.media, options.most)
    begin = time.perf_counter()
    parts, result = options.part or PARTS, dict[str, Any]()
    bars: list[Bar] = []
    with tqdm(disable=None, leave=False, unit=' stages') as progress:
        if 'follow' in parts:
            result['follow'] = _follow(media)
            _print(_following(result['follow']))
        if 'steering' in parts:
            laws = [*LAWS, *options.law]
            result['steering'] = rows = _steer(media, laws, options.tuned, progress)
            notes = (
                f'{sum(map(len, media.values()))} recordings, target on the axis. If a law stops, '
                'the needle is inserted to the end with the guide at rest. Coverage: final tips '
                'within the 95 % ellipse that is predicted before the last measurement.'
            )
            _print(replay.section(rows, notes))
            bars += _steering_bars(rows, media)
        if 'identification' in parts:
            with processes(options.workers) as pool:
                found = list(pool.map(identify_medium, media.values()))
            result['identification'] = found
            _print(identification.section(found))
            bars += _identification_bars(found)
    result['left out'] = left_out
    for why in left_out:
        _print(f'left out: {why}')
    if options.output is not None:
        options.output.write_text(json.dumps(result, indent=1), encoding='utf-8')
    _print(conclusion(bars, time.perf_counter() - begin))
    return int(any(bar.missed for bar in bars))


def _print(text: object) -> None:
    sys.stdout.write(f'{text}\n\n')
    sys.stdout.flush()


def _follow(media: _Media) -> list[dict[str, Any]]:
    """Let our law follow each recording with each of the settings."""
    rows = []
    for name, settings in SETTINGS.items():
        for medium, recordings in media.items():
            found = [follow(settings.model(one.depth), one) for one in recordings]
            rows.append(
                {
                    'settings': name,
                    'medium': medium,
                    'recordings': len(found),
                    'stopped': sum(bool(one.stopped) for one in found),
                    'coverage': sum(one.held for one in found) / sum(one.steps for one in found),
                }
            )
    return rows


def _following(rows: Sequence[Mapping[str, Any]]) -> PageSection:
    return PageSection(
        'Our law follows recorded tips and guides',
        ('settings', 'medium', 'recordings', 'declared impossible', 'coverage of the next tip'),
        [
            (
                one['settings'],
                one['medium'],
                str(one['recordings']),
                str(one['stopped']),
                f'{100.0 * one["coverage"]:.0f} %',
            )
            for one in rows
        ],
    )


def _steer(
    media: _Media, laws: Sequence[str], tuned: Sequence[str], progress: tqdm[Any]
) -> list[dict[str, Any]]:
    """Return the figures of all plants, settings, laws and media."""
    rows = []
    totals = {'all': [*media]}
    if tuned:
        totals['not tuned on'] = [name for name in media if name not in tuned]
    for plant, of_plant in PLANTS.items():
        fitted = {name: of_plant.fit(recordings) for name, recordings in media.items()}
        for name, law, settings in _runs(laws):
            progress.set_description_str(f'{plant}, {name}, {law}')
            progress.update()
            found = replay.replay(media, fitted, settings, law)
            for medium, members in {**{one: [one] for one in media}, **totals}.items():
                own = [one for one in found if one.medium in members]
                head = {'plant': plant, 'settings': name, 'law': law, 'medium': medium}
                rows.append({**head, **figures(own)})
    return rows


def _runs(laws: Sequence[str]) -> list[tuple[str, str, ReplaySettings]]:
    """Return settings and laws; the other laws of the project do not use the prior."""
    defaults = ReplaySettings()
    return [
        (name, law, settings)
        for name, settings in SETTINGS.items()
        for law in laws
        if law not in LAWS[1:] or settings.prior == defaults.prior
    ]


def _steering_bars(rows: Sequence[Mapping[str, Any]], media: _Media) -> list[Bar]:
    """Return the bars of our law with the settings of the node, against the best of all others."""
    bars = []
    for plant in PLANTS:
        own = [one for one in rows if one['plant'] == plant]
        defaults = [one for one in own if one['settings'] == next(iter(SETTINGS))]
        ours = {one['medium']: one for one in defaults if one['law'] == LAWS[0]}
        bars.append(Bar(f'stopped, {plant}', ours['all']['stopped'], 0.0))
        bars.append(Bar(f'mean, {plant}', ours['all']['mean'], 0.45, 'mm'))
        for name in media:
            others = [one for one in own if one['medium'] == name and one['law'] in LAWS[1:]]
            best = min(one['mean'] for one in others)
            case = f'{plant}, {name}'
            bars.append(Bar(f'mean over the best, {case}', ours[name]['mean'] / best, 1.1))
            # All have stopped: no prediction holds.
            held = 100.0 * (ours[name]['coverage'] or 0.0)
            bars.append(Bar(f'coverage, {case}', held, 90.0, '%', at_least=True))
            bars.append(Bar(f'coverage, {case}', held, 98.0, '%'))
    return bars


def _identification_bars(rows: Sequence[Mapping[str, Any]]) -> list[Bar]:
    apart = sum(one['overlap'] is not True for one in rows)
    frames = sum(one['frame without a warning'] for one in rows)
    bars = [
        Bar('media whose halves do not overlap', apart / len(rows), 0.1),
        Bar('frames above the prior without a warning', frames, 0.0),
    ]
    for one in rows:
        if one['coverage'] is None:
            continue
        held = 100.0 * one['coverage']
        bars.append(Bar(f'held-out coverage, {one["medium"]}', held, 90.0, '%', at_least=True))
        bars.append(Bar(f'held-out coverage, {one["medium"]}', held, 98.0, '%'))
    return bars


if __name__ == '__main__':
    sys.exit(main())
