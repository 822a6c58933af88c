# SPDX-License-Identifier: Apache-2.0
"""Recordings: force and motion of one experiment, as arrays on one time base."""

from collections.abc import Mapping
from typing import Final, TypeAlias

TIMES: Final = ('header', 'receive')  #: stamps: of messages or their receipt

Roles: TypeAlias = Mapping[str, str]  #: columns of a table by role
