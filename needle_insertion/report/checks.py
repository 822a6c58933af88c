"""Checks with a verdict, as a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from needle_insertion.report.text import table

#: Heads of the rows of `Check.row`.
CHECK_HEADS: Final = ('what', 'true or wanted', 'found', 'verdict')


@dataclass(frozen=True, slots=True)
class Check:
    """
    One line of a result: what was wanted, what was found, and whether that is good enough.

    Attributes
    ----------
    what : str
        Quantity that was checked.
    wanted, found : str
        With units.
    passed : bool
        The verdict.

    """

    what: str
    wanted: str
    found: str
    passed: bool

    def row(self) -> tuple[str, str, str, str]:
        """Return the cells of a table, the verdict as a word."""
        return self.what, self.wanted, self.found, 'pass' if self.passed else 'FAIL'


def check_table(checks: Sequence[Check]) -> str:
    """
    Return checks as aligned text.

    Parameters
    ----------
    checks : sequence of Check
        One for each row.

    Returns
    -------
    str
        Lines without a final newline.

    """
    return table([check.row() for check in checks], CHECK_HEADS)
