"""Which machines can reach what is started here."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from pathlib import Path
from typing import Final

from needle_ros.errors import ParameterError

#: Environment variable of ROS 2: how far a node looks for others.
RANGE: Final = 'ROS_AUTOMATIC_DISCOVERY_RANGE'

#: Environment variables by which Fast DDS 2 and 3 find their profile.
PROFILES: Final = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')

#: Variables that keep a node on this machine: its transport is 127.0.0.1, and there is no socket
#: that another machine could send to. The range LOCALHOST would be no wall (another machine that
#: names this one as a static peer is let in), and it brings shared memory: where a process that
#: used it was killed, the next one hears nothing for up to 3 s.
LOCAL: Final = {
    RANGE: 'SUBNET',
    **dict.fromkeys(PROFILES, str(Path(__file__).with_name('loopback.xml'))),
}

#: Environment variable of ROS 2: nodes of another domain do not see each other.
DOMAIN: Final = 'ROS_DOMAIN_ID'

#: The largest domain whose ports exist, with those of some processes.
_LARGEST_DOMAIN: Final = 232

#: Ranges that let other machines in.
OPEN: Final = ('SUBNET', 'SYSTEM_DEFAULT')


def stay_local(environment: MutableMapping[str, str]) -> None:
    """
    Keep what is started on this machine, unless the environment opens it.

    Parameters
    ----------
    environment : MutableMapping[str, str]
        Environment to change. `RANGE` set to one of `OPEN` opens it; the range OFF, a profile
        that is set, and another middleware than Fast DDS stay.

    """
    if environment.get(RANGE) in OPEN:
        return
    fast = 'fastrtps' in (environment.get('RMW_IMPLEMENTATION') or 'rmw_fastrtps_cpp')
    if fast and environment.get(RANGE) != 'OFF' and not any(map(environment.get, PROFILES)):
        environment.update(LOCAL)
    else:
        environment.setdefault(RANGE, 'LOCALHOST')


def domain_of(environment: Mapping[str, str]) -> int:
    """
    Return the domain that an environment chooses.

    Parameters
    ----------
    environment : Mapping[str, str]
        Environment.

    Returns
    -------
    int
        The domain; 0 if none is chosen.

    Raises
    ------
    ParameterError
        If it is not a number of a domain.

    """
    text = environment.get(DOMAIN) or '0'
    if not text.isascii() or not text.isdecimal() or int(text) > _LARGEST_DOMAIN:
        raise ParameterError(
            f'{DOMAIN} must be a whole number from 0 to {_LARGEST_DOMAIN}, got {text!r}'
        )
    return int(text)
