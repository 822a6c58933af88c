# SPDX-License-Identifier: Apache-2.0
"""Recordings: force and motion of one experiment, as arrays on one time base."""

from typing import Final

#: Sources of the stamps of a recording: message headers or receive times.
TIMES: Final = ('header', 'receive')
