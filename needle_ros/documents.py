"""YAML from elsewhere: metadata of recordings, recorded parameters, parameter files."""

from __future__ import annotations

from typing import Any, Final

from needle_ros.errors import NeedleError
import yaml

#: Largest document [characters], and deepest nesting.
LARGEST: Final = 2**20
_DEEPEST: Final = 32

#: That of LibYAML is ten times as fast; it is not everywhere.
_LOADER: Final = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)


class DocumentError(NeedleError, ValueError):
    """A text is not YAML, or more than is read of YAML from elsewhere."""


def read_document(text: str) -> Any:
    """
    Read a YAML document that somebody else has written.

    Anchors are not needed there, and a few of them can stand for more than the memory holds.

    Parameters
    ----------
    text : str
        The text.

    Returns
    -------
    object
        What it says.

    Raises
    ------
    DocumentError
        If it is not YAML, has more than 2^20 characters, an alias, or more than 32 levels.

    """
    if len(text) > LARGEST:
        raise DocumentError(f'has {len(text)} characters, at most {LARGEST} are read')
    depth = 0
    try:
        for event in yaml.parse(text, Loader=_LOADER):
            if isinstance(event, yaml.AliasEvent):
                raise DocumentError(f'refers to &{event.anchor}; aliases are not read')
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > _DEEPEST:
                raise DocumentError(f'is nested deeper than {_DEEPEST} levels')
        return yaml.load(text, Loader=_LOADER)  # noqa: S506
    except DocumentError:
        raise
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        what = ' '.join(str(error).split())
        raise DocumentError(f'is not YAML: {what}') from error
