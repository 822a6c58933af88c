"""What pages are made of, as plain data: pictures, tables and sections."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    # Takes half a second to import; tables do without.
    from matplotlib.figure import Figure


def png(figure: Figure) -> bytes:
    """
    Return a figure as a PNG.

    Parameters
    ----------
    figure : Figure
        The figure.

    Returns
    -------
    bytes
        The same bytes for the same figure.

    """
    buffer = BytesIO()
    figure.savefig(buffer, format='png', dpi=120)
    return buffer.getvalue()


@dataclass(frozen=True, eq=False)
class Picture:
    """
    A figure with its caption.

    Attributes
    ----------
    name : str
        Name of the PNG beside the page, without its ending.
    caption : str
        Text below it.
    figure : Figure
        The figure.
    description : str
        Text for readers who cannot see it; the caption if empty.

    """

    name: str
    caption: str
    figure: Figure
    description: str = ''

    @cached_property
    def image(self) -> bytes:
        """The PNG."""
        return png(self.figure)

    @property
    def source(self) -> str:
        """The PNG as a URL that holds all of it."""
        return f'data:image/png;base64,{base64.b64encode(self.image).decode("ascii")}'

    @property
    def width(self) -> int:
        """Width [pixels]."""
        return int.from_bytes(self.image[16:20], 'big')

    @property
    def height(self) -> int:
        """Height [pixels]."""
        return int.from_bytes(self.image[20:24], 'big')


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """
    A table.

    Attributes
    ----------
    caption : str
        What it shows.
    heads : tuple of str
        Column heads.
    rows : tuple of tuple of str
        Cells; the first of a row names it.

    """

    caption: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """
    A heading and what stands below it.

    Attributes
    ----------
    title : str
        The heading.
    paragraphs : tuple of str
        Plain text.
    tables : tuple of Grid
        Tables.
    pictures : tuple of Picture
        Pictures with their captions.

    """

    title: str
    paragraphs: tuple[str, ...]
    tables: tuple[Grid, ...] = ()
    pictures: tuple[Picture, ...] = ()
