# SPDX-License-Identifier: Apache-2.0
"""`needle watch`: show a live insertion or a recorded bag on a page in a browser."""

from __future__ import annotations

import argparse
import asyncio
from contextlib import suppress
from functools import partial
from pathlib import Path
import sys
from typing import TYPE_CHECKING

from needle_controller.steering.insertion_plan import Plan, read_plan
from needle_insertion.commands.common import add_flag, add_quantity, add_time, print_each
from needle_insertion.watch import HOST, PORT
from needle_ros.errors import ParameterError
from needle_ros.process import ENDINGS
from needle_ros.settings import checked

if TYPE_CHECKING:
    # Takes long to import.
    from needle_insertion.watch.server import Server


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        'Show needle, forces, limits and node messages on a page in a browser: live, from a bag, '
        'or from two bags in comparison.'
    )
    parser.add_argument(
        'bag', type=Path, nargs='?', metavar='BAG', help='recording to show (default: live)'
    )
    parser.add_argument(
        'other', type=Path, nargs='?', metavar='OTHER', help='recording to compare with BAG'
    )
    parser.add_argument(
        '--plan',
        type=Path,
        metavar='PLAN.yaml',
        help='plan (needle plan -o) whose path and free space are drawn',
    )
    parser.add_argument(
        '--anatomy',
        type=Path,
        nargs='+',
        default=[],
        metavar='SEGMENTATION',
        help='segmentation of the plan, shown in 3D; needs --plan and --labels',
    )
    parser.add_argument('--labels', type=Path, metavar='LABELS.yaml', help='role of each label')
    shift = 'time added to those of OTHER (default: both start to move at the same time)'
    add_quantity(parser, '--shift', 's', shift)
    add_time(parser)
    add_flag(parser, '--control', 'buttons: target, pause, retract, stop (default: view only)')
    parser.add_argument(
        '--host',
        default=HOST,
        metavar='ADDRESS',
        help=f'address to listen on; any address except {HOST} admits viewers from other '
        'machines, and excludes --control',
    )
    parser.add_argument(
        '--port', type=int, default=PORT, help=f'port, 0 for a free one (default {PORT})'
    )


def run(options: argparse.Namespace) -> int:
    if options.bag is not None and options.control:
        raise ParameterError('--control needs a live insertion: omit --control or the BAG')
    if options.shift is not None and options.other is None:
        raise ParameterError('--shift needs two recordings: add OTHER, or omit --shift')
    if options.shift is not None:
        checked('--shift', options.shift, 's')
    given = bool(options.anatomy), options.labels is not None
    if any(given) and not (all(given) and options.plan is not None):
        raise ParameterError('--anatomy needs --plan and --labels, and --labels needs --anatomy')
    plan = None if options.plan is None else read_plan(options.plan)
    # A signal before the page is served, or a second signal at the end, also ends the command.
    with suppress(KeyboardInterrupt):
        asyncio.run((_live if options.bag is None else _recorded)(options, plan))
    return 0


async def _recorded(options: argparse.Namespace, plan: Plan | None) -> None:
    from needle_insertion.watch.live import RecordedReader
    from needle_insertion.watch.recorded import compare, ShownRecording
    from needle_insertion.watch.server import Server

    recording = ShownRecording(options.bag, options.time)
    print_each('warning', recording.losses)
    comparison = None
    if options.other is not None:
        other = ShownRecording(options.other, options.time)
        print_each('warning', other.losses)
        comparison = compare(recording, other, options.shift)
    readers = partial(RecordedReader, recording, comparison, plan)
    await _serve(Server(readers, options.host, options.port, anatomy=_anatomy(options, plan)))


async def _live(options: argparse.Namespace, plan: Plan | None) -> None:
    from needle_insertion.watch.live import Live, LiveReader
    from needle_insertion.watch.server import Server
    from needle_insertion.watch.watch_node import watching

    with watching(control=options.control) as (view, poll, control):
        live = Live(view, poll, control=options.control, plan=plan)
        server = Server(
            lambda: LiveReader(live), options.host, options.port, control, _anatomy(options, plan)
        )
        making = asyncio.create_task(live.run())
        try:
            await _serve(server, making)
        finally:
            making.cancel()
            with suppress(asyncio.CancelledError):
                await making


def _anatomy(options: argparse.Namespace, plan: Plan | None) -> str:
    """Return the anatomy for the page as JSON."""
    if plan is None or not options.anatomy:
        return 'null'
    # Imported here: readers of images are optional.
    from needle_insertion.report.anatomy_view import AnatomyView
    from needle_planning.labels import read_anatomy

    return AnatomyView('', plan, read_anatomy(options.anatomy, options.labels)).data


async def _serve(server: Server, making: asyncio.Task[None] | None = None) -> None:
    """Serve the page until a signal arrives; raise the error of the frame loop if it ends."""
    loop, ending = asyncio.get_running_loop(), asyncio.Event()
    for one in ENDINGS:
        loop.add_signal_handler(one, ending.set)
    await server.start()
    try:
        for line in server.words:
            sys.stdout.write(f'{line}\n')
        sys.stdout.flush()
        ended = asyncio.create_task(ending.wait())
        await asyncio.wait({ended, *filter(None, [making])}, return_when=asyncio.FIRST_COMPLETED)
        if not ended.done() and making is not None:
            making.result()
    finally:
        await server.end()
