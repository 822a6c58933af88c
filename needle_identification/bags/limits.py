"""How much a file may unfold to: a small one must not fill the memory or run for hours."""

from __future__ import annotations

from math import isfinite
import os
from pathlib import Path
from typing import Any, Final

from needle_identification.errors import RecordingError

#: Environment variable by which all limits here are multiplied.
FACTOR: Final = 'NEEDLE_BAG_FACTOR'

#: Largest record or chunk, and largest message that was compressed on its own [bytes].
LARGEST_RECORD: Final = 2**27
LARGEST_MESSAGE: Final = 2**26

#: What any file may unfold to [bytes], and what each of its own bytes may.
_AT_LEAST: Final = 2**28
_RATIO: Final = 50


def factor() -> float:
    """
    Return by how much the limits are multiplied.

    Returns
    -------
    float
        `FACTOR` of the environment, or 1.

    Raises
    ------
    RecordingError
        If it is not a positive number.

    """
    text = os.environ.get(FACTOR, '1')
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not (isfinite(value) and value > 0.0):
        raise RecordingError(f'{FACTOR} must be a positive number, got {text!r}')
    return value


class Budget:
    """
    What may still be read of a file.

    Parameters
    ----------
    file : Path
        The file.

    Attributes
    ----------
    name : str
        Name of the file.
    largest : int
        Largest record [bytes].
    largest_message : int
        Largest message that was compressed on its own [bytes].

    Raises
    ------
    RecordingError
        If `FACTOR` is not valid.

    """

    def __init__(self, file: Path) -> None:
        times = factor()
        self.name, self._size = file.name, file.stat().st_size
        self._most = self._left = round(times * max(_AT_LEAST, _RATIO * self._size))
        self.largest = round(times * LARGEST_RECORD)
        self.largest_message = round(times * LARGEST_MESSAGE)

    def spend(self, number: int) -> None:
        """
        Count bytes that the file has unfolded to.

        Parameters
        ----------
        number : int
            Number of bytes.

        Raises
        ------
        RecordingError
            If there are too many.

        """
        self._left -= number
        if self._left < 0:
            raise RecordingError(
                f'{self.name} unfolds to more than {_bytes(self._most)} from '
                f'{_bytes(self._size)}; {FACTOR}=10 raises this limit tenfold'
            )

    def too_large(self, what: str, size: int) -> str:
        """
        Say that something is larger than `largest`.

        Parameters
        ----------
        what : str
            What it is.
        size : int
            Its size [bytes].

        Returns
        -------
        str
            A line.

        """
        return (
            f'a {what} of {size} bytes, at most {_bytes(self.largest)} are read; {FACTOR}=10 '
            'raises this limit tenfold'
        )

    def metered(self, stream: Any) -> Any:
        """
        Return a stream of which each byte counts.

        Parameters
        ----------
        stream : binary stream
            Stream of decompressed bytes.

        Returns
        -------
        binary stream
            The same, with ``read`` alone, as a context.

        """
        return _Metered(stream, self)


class _Metered:
    def __init__(self, stream: Any, budget: Budget) -> None:
        self._stream, self._budget = stream, budget

    def __enter__(self) -> _Metered:
        return self

    def __exit__(self, *raised: object) -> None:
        self._stream.close()

    def read(self, size: int) -> bytes:
        part: bytes = self._stream.read(size)
        self._budget.spend(len(part))
        return part


def _bytes(number: int) -> str:
    return f'{number / 2**20:.0f} MB' if number >= 2**20 else f'{number / 2**10:.1f} kB'
