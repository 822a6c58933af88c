"""A section of the page of results as plain data, whatever writes it."""

from __future__ import annotations

from dataclasses import dataclass

from needle_insertion.report.picture import Picture


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
