# SPDX-License-Identifier: Apache-2.0
"""Version, command and date of a report page."""

from contextvars import ContextVar
from datetime import datetime, timezone
from importlib.metadata import version
import os
import time
from typing import Final

#: Command line of this process, set by `needle_insertion.cli`.
COMMAND: Final[ContextVar[str]] = ContextVar('COMMAND', default='')


def made() -> str:
    """Return version, command and date of a page, fixed by SOURCE_DATE_EPOCH, in a line."""
    at = float(os.environ.get('SOURCE_DATE_EPOCH', time.time()))
    date = datetime.fromtimestamp(at, timezone.utc).strftime('%Y-%m-%d %H:%M UTC')
    return ', '.join(
        filter(None, (f'needle_insertion {version("needle_insertion")}', COMMAND.get(), date))
    )
