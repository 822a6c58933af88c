# SPDX-License-Identifier: Apache-2.0
"""Content of the pages of results and of the demo: sections with tables and pictures, checks."""

from dataclasses import dataclass
from typing import Final

from needle_insertion.report.content import Picture

CHECK_HEADS: Final = ('check', 'expected', 'found', 'verdict')  #: heads of the rows of `Check.row`


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """Table; the first cell of a row is its name."""

    caption: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportSection:
    """Heading with paragraphs of plain text, tables and pictures."""

    title: str
    paragraphs: tuple[str, ...]
    tables: tuple[Grid, ...] = ()
    pictures: tuple[Picture, ...] = ()


@dataclass(frozen=True, slots=True)
class Check:
    """Check of a quantity: expected and actual value with units, and verdict."""

    what: str
    wanted: str
    found: str
    passed: bool

    @property
    def row(self) -> tuple[str, str, str, str]:
        return self.what, self.wanted, self.found, 'pass' if self.passed else 'FAIL'
