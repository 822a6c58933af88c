# SPDX-License-Identifier: Apache-2.0
"""Network range of DDS: restrict nodes to this machine unless the environment opens it."""

from collections.abc import Mapping, MutableMapping
from pathlib import Path
from socket import AF_UNIX, SOCK_DGRAM, socket
from typing import Final

from needle_ros.errors import JobError, ParameterError

RANGE: Final = 'ROS_AUTOMATIC_DISCOVERY_RANGE'  #: Environment variable of ROS 2.

#: Environment variables with the profile file of Fast DDS 2 and 3.
PROFILES: Final = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')

#: Variables that restrict a node to this machine: its transport is 127.0.0.1, without a socket
#: that another machine could reach. The range LOCALHOST does not isolate (another machine connects
#: by naming this machine as a static peer), and it enables shared memory: if a process is
#: killed while it uses shared memory, the next process receives nothing for up to 3 s.
LOCAL: Final = {
    RANGE: 'SUBNET',
    **dict.fromkeys(PROFILES, str(Path(__file__).with_name('loopback.xml'))),
}

#: Environment variables of ROS 2: credentials are used, and their folder.
SECURITY: Final = 'ROS_SECURITY_ENABLE'
KEYSTORE: Final = 'ROS_SECURITY_KEYSTORE'

#: Environment variable of ROS 2: nodes of different domains are isolated.
DOMAIN: Final = 'ROS_DOMAIN_ID'

#: Address of the claim of a domain: abstract, without a file, and the same for all users.
_CLAIM: Final = '\0needle_insertion/domain_{}'

_LARGEST_DOMAIN: Final = 232  #: Largest domain ID with valid UDP ports for several processes.
OPEN: Final = ('SUBNET', 'SYSTEM_DEFAULT')  #: Discovery ranges that include other machines.


def stay_local(environment: MutableMapping[str, str]) -> None:
    """Restrict an environment to this machine, unless `RANGE` has a value of `OPEN`."""
    if environment.get(RANGE) in OPEN:
        return
    # The range OFF, a configured Fast DDS profile, and another middleware are kept.
    fast = 'fastrtps' in (environment.get('RMW_IMPLEMENTATION') or 'rmw_fastrtps_cpp')
    if fast and environment.get(RANGE) != 'OFF' and not any(map(environment.get, PROFILES)):
        environment.update(LOCAL)
    else:
        environment.setdefault(RANGE, 'LOCALHOST')


def check_security(environment: Mapping[str, str]) -> None:
    """Raise `ParameterError` if security is requested in a way that ROS 2 ignores silently."""
    given = environment.get(SECURITY) or 'false'
    if given not in ('true', 'false'):
        raise ParameterError(f'{SECURITY} must be true or false, got {given!r}')
    if given == 'true' and not environment.get(KEYSTORE):
        raise ParameterError(
            f'{SECURITY} is true, but {KEYSTORE} names no keystore: nodes would not be protected'
        )


def domain_of(environment: Mapping[str, str]) -> int:
    """Return the domain ID of an environment, by default 0; ParameterError if invalid."""
    text = environment.get(DOMAIN) or '0'
    if not text.isascii() or not text.isdecimal() or int(text) > _LARGEST_DOMAIN:
        raise ParameterError(
            f'{DOMAIN} must be a whole number from 0 to {_LARGEST_DOMAIN}, got {text!r}'
        )
    return int(text)


def claim(domain: int) -> socket:
    """Claim a domain until the last process with this socket ends; JobError if it is claimed."""
    claimed = socket(AF_UNIX, SOCK_DGRAM)
    try:
        claimed.bind(_CLAIM.format(domain))
    except OSError as error:
        claimed.close()
        raise JobError(
            f'another session is running on domain {domain}: end it, or choose another {DOMAIN}'
        ) from error
    return claimed


def is_claimed(domain: int) -> bool:
    """Return whether a session of this machine has claimed a domain."""
    with socket(AF_UNIX, SOCK_DGRAM) as probe:
        return probe.connect_ex(_CLAIM.format(domain)) == 0
