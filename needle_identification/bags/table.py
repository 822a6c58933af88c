# SPDX-License-Identifier: Apache-2.0
"""Messages of a topic as columns of numbers."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Final

from needle_dynamics.display import Displayed
from needle_identification.bags.bag import read_topic
from needle_ros.timing import NANOSECONDS
import numpy as np
from numpy.typing import NDArray

_MOST: Final = 64  #: largest number of elements of a sequence that are columns of their own
_LABELS: Final = ('name', 'names', 'joint_names')  # names of elements of other fields


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class TopicTable(Displayed):
    """Messages of a topic by field; ``table[name]`` is a column."""

    topic: str  #: full name
    #: Fields, shape (n,) each: ``time [s]`` since the first message, by the header if it has a
    #: stamp, and receive time; then the fields, such as ``wrench.force.y``.
    values: Mapping[str, NDArray[Any]]

    def __getitem__(self, name: str) -> NDArray[Any]:
        try:
            return self.values[name]
        except KeyError:
            raise KeyError(f'{name!r}; valid: {", ".join(self.values)}') from None

    def __iter__(self) -> Iterator[str]:
        return iter(self.values)

    def __repr__(self) -> str:
        time = self.values['time [s]']
        return f'<TopicTable {self.topic}: {len(time)} messages in {time[-1] - time[0]:.4g} s>'

    def columns(self) -> dict[str, NDArray[Any]]:
        return dict(self.values)


def read_bag(path: Path | str, topic: str) -> TopicTable:
    """
    Read one topic of a bag as arrays, of any message type that ROS 2 Jazzy or the bag defines.

    Elements of sequences are columns, such as ``data[0]``, and ``position.insertion`` if the
    message names them. A missing number is NaN. Sequences with more than 64 elements, such as
    images, are arrays in one column.

    Parameters
    ----------
    path : Path or str
        As in `Bag`.
    topic : str
        Name, with or without the first slash.

    Returns
    -------
    TopicTable
        Columns, with `to_dataframe` and `plot`.

    Examples
    --------
    >>> table = read_bag('bags/friction_01', '/joint_states')
    >>> table['position.insertion'].shape == table['time [s]'].shape
    True

    """
    name = f'/{topic.removeprefix("/")}'
    messages = read_topic(path, name)
    received = np.array([time for time, _ in messages], dtype=np.int64)
    rows = [dict(_leaves('', message)) for _, message in messages]
    names = dict.fromkeys(key for row in rows for key in row)
    found = {key: _column([row.get(key) for row in rows]) for key in names}
    stamps = found.get('header.stamp', received)
    if not stamps.any():
        # The driver does not stamp. Simulated time begins at zero.
        stamps = received
    time = (stamps - stamps[:1]) / NANOSECONDS
    return TopicTable(name, {'time [s]': time, 'received [ns]': received, **found})


def _leaves(name: str, value: Any, labels: Sequence[str] = ()) -> Iterator[tuple[str, Any]]:
    """Yield the numbers and texts in a message, with their names; times in ns."""
    if is_dataclass(value):
        parts = {p.name: getattr(value, p.name) for p in fields(value) if p.name != '__msgtype__'}
        if [*parts] == ['sec', 'nanosec']:
            yield name, parts['sec'] * NANOSECONDS + parts['nanosec']
            return
        found = next((part for part in _LABELS if isinstance(parts.get(part), list)), '')
        for part, inner in parts.items():
            whole = f'{name}.{part}' if name else part
            yield from _leaves(whole, inner, parts.get(found, ()))
    elif isinstance(value, (list, np.ndarray)) and len(value) <= _MOST:
        named = labels if len(labels) == len(value) else ()
        for k, one in enumerate(value):
            yield from _leaves(f'{name}.{named[k]}' if named else f'{name}[{k}]', one)
    else:
        yield name, value


def _column(values: list[Any]) -> NDArray[Any]:
    """Return values of one field as an array; NaN for a missing number."""
    known = [one for one in values if one is not None]
    if all(isinstance(one, (bool, int, float, np.number)) for one in known):
        complete = len(known) == len(values)
        return np.array(values if complete else [np.nan if v is None else v for v in values])
    result = np.empty(len(values), dtype=object)
    result[:] = values
    return result
