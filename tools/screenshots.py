# SPDX-License-Identifier: Apache-2.0
"""
Write screenshots of every page, at the width of a desktop and of a telephone.

Run it from a clone on a machine with Chromium: ``python -m tools.screenshots``. It makes the
pages with the commands of the package, in a temporary folder; ``--pages DIR`` keeps them, and
takes those that exist. It takes some minutes, most of them for the demo and `needle reproduce`.
The first picture of the README is a copy of ``watch_1400.png``.
"""

from __future__ import annotations

import argparse
import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
import re
import subprocess
import sys
from tempfile import TemporaryDirectory
from typing import Final

from PIL import Image
from tools.browser import BROWSER, browser, Tab

ROOT: Final = Path(__file__).resolve().parents[1]
FOLDER: Final = ROOT / 'docs' / 'images' / 'pages'

#: Widths of a desktop and a telephone, and largest height of a picture [pixels].
WIDTHS: Final = (1400, 400)
HEIGHT: Final = 2600

#: Largest size of a picture [bytes].
LARGEST: Final = 200_000

#: Scales of a picture, of which the largest that fits is used; and its colors.
_SCALES: Final = (1.0, 0.8, 0.65, 0.5)
_COLORS: Final = 64

_BAGS: Final = ROOT / 'bags'
_LIVER: Final = ROOT / 'examples' / 'liver'


@dataclass(frozen=True)
class ReportPage:
    """Page of HTML that a command writes: arguments of ``needle``, with ``DIR`` or ``FILE``."""

    name: str
    command: tuple[str, ...]
    file: str


def _bags(name: str) -> tuple[str, ...]:
    return tuple(map(str, sorted(_BAGS.glob(f'{name}_*'))))


REPORTS: Final = (
    ReportPage('demo', ('demo', '-o', 'DIR'), 'report.html'),
    ReportPage(
        'friction',
        ('identify', 'friction', *_bags('friction'), '--report', 'DIR'),
        'friction.html',
    ),
    ReportPage(
        'stiffness',
        ('identify', 'stiffness', *_bags('stiffness'), '--report', 'DIR'),
        'stiffness.html',
    ),
    ReportPage('study', ('study', 'STUDY', '-o', 'DIR'), 'study.html'),
    ReportPage(
        'plan',
        (
            'plan',
            str(_LIVER / 'liver.seg.nrrd'),
            '--labels',
            str(_LIVER / 'labels.yaml'),
            '--target',
            '62mm,12mm,10mm',
            '--entry',
            '132mm,37mm,-1mm',
            '--entry-radius',
            '3mm',
            '--insertions',
            '200',
            '--page',
            'FILE',
        ),
        'plan.html',
    ),
    ReportPage('reproduce', ('reproduce', 'all', '-o', 'DIR'), 'reproduce.html'),
)

#: Study with fewer samples than the example, which takes minutes.
STUDY: Final = ROOT / 'examples' / 'studies' / 'steering.yaml'
_SAMPLES: Final = 'samples: 200'

#: Pages of the site, if it was built.
SITE: Final = ROOT / 'docs' / '_build' / 'html'
SITE_PAGES: Final = {'site': 'index.html', 'gallery': 'gallery.html'}


def needle(*words: str) -> None:
    """Run a command of the package."""
    subprocess.run([sys.executable, '-m', 'needle_insertion.cli', *words], cwd=ROOT, check=False)


@asynccontextmanager
async def watched(*bags: Path) -> AsyncIterator[str]:
    """Serve the page of recordings, and yield its address."""
    running = await asyncio.create_subprocess_exec(
        sys.executable, '-m', 'needle_insertion.cli', 'watch', *map(str, bags), '--port', '0',
        cwd=ROOT, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    try:
        assert running.stdout is not None  # noqa: S101
        line = (await running.stdout.readline()).decode()
        if not line.startswith('page: '):
            raise SystemExit('error: needle watch has not started')
        yield line.removeprefix('page: ').strip()
    finally:
        running.terminate()
        await running.wait()


async def take(tab: Tab, name: str, folder: Path) -> None:
    """Save pictures of the open page at each width."""
    for width in WIDTHS:
        await tab.size(width, 1000)
        # Drawings follow the width in the next frames.
        await asyncio.sleep(0.5)
        overflow = await tab.run(
            'document.documentElement.scrollWidth - document.documentElement.clientWidth'
        )
        if overflow:
            sys.stderr.write(f'warning: {name} is {overflow} pixels wider than {width} pixels\n')
        content = compressed(await tab.image(HEIGHT))
        path = folder / f'{name}_{width}.png'
        path.write_bytes(content)
        sys.stdout.write(f'{path.name}: {len(content) / 1e3:.0f} kB\n')


def compressed(content: bytes) -> bytes:
    """Return a PNG of few colors, at the largest scale with which it is below `LARGEST`."""
    whole = Image.open(BytesIO(content)).convert('RGB')
    for scale in _SCALES:
        size = (round(scale * whole.width), round(scale * whole.height))
        shown = whole.resize(size, Image.Resampling.LANCZOS) if scale < 1.0 else whole
        buffer = BytesIO()
        shown.quantize(_COLORS).save(buffer, 'PNG', optimize=True)
        if buffer.tell() <= LARGEST:
            break
    return buffer.getvalue()


async def pictures(folder: Path, made: Path, chosen: Sequence[str]) -> None:
    """Take pictures of reports, of `needle watch`, and of the site."""
    steered, alone = made / 'demo' / 'steered', made / 'demo' / 'guide_at_rest'
    async with browser() as tab:
        for page in REPORTS:
            if page.name in chosen:
                await tab.open((made / page.name / page.file).as_uri())
                await tab.wait("document.readyState === 'complete'", page.name)
                await take(tab, page.name, folder)
        for name, bags in {'watch': (steered,), 'compare': (steered, alone)}.items():
            if name not in chosen:
                continue
            async with watched(*bags) as address:
                await tab.size(WIDTHS[0], 1000)
                await tab.open(f'{address}#at=20')
                await tab.wait('window.needleWatch && needleWatch.drawn > 0', 'the page')
                await take(tab, name, folder)
        for name, file in SITE_PAGES.items():
            if name in chosen and (SITE / file).is_file():
                await tab.open((SITE / file).as_uri())
                await tab.wait("document.readyState === 'complete'", name)
                await take(tab, name, folder)


NAMES: Final = (*(page.name for page in REPORTS), 'watch', 'compare', *SITE_PAGES)


def main() -> None:
    """Make the pages, and take their pictures."""
    parser = argparse.ArgumentParser(description='Screenshots of every page.')
    parser.add_argument('names', nargs='*', metavar='PAGE', help=f'{", ".join(NAMES)}; all')
    parser.add_argument('--pages', type=Path, help='folder of the pages (default: temporary)')
    parser.add_argument('-o', '--output', type=Path, default=FOLDER, help=f'default {FOLDER}')
    options = parser.parse_args()
    if BROWSER is None:
        parser.error('no Chromium on this machine: install chromium')
    if unknown := set(options.names) - set(NAMES):
        parser.error(f'unknown: {", ".join(sorted(unknown))}; valid: {", ".join(NAMES)}')
    chosen = options.names or NAMES
    options.output.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as scratch:
        made: Path = (options.pages or Path(scratch)).resolve()
        for page in REPORTS:
            recorded = page.name == 'demo' and {'watch', 'compare'} & {*chosen}
            if (page.name in chosen or recorded) and not (made / page.name / page.file).is_file():
                study = Path(scratch, STUDY.name)
                study.write_text(re.sub(r'samples: \d+', _SAMPLES, STUDY.read_text('utf-8')))
                folder = made / page.name
                folder.mkdir(parents=True, exist_ok=True)
                places = {'DIR': folder, 'FILE': folder / page.file, 'STUDY': study}
                needle(*(str(places.get(word, word)) for word in page.command))
        asyncio.run(pictures(options.output, made, chosen))


if __name__ == '__main__':
    main()
