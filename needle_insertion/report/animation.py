"""A needle on its way, that a reader of a page may play."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
import json
from pathlib import Path
from typing import Any, Final

from markupsafe import Markup
import numpy as np

#: The drawing, which `needle watch` has too, and what plays it.
_SCRIPTS: Final = ('needle.js', 'animation.js')

#: Most points of a needle.
_POINTS: Final = 40

#: Of a frame, what is drawn.
_DRAWN: Final = ('time', 'needle', 'shape', 'target', 'expected', 'tip', 'depth')


@dataclass(frozen=True, eq=False)
class Animation:
    """
    Frames of a needle, and the script that draws them.

    Attributes
    ----------
    caption : str
        Text below it.
    scene : mapping
        Tissue and limits, as `needle_insertion.watch.scene.scene` returns them.
    frames : sequence of mapping
        As `needle_insertion.watch.view.View.frame` returns them; each with a needle.

    """

    caption: str
    scene: Mapping[str, Any]
    frames: Sequence[Mapping[str, Any]]

    @property
    def data(self) -> Markup:
        """What the script reads, as JSON; no text in it can end its element."""
        frames = [{key: frame[key] for key in _DRAWN} for frame in self.frames]
        for frame in frames:
            frame['needle'] = _thinned(frame['needle'])
        paths = [frame['path'] for frame in self.frames if frame['path']]
        # What is cut only grows.
        path = paths[-1] if paths else [[], [], []]
        content = {'scene': self.scene, 'frames': frames, 'path': path}
        text = json.dumps(content, separators=(',', ':'), allow_nan=False)
        return Markup(text.replace('<', r'\u003c'))  # noqa: S704

    @property
    def script(self) -> Markup:
        """What draws it."""
        folder = Path(__file__).with_name('templates')
        parts = [(folder / name).read_text(encoding='utf-8') for name in _SCRIPTS]
        # Of this package.
        return Markup('\n'.join(parts))  # noqa: S704

    @property
    def digest(self) -> str:
        """By which the browser knows the script: it runs no other."""
        made = sha256(self.script.encode()).digest()
        return f'sha256-{base64.b64encode(made).decode("ascii")}'


def _thinned(line: Sequence[Sequence[float]]) -> list[list[float]]:
    """Return a line with fewer points, the first and the last among them."""
    count = len(line[0])
    chosen = np.unique(np.linspace(0, count - 1, min(count, _POINTS)).round().astype(int))
    return [[round(column[k], 5) for k in chosen.tolist()] for column in line]
