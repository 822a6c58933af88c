"""Recordings: force and motion of one experiment, as arrays on one time base."""

from typing import Final

#: Stamps that a recording may use: those of the headers of its messages, or the receive times.
TIMES: Final = ('header', 'receive')
