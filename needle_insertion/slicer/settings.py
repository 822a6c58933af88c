# SPDX-License-Identifier: Apache-2.0
"""Settings of the connection and of targets, as parameters."""

from dataclasses import dataclass
from ipaddress import AddressValueError, IPv4Address

from needle_ros.errors import ParameterError
from needle_ros.settings import check_constants, choice, constant, text


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSettings:
    """Role and address of the connection, and the limit of targets."""

    role: str = choice('server', ('server', 'client'), 'the server waits, the client connects')
    host: str = text(
        '127.0.0.1', 'IPv4 address: as server, address of this machine to listen on (0.0.0.0: all '
        'addresses); as client, address of the peer',
    )  # fmt: skip
    port: int = constant(18944, '1', 'TCP port', low=1.0, high=65535.0, whole=True)
    reach: float = constant(
        0.3, 'm', 'largest accepted distance of a target from the entry point', open_low=True
    )

    def __post_init__(self) -> None:
        check_constants(self)
        try:
            # A name lookup can block.
            IPv4Address(self.host)
        except AddressValueError as error:
            raise ParameterError(
                f'host must be an IPv4 address such as 127.0.0.1, got {self.host!r}'
            ) from error
        object.__setattr__(self, 'port', int(self.port))
