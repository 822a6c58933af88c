# SPDX-License-Identifier: Apache-2.0
"""Needles that differ in some constants, as arrays instead of one object for each needle."""

from collections.abc import Iterable, Sequence
from dataclasses import fields, replace
from functools import cached_property
from operator import attrgetter, index
from typing import Any, Final, overload

from needle_dynamics.arrays import BoolArray, FloatArray
from needle_dynamics.parameters import LEAST_RATIOS, NeedleParameters
from needle_ros.errors import ParameterError, ShapeError
from needle_ros.settings import number_fields, unknown_name
import numpy as np
from numpy.typing import ArrayLike

#: Fields with a number for each layer.
_LAYERS: Final = ('layer_depths', 'layer_stiffnesses')
#: Fields with one number, and their metadata.
_NUMBERS: Final = {name: item.metadata for name, item in number_fields(NeedleParameters).items()}


class NeedleArray(Sequence[NeedleParameters]):
    """
    Constants of many needles: a sequence of `NeedleParameters` for `simulate_batch`.

    The constants are checked like those of `NeedleParameters`, but vectorized; the object of a
    needle is constructed only when it is indexed.

    Parameters
    ----------
    base : NeedleParameters
        Constants that all needles share.
    **constants : array_like, shape (runs,)
        Constants that differ from needle to needle, by the name of the field, SI units;
        `layer_depths` and `layer_stiffnesses` have the shape (runs, layers).

    Raises
    ------
    ParameterError
        If a name or a value is not valid; the message has the index of the first invalid needle.
    ShapeError
        If the arrays are not for the same number of needles.

    Examples
    --------
    >>> import numpy as np
    >>> from needle_dynamics import NeedleArray, NeedleParameters
    >>> base = NeedleParameters.preset('phantom')
    >>> needles = NeedleArray(base, coulomb_friction=np.linspace(0.4, 0.8, 1000))
    >>> len(needles), needles[0].coulomb_friction
    (1000, 0.4)
    >>> NeedleArray(base, coulomb_friction=[0.4, -0.8])
    Traceback (most recent call last):
        ...
    needle_ros.errors.ParameterError: run 1: coulomb_friction must be finite, >= 0 N, got -0.8

    """

    def __init__(self, base: NeedleParameters, **constants: ArrayLike) -> None:
        if not isinstance(base, NeedleParameters):
            raise ParameterError(f'base must be NeedleParameters, got {base!r}')
        self.base: Final = base  #: constants that all needles share
        given: dict[str, FloatArray] = {}
        for name, values in constants.items():
            if name not in _NUMBERS and name not in _LAYERS:
                raise ParameterError(unknown_name(name, [*_NUMBERS, *_LAYERS]))
            given[name] = _numbers(name, values)
        if len({len(values) for values in given.values()}) != 1:
            shapes = ', '.join(f'{name} {values.shape}' for name, values in given.items())
            raise ShapeError(f'constants must be for the same needles, got {shapes or "none"}')
        #: The constants that differ, by name, shape (runs,) or (runs, layers); not writable.
        self.constants: Final = given
        # Differences and products of infinite numbers are not numbers.
        with np.errstate(invalid='ignore'):
            valid = self._valid()
        for k in np.flatnonzero(~valid).tolist():
            self._check(k)

    def _check(self, k: int) -> None:
        try:
            self._made(k)
        except ParameterError as error:
            raise ParameterError(f'run {k}: {error}') from None

    def _valid(self) -> BoolArray:
        """Return which needles `NeedleParameters` would certainly accept, shape (runs,)."""
        valid = np.ones(len(self), dtype=np.bool_)
        for name, values in self.constants.items():
            if name in _NUMBERS:
                low, high = _NUMBERS[name]['low'], _NUMBERS[name]['high']
                above = values > low if _NUMBERS[name]['open_low'] else values >= low
                valid &= above & (values <= high) & np.isfinite(values)
        depths, stiffnesses = self.layers
        if depths.shape != stiffnesses.shape:
            return np.zeros_like(valid)
        valid &= np.isfinite(depths).all(axis=1) & np.isfinite(stiffnesses).all(axis=1)
        valid &= (stiffnesses >= 0.0).all(axis=1) & (np.diff(depths, prepend=0.0) > 0.0).all(
            axis=1
        )
        if {'length', 'minimum_depth'} & self.constants.keys():
            # Both limits of the least depth are proportional to the length: see `_check_modes`.
            least, length = self.column('minimum_depth'), self.column('length')
            valid &= (least >= LEAST_RATIOS[self.base.modes - 1] * length) & (least < length)
        return valid

    @cached_property
    def _columns(self) -> Any:
        """Return unchecked `NeedleParameters` with arrays as fields, for its properties."""
        found = object.__new__(NeedleParameters)
        for item in fields(NeedleParameters):
            value = self.constants.get(item.name, getattr(self.base, item.name))
            object.__setattr__(found, item.name, value)
        return found

    @property
    def layers(self) -> tuple[FloatArray, FloatArray]:
        """Depths at which the layers begin [m], and their stiffness [N/m^2], (runs, layers)."""
        depths, stiffnesses = (
            np.atleast_2d(np.asarray(getattr(self._columns, name), dtype=np.float64))
            for name in _LAYERS
        )
        runs = len(self)
        return (
            np.broadcast_to(depths, (runs, depths.shape[1])),
            np.broadcast_to(stiffnesses, (runs, stiffnesses.shape[1])),
        )

    def column(self, name: str) -> FloatArray:
        """Return a number or a numeric property of every needle, shape (runs,), by its name."""
        value = np.asarray(getattr(self._columns, name), dtype=np.float64)
        return np.broadcast_to(value, len(self))

    def _made(self, k: int) -> NeedleParameters:
        values: dict[str, Any] = {
            name: tuple(own[k].tolist()) if name in _LAYERS else float(own[k])
            for name, own in self.constants.items()
        }
        return replace(self.base, **values)

    def __len__(self) -> int:
        return len(next(iter(self.constants.values())))

    @overload
    def __getitem__(self, at: int) -> NeedleParameters: ...

    @overload
    def __getitem__(self, at: slice) -> Sequence[NeedleParameters]: ...

    def __getitem__(self, at: int | slice) -> NeedleParameters | Sequence[NeedleParameters]:
        if isinstance(at, slice):
            return [self._made(k) for k in range(*at.indices(len(self)))]
        return self._made(range(len(self))[index(at)])

    def __repr__(self) -> str:
        return f'<NeedleArray: {len(self)} needles that differ in {", ".join(self.constants)}>'


def _numbers(name: str, values: ArrayLike) -> FloatArray:
    """Return a copy that is not writable; reject other shapes and other types."""
    try:
        given = np.asarray(values)
    except ValueError:
        raise ShapeError(f'{name} must be an array of numbers, got {values!r}') from None
    if given.dtype.kind not in 'fiu':
        raise ParameterError(f'{name} must be an array of numbers, got an array of {given.dtype}')
    own = np.array(given, dtype=np.float64)
    shape = '(runs, layers)' if name in _LAYERS else '(runs,)'
    if own.ndim != 1 + (name in _LAYERS) or not len(own):
        raise ShapeError(f'{name} must have the shape {shape}, got {own.shape}')
    own.flags.writeable = False
    return own


def columns_of(needles: Sequence[NeedleParameters], names: Iterable[str]) -> dict[str, FloatArray]:
    """Return numbers or numeric properties of every needle by name, shape (runs,) each."""
    wanted = list(names)
    if isinstance(needles, NeedleArray):
        return {name: needles.column(name) for name in wanted}
    read = attrgetter(*wanted)
    rows = np.array([read(p) for p in needles], dtype=np.float64).reshape(len(needles), -1)
    return dict(zip(wanted, rows.T, strict=True))
