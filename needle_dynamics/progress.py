# SPDX-License-Identifier: Apache-2.0
"""Progress of long calls from Python."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeAlias

#: True for a progress bar, or a function that is called after each run.
Progress: TypeAlias = bool | Callable[[], object]


@contextmanager
def progress_of(
    progress: Progress | None, total: int, unit: str
) -> Iterator[Callable[[], object]]:
    """Yield the function to call after each of a number of runs."""
    if callable(progress):
        yield progress
    elif progress:
        # Widgets in a notebook, text elsewhere.
        from tqdm.auto import tqdm

        with tqdm(total=total, unit=f' {unit}', leave=False) as bar:
            yield bar.update
    else:
        yield lambda: None
