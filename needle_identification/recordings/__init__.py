# SPDX-License-Identifier: Apache-2.0
"""Recordings: force and motion of one experiment, as arrays on one time base."""

from typing import Final

TIMES: Final = ('header', 'receive')  #: stamps: of messages or their receipt
