"""Which machines can reach what is started here."""

from __future__ import annotations

from collections.abc import MutableMapping
from pathlib import Path
from typing import Final

#: Environment variable of ROS 2: how far a node looks for others.
RANGE: Final = 'ROS_AUTOMATIC_DISCOVERY_RANGE'

#: Variables that keep a node on this machine. The range alone does not: another machine that names
#: this one as a static peer would be let in. So the transports are limited, too, to shared memory
#: and 127.0.0.1; Fast DDS 2 and 3 read the profile by two names.
LOCAL: Final = {
    RANGE: 'LOCALHOST',
    **dict.fromkeys(
        ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE'),
        str(Path(__file__).with_name('loopback.xml')),
    ),
}

#: Ranges that let other machines in.
OPEN: Final = ('SUBNET', 'SYSTEM_DEFAULT')


def stay_local(environment: MutableMapping[str, str]) -> None:
    """
    Keep what is started on this machine, unless the environment opens it.

    Parameters
    ----------
    environment : MutableMapping[str, str]
        Environment to change. `RANGE` set to one of `OPEN` opens it; a profile that is set
        stays.

    """
    if environment.get(RANGE) not in OPEN:
        for name, value in LOCAL.items():
            environment.setdefault(name, value)
