# SPDX-License-Identifier: Apache-2.0
"""Error types; every error of the packages is a `NeedleError`."""

from typing import Final

_LONGEST: Final = 500  #: Maximum length of a log line [characters].

#: Python modules of ROS 2 except messages.
_ROS: Final = {'rclpy', 'launch', 'launch_ros', 'domain_coordinator', 'ament_index_python'}


class NeedleError(Exception):
    """Base class of all intentional errors, each with a one-line message for users."""

    def __str__(self) -> str:
        # It may quote names from a recording or an external folder.
        return shown(super().__str__())


class JobError(NeedleError):
    """A job failed with valid inputs."""


class ParameterError(NeedleError, ValueError):
    """A parameter is unknown, missing, or outside its valid range."""


class MessageError(NeedleError, ValueError):
    """Bytes are not a valid message of the expected type."""


class ShapeError(NeedleError, ValueError):
    """An array has the wrong shape."""


def shown(text: str) -> str:
    """Replace line ends by blanks, and characters that could control a terminal by ``?``."""
    if text.isprintable():
        return text
    return ''.join(one if one.isprintable() else ' ' if one.isspace() else '?' for one in text)


def printable(line: str) -> str:
    """Return a line for a log: as `shown`, and at most 500 characters."""
    return shown(f'{line[: _LONGEST - 4]} ...' if len(line) > _LONGEST else line)


def missing_extra(error: ModuleNotFoundError, what: str, extra: str) -> ParameterError:
    """Return the error of a missing module, with the extra of this package that installs it."""
    return ParameterError(
        f"{what} needs {error.name}: pip install 'needle_insertion[{extra}]', or in a clone "
        f"pip install -e '.[{extra}]'"
    )


def missing_ros(error: ModuleNotFoundError, program: str) -> str:
    """Return how to install the missing module of ROS 2; raise the error of any other module."""
    module = str(error.name).partition('.')[0]
    if module not in _ROS and not module.endswith(('_msgs', '_srvs', '_interfaces')):
        raise error
    return (
        f'{program} needs ROS 2 (no module {module}): '
        "pip install 'needle_insertion[ros]', or source the setup file of an installed ROS 2"
    )
