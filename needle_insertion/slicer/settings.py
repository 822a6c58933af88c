"""Where the peer is, how the image lies, and which targets make sense, as parameters."""

from __future__ import annotations

from dataclasses import dataclass, field
from ipaddress import AddressValueError, IPv4Address
from typing import Final

from needle_ros.errors import ParameterError
from needle_ros.settings import check_constants, constant

#: Who waits for whom.
ROLES: Final = ('server', 'client')


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSettings:
    """Where the peer is, and who connects."""

    role: str = field(
        default=ROLES[0],
        metadata={'description': f'one of {", ".join(ROLES)}: whether the peer connects, or we'},
    )
    host: str = field(
        default='127.0.0.1',
        metadata={
            'description': 'IPv4 address: as server, of this machine, on which to listen '
            '(0.0.0.0: all of them); as client, that of the peer'
        },
    )
    port: int = constant(18944, '1', 'TCP port', low=1.0, high=65535.0)

    def __post_init__(self) -> None:
        if self.role not in ROLES:
            raise ParameterError(f'role must be one of {", ".join(ROLES)}, got {self.role!r}')
        try:
            # Looking a name up could block.
            IPv4Address(self.host)
        except AddressValueError as error:
            raise ParameterError(
                f'host must be an IPv4 address such as 127.0.0.1, got {self.host!r}'
            ) from error
        check_constants(self)
        if self.port != int(self.port):
            raise ParameterError(f'port must be a whole number, got {self.port!r}')
        object.__setattr__(self, 'port', int(self.port))


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetSettings:
    """Which targets make sense."""

    reach: float = constant(
        0.3, 'm', 'farthest target from the entry point that is passed on', open_low=True
    )

    def __post_init__(self) -> None:
        check_constants(self)
