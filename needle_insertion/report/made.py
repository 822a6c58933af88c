"""What every page says of itself: version, command and date."""

from __future__ import annotations

from contextvars import ContextVar
from datetime import datetime, timezone
from importlib.metadata import version
import os
import time
from typing import Final

#: The command line that is being run, as it was typed; `needle_insertion.cli` sets it.
COMMAND: Final[ContextVar[str]] = ContextVar('COMMAND', default='')


def made() -> str:
    """
    Say with what, how and when a page was made.

    Returns
    -------
    str
        One line. With SOURCE_DATE_EPOCH in the environment the date is that, so that the same
        content gives the same bytes.

    """
    at = float(os.environ.get('SOURCE_DATE_EPOCH', time.time()))
    date = datetime.fromtimestamp(at, timezone.utc).strftime('%Y-%m-%d %H:%M UTC')
    return ', '.join(
        filter(None, (f'needle_insertion {version("needle_insertion")}', COMMAND.get(), date))
    )
