# SPDX-License-Identifier: Apache-2.0
"""Check stiffness matrices: axes and units of the force, and why a matrix is not determined."""

from collections.abc import Iterator, Sequence
from itertools import permutations, product
from math import inf, pi
from typing import Final

from needle_dynamics.arrays import FloatArray
from needle_identification.errors import IdentificationError, WrongSignError
from needle_identification.estimation.estimate import check_sign, ParameterEstimate
from needle_identification.recordings.recording import IndentationRecording
from needle_identification.stiffness.matrix import asymmetry, FEWEST_PRESSES, MatrixFit
from needle_identification.stiffness.plateaus import StiffnessSettings
from needle_identification.stiffness.presses import Presses
import numpy as np

_PLANE: Final = ('x', 'z')
_UNIT: Final = 100.0  # force of a press above which its unit is suspected [N]
_LAGS: Final = 2.0  # largest lag between force and motion that is searched [s]
_STEP: Final = 0.01  # step of this search, and smallest lag that is named [s]
_CLEARLY: Final = 0.25  # largest ratio of unexplained variance for a lag that is named
_FITS: Final = 0.2  # largest asymmetry with axes that are advised
_ALONG: Final = 0.05  # largest ratio of displacements across and along a line


def check_axes(
    fit: MatrixFit, entries: tuple[ParameterEstimate, ...], smallest: ParameterEstimate
) -> None:
    """Raise `WrongSignError` if an entry or the smaller stiffness is negative; name the axes."""
    try:
        for one in entries:
            check_sign('stiffness', one)
        if smallest.interval[1] < 0.0:
            check_sign('stiffness', smallest)
    except WrongSignError as error:
        words, _ = _fitting_axes(fit.matrix)
        advice = f': with --force-axes {words} it is positive, if they are x,z' if words else ''
        raise WrongSignError(f'{error}{advice}') from None


def check_levels(presses: Presses, fits: Sequence[MatrixFit], settings: StiffnessSettings) -> None:
    """Raise `IdentificationError` if nearly each press is a level, and none has a matrix."""
    sizes, count = np.hypot(*presses.force.T), len(fits)
    is_scattered = count > FEWEST_PRESSES and len(sizes) < FEWEST_PRESSES * count
    if is_scattered and not any(fit.known.any() for fit in fits):
        raise IdentificationError(
            f'{len(sizes)} presses have {count} levels of force within '
            f'{settings.level_tolerance:g} N, from {sizes.min():.3g} to {sizes.max():.4g} N: '
            f'increase level_tolerance{_unit_advice(presses.force)}'
        )


def axes_doubt(fit: MatrixFit, rotation: ParameterEstimate) -> str:
    """Return axes that fit better if the force is rotated by more than 45 deg, else ''."""
    if not rotation.determined or abs(rotation.value) - 2.0 * rotation.error < pi / 4.0:
        return ''
    words, left = _fitting_axes(fit.matrix)
    if left > _FITS:
        return ''
    return f'the force fits the motion with --force-axes {words}, if they are x,z'


def _fitting_axes(matrix: FloatArray) -> tuple[str, float]:
    """Return the axes of force that make K positive and most symmetric, and its asymmetry."""
    if not np.isfinite(matrix).all():
        return '', inf
    found = []
    for order, signs in product(permutations(range(2)), product((1.0, -1.0), repeat=2)):
        turned = matrix[list(order)] * np.array(signs)[:, np.newaxis]
        if np.linalg.eigvalsh(turned + turned.T)[0] > 0.0:
            names = (f'{"-" * (s < 0.0)}{_PLANE[i]}' for s, i in zip(signs, order, strict=True))
            found.append((','.join(names), asymmetry(turned)))
    return min(found, key=lambda one: one[1], default=('', inf))


def unknown_because(displacement: FloatArray, fit: MatrixFit) -> str:
    """Return why the presses (m, 2) do not determine the matrix."""
    if len(displacement) < FEWEST_PRESSES:
        return f'at least {FEWEST_PRESSES} presses in two directions are needed'
    along, across = np.linalg.svd(displacement, compute_uv=False)
    if across < _ALONG * along or fit.known.any():
        return 'all displacements are along one line, press in a second direction, too'
    return 'the displacements are not clear of their errors'


def unit_warnings(force: FloatArray) -> Iterator[str]:
    """Warn of forces of presses (m, 2) that no soft tissue bears."""
    if advice := _unit_advice(force):
        yield f'the force of a press is {np.hypot(*force.T).max():.4g} N{advice}'


def _unit_advice(force: FloatArray) -> str:
    is_small = np.hypot(*force.T).max() < _UNIT
    return '' if is_small else '; perhaps the unit is mN: --force-axes x[mN],z[mN]'


def lag_warnings(recording: IndentationRecording) -> Iterator[str]:
    """Warn of a lag between force and motion that explains undetermined matrices."""
    time = np.arange(recording.time[0], recording.time[-1], _STEP)
    force, motion = (
        np.column_stack([np.interp(time, recording.time, one) for one in columns.T])
        for columns in (recording.force, recording.position)
    )
    steps = np.arange(round(_LAGS / _STEP) + 1)
    steps = steps[steps < max(len(time) // 4, 1)]
    lags = np.concatenate([-steps[:0:-1], steps]).tolist()
    left = np.array([_unexplained(force, motion, lag) for lag in lags])
    best = int(left.argmin())
    if left[best] < _CLEARLY * left[lags.index(0)]:
        lag = lags[best] * _STEP
        yield (
            f'the force is {abs(lag):.2f} s {"behind" if lag > 0.0 else "ahead of"} the motion: '
            'clocks differ; synchronize them, or use --time receive'
        )


def _unexplained(force: FloatArray, motion: FloatArray, lag: int) -> float:
    """Return the fraction of the motion (n, 2) that the force ``lag`` rows later leaves."""
    count = len(force) - abs(lag)
    later, earlier = force[max(lag, 0) :][:count], motion[max(-lag, 0) :][:count]
    later, earlier = later - later.mean(axis=0), earlier - earlier.mean(axis=0)
    gain = np.linalg.lstsq(later, earlier, rcond=None)[0]
    return float(((earlier - later @ gain) ** 2).sum() / ((earlier**2).sum() or 1.0))
