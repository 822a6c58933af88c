# SPDX-License-Identifier: Apache-2.0
"""Files and documents: atomic writing, and safe reading of YAML from external files."""

from collections import Counter
from contextlib import suppress
import os
from pathlib import Path
import re
from typing import Any, Final

from needle_ros.errors import NeedleError, ParameterError
import yaml

LARGEST: Final = 2**20  #: Maximum document length [characters].
_DEEPEST: Final = 32  #: Maximum nesting depth.
_LONGEST_NUMBER: Final = 1000  #: Maximum length of a number, whose time is quadratic [characters].
_NUMBER: Final = re.compile(r'[-+]?[0-9][0-9a-fA-FxX_:.]*', re.ASCII)


def write_whole(path: Path | str, content: bytes) -> None:
    """Write a file atomically: a reader sees the old or the new content, never a part."""
    # The target of a link is written, and not replaced by another file.
    path = Path(os.path.realpath(path)) if Path(path).is_symlink() else Path(path)
    if not path.name or path.is_dir() or path.is_char_device() or path.is_block_device():
        raise ParameterError(f'{path} cannot be written: it is not the name of a file')
    draft = path.with_name(f'{path.name}.{os.getpid()}.tmp')
    try:
        draft.write_bytes(content)
        draft.replace(path)
    except OSError as error:
        with suppress(OSError):
            draft.unlink()
        raise ParameterError(f'{path} cannot be written: {error.strerror}') from error


class _Loader(getattr(yaml, 'CSafeLoader', yaml.SafeLoader)):  # type: ignore[misc]
    """The loader of LibYAML, ten times as fast but not always installed, with more numbers."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        found: dict[Any, Any] = super().construct_mapping(node, deep=deep)
        if len(found) < len(node.value):
            # YAML requires unique keys; the parser would keep the last one.
            keys = Counter(self.construct_object(key, deep=deep) for key, _ in node.value)
            ((twice, _),) = keys.most_common(1)
            line = node.start_mark.line + 1
            raise DocumentError(f'has the key {twice!r} twice in the mapping of line {line}')
        return found


# Numbers such as 4e-5 are text in YAML 1.1; they are numbers in YAML 1.2.
_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:float',
    re.compile(r'[-+]?(?:\d+\.?\d*|\.\d+)[eE][-+]?\d+$', re.ASCII),
    list('-+.0123456789'),
)


class DocumentError(NeedleError, ValueError):
    """A text is not YAML, or exceeds the limits of `read_document`."""


def read_yaml(path: Path | str) -> Any:
    """Parse a YAML file as `read_document`; raise ParameterError with its name."""
    try:
        with Path(path).open(encoding='utf-8') as stream:
            return read_document(stream.read(LARGEST + 1))
    except UnicodeDecodeError as error:
        raise ParameterError(f'{path} is not text in UTF-8') from error
    except OSError as error:
        raise ParameterError(f'{path} cannot be read: {error.strerror}') from error
    except DocumentError as error:
        raise ParameterError(f'{path} {error}') from error


def read_value(text: str) -> Any:
    """Parse one value in YAML, as of a command line."""
    try:
        return read_document(text)
    except DocumentError as error:
        raise ParameterError(f'{text!r} is not a value in YAML') from error


def read_document(text: str) -> Any:
    """Parse a YAML document of an external author; aliases could expand beyond the memory."""
    if len(text) > LARGEST:
        raise DocumentError(f'has more than {LARGEST} characters')
    depth = 0
    try:
        for event in yaml.parse(text, Loader=_Loader):
            if isinstance(event, yaml.AliasEvent):
                raise DocumentError(f'refers to &{event.anchor}; aliases are not read')
            value = event.value if isinstance(event, yaml.ScalarEvent) else ''
            if len(value) > _LONGEST_NUMBER and _NUMBER.fullmatch(value):
                raise DocumentError(f'has a number of {len(value)} characters')
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > _DEEPEST:
                raise DocumentError(f'is nested deeper than {_DEEPEST} levels')
        return yaml.load(text, Loader=_Loader)  # noqa: S506
    except DocumentError:
        raise
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        what = ' '.join(str(error).split())
        raise DocumentError(f'is not YAML: {what}') from error
