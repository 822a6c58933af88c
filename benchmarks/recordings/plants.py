# SPDX-License-Identifier: Apache-2.0
"""
Plants that repeat a recorded insertion under another motion of the guide.

`BeamMedium` is the beam of the project, fitted to all insertions in a medium. `ResponseMedium` is
a response to the guide that is estimated without a model: by the depth of a step of the guide, the
shift of the tip at once, and its growth with further depth. Both have a drift of the medium.
The difference between a recording and the plant under the recorded guide is added to the tip as
a disturbance by depth: under the recorded guide the tip repeats the recording exactly. It contains
the noise of the recorded sensor, so that no further noise is added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import nan
from types import SimpleNamespace
from typing import Final, Protocol

from needle_controller.steering.law import GuideSetpoint
from needle_controller.steering.simulation import SteeringPlant
from needle_dynamics import FloatArray, SteeredNeedle, SteeringParameters
from needle_dynamics.needles import NEEDLES
from needle_dynamics.steering.parameters import tissue_of
from needle_identification import SteeringRecording
from needle_identification.steering.search import rms_of, searched, Tips
import numpy as np

#: Order of guide motion and insertion of the recordings, and of the simulated insertion.
ORDER: Final = 'guide first'

#: Drift term and free length [m] of the fitted beam.
_TERMS: Final = ('tilt',)
FREE: Final = 0.04

#: Depths at which the bins of guide steps of the response begin [m].
BINS: Final = (0.0, 0.0225, 0.0425, 0.0625)

_NEEDLE: Final = NEEDLES['phantom'].needle


class Medium(Protocol):
    """Fit to the insertions in a medium."""

    def plant(self, recording: SteeringRecording) -> SteeringPlant:
        """Return a plant at the first depth, without disturbance."""


class DisturbedPlant(SteeringPlant):
    """A plant with a disturbance of its tip by step, shape (n + 1, 2) [m]."""

    def __init__(self, plant: SteeringPlant, disturbance: FloatArray) -> None:
        self._plant, self._disturbance = plant, disturbance
        self.needle, self.depths = plant.needle, plant.depths

    @property
    def step(self) -> int:  # type: ignore[override]
        """Number of the present depth."""
        return self._plant.step

    @property
    def tip(self) -> FloatArray:
        """Position of the tip in x and z [m]."""
        return np.asarray(self._plant.tip + self._disturbance[self.step])

    def guide(self, to: GuideSetpoint) -> None:
        """Move the guide, while the depth is constant."""
        self._plant.guide(to)

    def insert(self) -> None:
        """Insert the needle to the next depth."""
        self._plant.insert()


def disturbance_of(medium: Medium, recording: SteeringRecording) -> FloatArray:
    """Return recorded minus simulated tip under the recorded guide, shape (n + 1, 2) [m]."""
    plant, tips = medium.plant(recording), []
    for x, z in recording.guide[1:].tolist():
        tips.append(plant.tip)
        plant.guide(GuideSetpoint(x, z))
        plant.insert()
    return np.asarray(recording.tip - np.array([*tips, plant.tip]))


def recorded_plant(medium: Medium, recording: SteeringRecording) -> DisturbedPlant:
    """Return a plant that repeats a recording under the recorded guide."""
    return DisturbedPlant(medium.plant(recording), disturbance_of(medium, recording))


@dataclass(frozen=True, slots=True, kw_only=True)
class BeamMedium:
    """
    Beam fitted to the insertions in a medium.

    Attributes
    ----------
    length, skin : float
        Bending length, and stiffness of the skin over the stiffness of the tissue [m].
    tilt : tuple of float
        Tilt of the guide in x and z [rad].
    rms : float
        Root mean square of the residuals, per axis [m].

    """

    length: float
    skin: float
    tilt: tuple[float, float]
    rms: float

    @classmethod
    def fit(cls, recordings: Sequence[SteeringRecording]) -> BeamMedium:
        """Fit bending length, skin, tilt, and an offset of each recording."""
        search, (best, *_) = searched(Tips(recordings, ORDER), _TERMS, FREE)
        x = best.x
        [(_, length, skin)] = search.lengths(x)
        tilt_x, tilt_z = search.fits(x)[0].drift.tolist()
        rms = rms_of(search.residuals(x))
        return cls(length=length, skin=skin, tilt=(tilt_x, tilt_z), rms=rms)

    def plant(self, recording: SteeringRecording) -> SteeringPlant:
        """Return a plant at the first depth, without disturbance."""
        tissue = tissue_of(_NEEDLE.bending_stiffness, self.length)
        needle = SteeredNeedle(
            replace(_NEEDLE, tissue_stiffness=tissue),
            SteeringParameters(free_length=FREE, skin_stiffness=self.skin * tissue),
            tilt=self.tilt,
        )
        return SteeringPlant(needle, recording.depth)


@dataclass(frozen=True, slots=True, kw_only=True)
class ResponseMedium:
    """
    Response to steps of the guide, estimated without a model.

    Attributes
    ----------
    jumps : ndarray, shape (bins,)
        Shift of the tip at once, per step of the guide, by the depth of the step.
    slopes : ndarray, shape (bins,)
        Shift per further depth, per step of the guide, by the depth of the step [1/m].
    drift : ndarray, shape (2, 2)
        Drift per depth [1] and per squared depth [1/m], in x and z.
    rms : float
        Root mean square of the residuals, per axis [m].

    """

    jumps: FloatArray
    slopes: FloatArray
    drift: FloatArray
    rms: float

    @classmethod
    def fit(cls, recordings: Sequence[SteeringRecording]) -> ResponseMedium:
        """Estimate the response, the drift, and an offset of each recording."""
        rows, wanted = [], []
        for k, one in enumerate(recordings):
            n, offsets = len(one.depth), np.zeros((len(one.depth), len(recordings)))
            offsets[:, k] = 1.0
            powers = np.column_stack([one.depth, one.depth**2])
            for axis in range(2):
                drift = np.zeros((n, 4))
                drift[:, 2 * axis : 2 * axis + 2] = powers
                own = np.zeros((n, 2 * len(recordings)))
                own[:, axis::2] = offsets
                rows.append(np.hstack([_columns(one.depth, one.guide[:, axis]), drift, own]))
                wanted.append(one.tip[:, axis])
        columns, tips = np.vstack(rows), np.concatenate(wanted)
        # Of the least motions: a bin without steps of the guide has no response.
        found = np.linalg.lstsq(columns, tips, rcond=1e-9)[0]
        count = len(BINS)
        return cls(
            jumps=found[:count],
            slopes=found[count : 2 * count],
            drift=found[2 * count : 2 * count + 4].reshape(2, 2),
            rms=float(np.sqrt(np.mean((tips - columns @ found) ** 2))),
        )

    def plant(self, recording: SteeringRecording) -> SteeringPlant:
        """Return a plant at the first depth, without disturbance."""
        return _ResponsePlant(self, recording.depth)

    def tip(self, depths: FloatArray, guide: FloatArray) -> FloatArray:
        """Return the tip (2,) at the last of the depths (k,) for a guide (k, 2) [m]."""
        responses = np.concatenate([self.jumps, self.slopes])
        moved = [_columns(depths, one)[-1] @ responses for one in guide.T]
        return np.asarray(moved + self.drift @ [depths[-1], depths[-1] ** 2])


def _columns(depth: FloatArray, guide: FloatArray) -> FloatArray:
    """Return shifts of the tip by jumps and slopes of each bin, shape (n, 2 bins)."""
    steps = np.diff(guide)
    # The guide moves at the depth before, and the needle is inserted then.
    bins = np.searchsorted(BINS, depth[:-1] + 1e-9, side='right') - 1
    further = np.tril(depth[:, np.newaxis] - depth[:-1], -1)
    of_bin = (bins[:, np.newaxis] == np.arange(len(BINS))) * steps[:, np.newaxis]
    return np.hstack([np.tril(np.ones_like(further), -1) @ of_bin, further @ of_bin])


class _ResponsePlant(SteeringPlant):
    """Tip by the response of a medium; the load on the guide is not known."""

    def __init__(self, medium: ResponseMedium, depths: FloatArray) -> None:
        self.depths, self.step = depths, 0
        self._medium, self._guides = medium, np.zeros((len(depths), 2))
        self.needle = SimpleNamespace(guide_load=np.full((1, 2), nan))  # type: ignore[assignment]

    @property
    def tip(self) -> FloatArray:
        """Position of the tip in x and z [m]."""
        k = self.step + 1
        return self._medium.tip(self.depths[:k], self._guides[:k])

    def guide(self, to: GuideSetpoint) -> None:
        """Move the guide, while the depth is constant."""
        self._guides[self.step + 1 :] = to[:2]

    def insert(self) -> None:
        """Insert the needle to the next depth."""
        self.step += 1
