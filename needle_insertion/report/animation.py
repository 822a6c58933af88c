# SPDX-License-Identifier: Apache-2.0
"""Interactive animation of a needle for report pages."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
import json
from pathlib import Path
from typing import Any, Final

from markupsafe import Markup
from needle_insertion.report.insertion import evenly

#: Scripts: drawing (also used by `needle watch`), and player.
_SCRIPTS: Final = ('needle.js', 'animation.js')

_POINTS: Final = 40  #: largest number of points of a needle

#: Keys of a frame that are drawn.
_DRAWN: Final = ('time', 'needle', 'shape', 'target', 'expected', 'tip', 'depth')


@dataclass(frozen=True, eq=False)
class Animation:
    """Animation of a needle from frames."""

    caption: str
    scene: Mapping[str, Any]  #: from `needle_insertion.watch.scene.scene`
    #: Frames of `needle_insertion.watch.view.View.frame`, each with a needle.
    frames: Sequence[Mapping[str, Any]]

    @property
    def data(self) -> Markup:
        """JSON data of the script, escaped so that it cannot close its HTML element."""
        frames = [{key: frame[key] for key in _DRAWN} for frame in self.frames]
        for frame in frames:
            frame['needle'] = [
                [round(value, 5) for value in evenly(column, min(len(column), _POINTS))]
                for column in frame['needle']
            ]
        paths = [frame['path'] for frame in self.frames if frame['path']]
        # The last cut path contains all earlier paths.
        path = paths[-1] if paths else [[], [], []]
        content = {'scene': self.scene, 'frames': frames, 'path': path}
        text = json.dumps(content, separators=(',', ':'), allow_nan=False)
        return Markup(text.replace('<', r'\u003c'))  # noqa: S704

    @property
    def script(self) -> Markup:
        folder = Path(__file__).with_name('templates')
        parts = [(folder / name).read_text(encoding='utf-8') for name in _SCRIPTS]
        # Trusted: the scripts are part of this package.
        return Markup('\n'.join(parts))  # noqa: S704

    @property
    def digest(self) -> str:
        """SHA-256 source expression of the script for the content security policy."""
        made = sha256(self.script.encode()).digest()
        return f'sha256-{base64.b64encode(made).decode("ascii")}'
