# SPDX-License-Identifier: Apache-2.0
"""Parameters of a node: fields of checked dataclasses (`settings.py`), and parameter files."""

from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from itertools import pairwise
import re
from sys import float_info
from typing import Any, ClassVar, NamedTuple, TypeVar

from needle_ros.errors import NeedleError, ParameterError
from needle_ros.parameter_file import MARK, read_sections
from needle_ros.quantities import quantity
from needle_ros.services_node import ParameterServices
from needle_ros.settings import check_choice, constraints, from_values, unknown_name
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.lifecycle import LifecycleNode
from rclpy.parameter import Parameter
import yaml

_LARGEST = float_info.max  #: Largest finite number.
_READ_AS_BOOL = ('y', 'n')  #: Strings that rcl parses as booleans in a parameter file.


# With libyaml, if PyYAML has it: a running node writes its parameters after each change.
class _Dumper(getattr(yaml, 'CSafeDumper', yaml.SafeDumper)):  # type: ignore[misc]
    """Quotes strings that rcl would parse as booleans and PyYAML would not."""


_Dumper.add_representer(
    str,
    lambda dumper, text: dumper.represent_scalar(
        'tag:yaml.org,2002:str', text, style="'" if text.lower() in _READ_AS_BOOL else None
    ),
)

_Settings = TypeVar('_Settings')


def _same(new: Any, old: Any) -> bool:
    if isinstance(new, (list, tuple, array)):
        new = list(new)
    return bool(new == old)


class ParameterNode(LifecycleNode):
    """Lifecycle node with parameters from dataclasses."""

    LIVE: ClassVar[frozenset[str]] = frozenset()  #: Parameters of the configured node to `change`.

    def __init__(self, name: str, **node_options: Any) -> None:
        super().__init__(name, **node_options)
        self._units: dict[str, str] = {}  #: Units of the numeric parameters.
        #: Parameters that a file sets for several nodes: each declares some of them.
        self.shared: frozenset[str] = frozenset()
        self._configured = False
        self._changed = False  #: Whether the last accepted parameters had new values.
        self.add_on_set_parameters_callback(self._check_change)
        self._parameter_services = ParameterServices(self)

    def change(self, changes: Mapping[str, Any]) -> None:
        """Apply new values of `LIVE` parameters by name; raise `NeedleError` to reject them."""

    def check_before(self, _changes: Mapping[str, Any]) -> Callable[[], object] | None:
        """Return the part of `change` that takes long, for a thread; it keeps its result."""
        return None

    def long_check(self, parameters: list[Parameter]) -> Callable[[], object] | None:
        """Return `check_before` of parameters that may change, otherwise None."""
        changes = self._changes(parameters) if self._configured else {}
        if not changes or set(changes) - self.LIVE:
            return None
        # `change` raises the error of an invalid value.
        with suppress(NeedleError):
            return self.check_before(changes)
        return None

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set declared parameters; the error of rclpy for an undeclared one does not name it."""
        for name in (one.name for one in parameter_list):
            if not self.has_parameter(name):
                known = self.list_parameters([], 0).names
                return SetParametersResult(successful=False, reason=unknown_name(name, known))
        return super().set_parameters_atomically(parameter_list)

    def declare_text(
        self,
        name: str,
        default: str | bool | list[str],
        description: str = '',
        valid: Collection[str] = (),
    ) -> None:
        """Declare a parameter that is not a number; empty ``valid`` allows any text."""
        constraint = constraints({'valid': valid} if valid else {}, default)
        descriptor = ParameterDescriptor(
            description=description or constraint,
            # YAML 1.1 parses y as true; `text` converts it back.
            dynamic_typing=default in _READ_AS_BOOL,
            additional_constraints=constraint,
        )
        self.declare_parameter(name, default, descriptor)

    def declare_settings(self, prefix: str, defaults: object, names: Collection[str] = ()) -> None:
        """Declare one parameter per dataclass field; without ``names`` for all fields."""
        for item in fields(defaults):  # type: ignore[arg-type]
            if names and item.name not in names:
                continue
            meta, default = item.metadata, getattr(defaults, item.name)
            unit = f' [{meta["unit"]}]' if meta.get('unit') else ''
            descriptor = ParameterDescriptor(
                description=f'{meta.get("description", item.name)}{unit}',
                # Integers are accepted for floats; the dataclass checks the value.
                dynamic_typing=True,
                additional_constraints=constraints(meta, default),
            )
            # A range has no infinite bounds.
            if 'low' in meta and not meta['unlimited']:
                low, high = (min(max(meta[end], -_LARGEST), _LARGEST) for end in ('low', 'high'))
                limits = FloatingPointRange(from_value=low, to_value=high)
                descriptor.floating_point_range = [limits]
            if 'unit' in meta:
                self._units[prefix + item.name] = meta['unit']
            if isinstance(default, tuple):
                default = list(default)
            self.declare_parameter(f'{prefix}{item.name}', default, descriptor)

    def settings(
        self, prefix: str, kind: Callable[..., _Settings], changes: Mapping[str, Any] | None = None
    ) -> _Settings:
        """Return the dataclass filled from the parameters; ``changes`` override values."""
        values = {}
        for item in fields(kind):  # type: ignore[arg-type]
            name = f'{prefix}{item.name}'
            given = (changes or {}).get(name, self.get_parameter(name).value)
            value = self._meant(name, given)
            if isinstance(value, bool) and isinstance(item.default, str):
                value = _READ_AS_BOOL[not value]
            values[item.name] = value
        return from_values(kind, values, prefix)

    def _meant(self, name: str, value: Any) -> Any:
        """Parse numbers that PyYAML reads as strings, such as 1e-3 and 5mm."""
        if name in self._units and isinstance(value, str):
            with suppress(ParameterError):
                return quantity(value, self._units[name])
        return value

    def text(
        self, name: str, valid: tuple[str, ...] = (), changes: Mapping[str, Any] | None = None
    ) -> str:
        """Return a text parameter; ``changes`` override it, empty ``valid`` allows any value."""
        value = (changes or {}).get(name, self.get_parameter(name).value)
        if isinstance(value, bool):
            value = _READ_AS_BOOL[not value]
        if valid:
            check_choice(name, value, valid)
        return str(value)

    def configuration(self) -> str:
        """Return all parameters as a ROS parameter file (YAML)."""
        values = self.values()
        document = {self.get_fully_qualified_name(): {MARK: values}}
        return str(yaml.dump(document, Dumper=_Dumper, sort_keys=False))

    def values(self) -> dict[str, Any]:
        hidden = ('qos_overrides', 'start_type')
        return {
            name: self.value(name)
            for name in sorted(self._parameters)
            if not name.startswith(hidden)
        }

    def value(self, name: str) -> Any:
        """Return the value of a parameter; rcl returns an empty list of a file as None."""
        value = self._parameters[name].value
        if value is None or isinstance(value, (list, tuple, array)):
            value = list(value or ())
        return self._meant(name, value)

    def _is_valid(self) -> bool:
        try:
            self._check_overrides()
        except ParameterError:
            return False
        return True

    def _check_overrides(self) -> None:
        known = sorted(self._parameters)
        others = sorted(self.shared - set(known))
        if others:
            line = f'shared parameters that this node does not declare: {", ".join(others)}'
            self.get_logger().warning(line)
        unknown = sorted(set(self._parameter_overrides) - set(known) - self.shared)
        if unknown:
            count = len(self._parameter_overrides)
            reasons = '; '.join(unknown_name(name, known) for name in unknown)
            raise ParameterError(
                f'{count - len(unknown)} of {count} given parameters are known: {reasons}'
            )

    def _changes(self, parameters: list[Parameter]) -> dict[str, Any]:
        """Return the new values; others are accepted: a whole file can be loaded again."""
        given = {one.name: self._meant(one.name, one.value) for one in parameters}
        return {
            name: new
            for name, new in given.items()
            if name not in self._parameters or not _same(new, self.value(name))
        }

    def _check_change(self, parameters: list[Parameter]) -> SetParametersResult:
        if not self._configured:
            return SetParametersResult(successful=True)
        changes = self._changes(parameters)
        self._changed = bool(changes)
        fixed = ', '.join(name for name in changes if name not in self.LIVE)
        if fixed:
            reason = f'{fixed}: cannot change while configured; clean up the node first'
            return SetParametersResult(successful=False, reason=reason)
        try:
            if changes:
                self.change(changes)
        except NeedleError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)


# Parameter files: rcl reports no unused section.


class ParameterSection(NamedTuple):
    """Section of a parameter file, with the names of its parameters."""

    file: str
    #: Full name of the nodes; ``*`` matches one name, ``**`` any number of names.
    nodes: str
    names: frozenset[str]

    def is_for(self, node: str) -> bool:
        """Return whether the section applies to a node with a full name such as ``/plant``."""
        parts = [part for part in self.nodes.split('/') if part]
        pattern = ''.join(
            '(/[^/]+)*' if part == '**' else '/[^/]+' if part == '*' else '/' + re.escape(part)
            for part in parts
        )
        return re.fullmatch(pattern, node) is not None


def sections(arguments: Sequence[str]) -> list[ParameterSection]:
    """Read the parameter files of a command line."""
    files = [file for flag, file in pairwise(arguments) if flag == '--params-file']
    return [
        ParameterSection(file, f'/{name}', frozenset(_flat(values)))
        for file in files
        for name, values in read_sections(file)
    ]


def unmatched_files(found: Sequence[ParameterSection], node: str) -> list[str]:
    """Return a warning for each file without a section for a node."""
    lines = []
    for file in dict.fromkeys(section.file for section in found):
        own = [section for section in found if section.file == file]
        if not any(section.is_for(node) for section in own):
            others = ', '.join(section.nodes for section in own)
            lines.append(f'{file} has no parameters for {node}, only for {others}')
    return lines


def shared_names(found: Sequence[ParameterSection], node: str) -> frozenset[str]:
    """Return the parameters that wildcard sections (``/**``) set for a node."""
    shared = (one for one in found if '*' in one.nodes.rpartition('/')[2] and one.is_for(node))
    return frozenset(name for section in shared for name in section.names)


def _flat(values: Mapping[str, Any], prefix: str = '') -> Iterator[str]:
    """Yield the dotted names of nested parameters."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f'{prefix}{name}.')
        else:
            yield f'{prefix}{name}'
