# SPDX-License-Identifier: Apache-2.0
"""Pictures of pages, and tables as files."""

from __future__ import annotations

import base64
from collections.abc import Sequence
import csv
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO, StringIO
from typing import TYPE_CHECKING

from needle_dynamics.arrays import FloatArray

if TYPE_CHECKING:
    # Takes half a second to import; only pictures need it.
    from matplotlib.figure import Figure


def png(figure: Figure) -> bytes:
    """Return a figure as PNG; equal figures give equal bytes."""
    buffer = BytesIO()
    figure.savefig(buffer, format='png', dpi=120)
    return buffer.getvalue()


def csv_table(heads: Sequence[str], rows: FloatArray) -> bytes:
    """Return rows of numbers, shape (n, columns), as a CSV file."""
    text = StringIO(newline='')
    writer = csv.writer(text)
    writer.writerow(heads)
    writer.writerows(rows.tolist())
    return text.getvalue().encode()


@dataclass(frozen=True, eq=False)
class Picture:
    """Figure with caption."""

    #: File name of the PNG next to the page, without extension.
    name: str
    caption: str
    figure: Figure
    description: str = ''  #: alternative text for screen readers; default: the caption

    @cached_property
    def image(self) -> bytes:
        return png(self.figure)

    @property
    def source(self) -> str:
        """PNG as a data URL."""
        return f'data:image/png;base64,{base64.b64encode(self.image).decode("ascii")}'

    @property
    def width(self) -> int:
        return int.from_bytes(self.image[16:20], 'big')

    @property
    def height(self) -> int:
        return int.from_bytes(self.image[20:24], 'big')
