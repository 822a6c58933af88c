# SPDX-License-Identifier: Apache-2.0
"""
Scenario of a study: insert sampled needles along a plan, in a patient that differs from the image.

The sensor reports the tip in the frame of the plan: its origin is the planned entry point, its
axes are those of the guide. The true guide deviates from this frame by the error of the entry
pose, and the true anatomy by the error of the registration. The law follows the planned path.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from math import ceil, cos, hypot, pi, sin
from pathlib import Path
from typing import Any, Final, NamedTuple

from needle_controller.steering.contact import monitored
from needle_controller.steering.insertion_plan import (
    in_layers,
    MOST_LAYERS,
    Plan,
    read_plan,
    write_plan,
)
from needle_controller.steering.law import (
    build_law,
    DEFAULT_LAW,
    find_law,
    GuideSetpoint,
    SteeringLaw,
)
from needle_controller.steering.planned_path import PlannedPath
from needle_controller.steering.planner import check_plan
from needle_controller.steering.responses import SteeringModel
from needle_controller.steering.settings import (
    ContactSettings,
    ExecutiveSettings,
    SteeringLimits,
    SteeringPrior,
)
from needle_controller.steering.simulation import SteeringPlant, true_needle
from needle_dynamics.arrays import FloatArray
from needle_dynamics.needles import find_needle
from needle_dynamics.parameters import NeedleParameters
from needle_dynamics.steering.needle import inserted_shape, SteeredNeedle
from needle_dynamics.steering.parameters import SteeringParameters
from needle_planning.anatomy import Anatomy, SegmentationError, Structure
from needle_planning.certificate import least_clearances, sag_of, simulate_insertion
from needle_planning.clearance import Clearance, image_frame
from needle_planning.labels import read_anatomy, read_labels
from needle_planning.paths import Line, needle_radius
from needle_planning.segmentation import source_files
from needle_ros.errors import ParameterError
from needle_ros.settings import constant, from_values
from needle_study import scenario
from needle_study.scenario import MeasuredRun, Metric, Row, Scenario, Streams, Variable
from needle_study.steering import path_seed, steer_sample, steered_variables
import numpy as np

_PLAN: Final = 'plan.yaml'
#: Largest distance of the points of the shaft, and of the depths [m]. Between them the shaft
#: deviates from a bilinear surface by 1 um.
_SPACING: Final = 5e-3
_TIGHT: Final = 5e-5  #: Largest difference between the bound and the true clearance [m].
_BEYOND: Final = 0.02  #: Distance from the line within which the clearance is exact [m].
#: Largest difference of two lower bounds of a clearance, and of positions in single precision [m].
_SAME: Final = _TIGHT + 2e-6
_ROUNDED: Final = 1e-3  #: Tolerance of an index of a voxel.
_SAME_RADIUS: Final = 1e-7  #: Largest difference of the radius of the same needle [m].
_FILES: Final = ('plan', 'segmentation', 'labels')
_PARTS: Final = ('folder', 'law', 'prior', 'contact', *_FILES)

#: Variables of the layers of a plan.
LAYERS: Final = tuple(f'layer_{k + 1}' for k in range(MOST_LAYERS))

METRICS: Final[Mapping[str, Metric]] = {
    'success': Metric('', 'the tip ends within the radius, and the clearance is positive'),
    'hit': Metric('', 'the tip ends within the radius of the target'),
    'clear': Metric('', 'the clearance of the whole needle is positive at every depth'),
    'miss': Metric('m', 'distance of the tip from the target at the end'),
    'clearance': Metric('m', 'least clearance of the shaft at all depths, a lower bound'),
    'tip_r': Metric('m', 'final position of the tip in the image'),
    'tip_a': Metric('m', 'final position of the tip in the image'),
    'tip_s': Metric('m', 'final position of the tip in the image'),
    'stopped': Metric('', 'the law stopped the insertion before the target depth'),
}


def write_inputs(folder: Path, plan: Plan, anatomies: Sequence[Anatomy]) -> None:
    """Write the plan and the obstacles of its anatomies for the setting ``folder``."""
    write_plan(plan, folder / _PLAN)
    for k, anatomy in enumerate(anatomies):
        found = [(n, one) for n, one in anatomy.structures.items() if one.role == 'obstacle']
        np.save(folder / f'labels{k}.npy', anatomy.labels)
        np.savez(
            folder / f'anatomy{k}.npz',
            to_patient=anatomy.to_patient,
            labels=np.array([n for n, _ in found], dtype=np.int64),
            margins=np.array([one.margin for _, one in found]),
        )


def _read_anatomies(folder: Path) -> tuple[Anatomy, ...]:
    found = []
    for k in range(len(list(folder.glob('anatomy*.npz')))):
        with np.load(folder / f'anatomy{k}.npz') as file:
            structures = {
                int(label): Structure(name=str(label), role='obstacle', margin=float(margin))
                for label, margin in zip(file['labels'], file['margins'], strict=True)
            }
            matrix = file['to_patient']
        # Pages of the file are shared by all workers, and only those around the plan are read.
        labels = np.load(folder / f'labels{k}.npy', mmap_mode='r')
        found.append(Anatomy(labels=labels, to_patient=matrix, structures=structures))
    return tuple(found)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Numbers(SteeringLimits):
    """Limits, and the radius of a hit."""

    radius: float = constant(
        1e-3, 'm', 'largest distance of the tip from a hit target', open_low=True
    )


class _Inputs(NamedTuple):
    """Content of the files of a scenario."""

    plan: Plan
    path: PlannedPath
    line: Line
    needle: NeedleParameters
    steering: SteeringParameters
    clearance: Clearance
    model: SteeringModel  #: nominal model


def _holds(anatomy: Anatomy, point: FloatArray) -> bool:
    frame = image_frame(anatomy)
    index = frame.of_patient(point) / frame.spacing
    ends = np.array(anatomy.labels.shape) - 0.5
    return bool((index >= -0.5 - _ROUNDED).all() and (index <= ends + _ROUNDED).all())


def absent_layers(count: int) -> dict[str, str]:
    """Return the reason for each variable of a layer that a plan with fewer layers has not."""
    return dict.fromkeys(LAYERS[count:], f'is not in the plan, which has {count} layers')


def _check(plan: Plan, inputs: _Inputs, limits: SteeringLimits) -> None:
    """Raise `ParameterError` if a plan is not of these inputs and limits."""
    # A straight needle in open loop needs no guide.
    if limits.guide_limit or plan.guide.any():
        steps = ExecutiveSettings(guide_limit=limits.guide_limit, guide_step=limits.guide_step)
        check_plan(plan, steps)
    radius = needle_radius(inputs.needle)
    if abs(radius - plan.radius) > _SAME_RADIUS:
        raise ParameterError(
            f'the needle {plan.needle} has a radius of {1e3 * radius:.4g} mm, and in the plan '
            f'{1e3 * plan.radius:.4g} mm: plan again'
        )
    found = simulate_insertion(
        inputs.clearance, inputs.line, inputs.needle, inputs.steering, plan.depths, plan.guide,
        plan.roll,
    ).clearances  # fmt: skip
    k = int(np.abs(found - plan.clearances).argmax())
    if abs(found[k] - plan.clearances[k]) > _SAME:
        raise ParameterError(
            f'the clearance at a depth of {1e3 * plan.depths[k]:.1f} mm is {1e3 * found[k]:.2f} '
            f'mm, and in the plan {1e3 * plan.clearances[k]:.2f} mm: the plan is of another '
            'segmentation, other labels or another needle'
        )


class PlanScenario(Scenario):
    """
    Insert needles along a plan, steered by a law, and measure tip error and clearance.

    `settings` holds the files ``plan`` of `write_plan`, and ``segmentation`` (one or several) and
    ``labels`` of `read_anatomy`, or a ``folder`` that `write_inputs` has written; ``radius`` of a
    hit [m]; ``law``, as for `build_law`; ``prior``, its fields of `SteeringPrior`; ``contact``,
    its fields of `ContactSettings`, without which contact is not monitored; and the fields of
    `SteeringLimits`.
    """

    metrics, at_once = METRICS, 1

    def __init__(self, settings: Mapping[str, Any]) -> None:
        names = [item.name for item in fields(_Numbers)]
        scenario.check_names('settings: ', settings, [*_PARTS, *names])
        given = {name: value for name, value in settings.items() if name in names}
        self._limits = from_values(_Numbers, given, 'settings.')
        if self._limits.turns:
            raise ParameterError(
                f'settings.turns must be 0: a plan has none, got {given["turns"]}'
            )
        self._plan: Plan | None = None  # without one, that of the folder
        self._source, self._images, self._labels = self._sources(settings)
        self._law = str(settings.get('law', DEFAULT_LAW))
        self.files = {**self.files, **scenario.class_files(self._law, find_law(self._law))}
        prior = scenario.mapping('settings: prior', settings.get('prior'))
        self._prior = from_values(SteeringPrior, prior, 'settings.prior.')
        contact = scenario.mapping('settings: contact', settings.get('contact'))
        self._contact = from_values(
            ContactSettings, {'limit': 1.0, **contact}, 'settings.contact.'
        )
        count = MOST_LAYERS if self._plan is None else len(self._plan.layers)
        layers, self.absent = LAYERS[:count], absent_layers(count)
        bevel = 'load of the bevel beyond the nominal one'
        self.variables: Mapping[str, Variable] = {
            **steered_variables(self._prior),
            **dict.fromkeys(
                layers, Variable(1.0, '1', 'stiffness of a layer over its median', 0.01, 100.0)
            ),
            'bevel_x': Variable(0.0, 'N', bevel, -1e3, 1e3),
            'bevel_z': Variable(0.0, 'N', bevel, -1e3, 1e3),
            'entry_x': Variable(0.0, 'm', 'position error of the guide', -1.0, 1.0),
            'entry_z': Variable(0.0, 'm', 'position error of the guide', -1.0, 1.0),
            'entry_radius': Variable(0.0, 'm', 'further position error of the guide', 0.0, 1.0),
            'entry_angle': Variable(0.0, 'rad', 'its direction, from x to z', -2 * pi, 2 * pi),
            'frame_x': Variable(0.0, 'rad', 'error of the insertion direction', -0.5, 0.5),
            'frame_z': Variable(0.0, 'rad', 'error of the insertion direction', -0.5, 0.5),
            **{
                f'registration_{axis}': Variable(
                    0.0, 'm', 'displacement of the patient against the image', -1.0, 1.0
                )
                for axis in 'xyz'
            },
            **{
                f'rotation_{axis}': Variable(
                    0.0, 'rad', 'rotation of the patient about the entry point', -0.5, 0.5
                )
                for axis in 'xyz'
            },
            **{
                f'target_{axis}': Variable(
                    0.0, 'm', 'motion of the target in the patient', -1.0, 1.0
                )
                for axis in 'xyz'
            },
        }

    def _sources(self, settings: Mapping[str, Any]) -> tuple[Path, list[str], str]:
        """Return the file of the plan, and segmentations and labels, or the folder of all."""
        given = [name for name in _FILES if name in settings]
        if 'folder' in settings and not given:
            if not isinstance(settings['folder'], str):
                raise ParameterError(f'settings: folder must be text, got {settings["folder"]!r}')
            return Path(settings['folder']), [], ''
        if given != list(_FILES) or 'folder' in settings:
            raise ParameterError(
                f'settings must have the files {", ".join(_FILES)}, got {", ".join(settings)}'
            )
        images = settings['segmentation']
        images = images if isinstance(images, list) else [images]
        files = [settings['plan'], settings['labels'], *images]
        if not all(isinstance(name, str) for name in files):
            raise ParameterError(f'settings: {", ".join(_FILES)} must be names of files')
        if 'step_length' in settings:
            raise ParameterError('settings: step_length must be omitted: the plan has its depths')
        self._plan = read_plan(settings['plan'])
        read_labels(settings['labels'])
        self.files = {
            **{
                name: scenario.checksum(name, source_files(Path(name).expanduser()))
                for name in files
            },
            **scenario.needle_files(self._plan.needle),
        }
        return Path(settings['plan']), images, settings['labels']

    def check(self) -> None:
        """Raise `ParameterError` for a plan of another anatomy or needle, or beyond the limits."""
        if self._plan is None:
            return
        try:
            _check(self._plan, self._inputs, self._limits)
            self._law_along(self._inputs)
        except (ParameterError, SegmentationError) as error:
            raise ParameterError(f'settings: {error}') from error

    @cached_property
    def _inputs(self) -> _Inputs:
        """Content of the files, which only insertions need."""
        if self._plan is not None:
            plan, anatomies = self._plan, read_anatomy(self._images, self._labels)
            if not any(_holds(one, plan.target) for one in anatomies):
                raise ParameterError(f'the target of the plan is not in {", ".join(self._images)}')
        else:
            plan, anatomies = read_plan(self._source / _PLAN), _read_anatomies(self._source)
        preset = find_needle(plan.needle)
        needle, steering, prior = in_layers(
            plan.layers, preset.needle, preset.steering, self._prior
        )
        clearance = Clearance(
            anatomies,
            np.vstack([plan.entry, plan.path]),
            radius=plan.radius,
            beyond=_BEYOND + self._limits.guide_limit,
        )
        model = SteeringModel(needle, steering, plan.depths, prior)
        line = Line(plan.entry, plan.axes)
        return _Inputs(plan, plan.tip_path, line, needle, steering, clearance, model)

    def insert(self, rows: Sequence[Row], streams: Streams) -> Iterator[dict[str, float]]:
        for row, rng in zip(rows, streams, strict=True):
            yield self._inserted(row, rng)[0]

    def replay(
        self,
        sample: Row,  # noqa: ARG002
        rng: np.random.Generator,  # noqa: ARG002
    ) -> Iterator[MeasuredRun]:
        raise ParameterError('insertions along a plan are not recorded')

    def shaft(self, sample: Row, rng: np.random.Generator) -> FloatArray:
        """Return the complete needle of a sample in the image, shape (k, 3) [m]."""
        return np.asarray(self._inserted(self.row(sample), rng)[1][-1])

    def _inserted(self, row: Row, rng: np.random.Generator) -> tuple[dict[str, float], FloatArray]:
        """Return the metrics of an insertion, and the shafts in the image, shape (n, k, 3)."""
        inputs, seed = self._inputs, path_seed(rng)
        plant, law, roll = self._plant(row, seed), self._law_along(inputs), inputs.plan.roll
        done = steer_sample(law, plant, row, seed, rng, limits=self._limits, roll=roll)
        stopped = done is None
        shafts = self._in_image(row, np.stack(plant.shafts))
        least, _ = least_clearances(
            inputs.clearance, shafts, np.zeros((len(shafts) - 1, 1), dtype=np.int64), 1, _TIGHT
        )
        clearance, tip = float(least[0]) - plant.sag, shafts[-1, -1]
        motion = np.array([row[f'target_{axis}'] for axis in 'xyz']) @ inputs.line.axes
        miss = float(np.linalg.norm(tip - inputs.plan.target - motion))
        hit, clear = not stopped and miss <= self._limits.radius, clearance > 0.0
        metrics = {
            'success': hit and clear, 'hit': hit, 'clear': clear, 'miss': miss,
            'clearance': clearance, 'tip_r': tip[0], 'tip_a': tip[1], 'tip_s': tip[2],
            'stopped': stopped,
        }  # fmt: skip
        return {name: float(value) for name, value in metrics.items()}, shafts

    def _law_along(self, inputs: _Inputs) -> SteeringLaw:
        """Return the law of an insertion along the plan, with the monitoring of contact."""
        plan, path, limits = inputs.plan, inputs.path, self._limits
        law = build_law(self._law, inputs.model, path.tips[-1], limits, plan.roll, path)
        return monitored(law, inputs.model, plan, path, limits, self._contact)

    def _plant(self, row: Row, seed: int) -> _PlannedPlant:
        inputs = self._inputs
        roll, nominal = inputs.plan.roll, max(inputs.steering.bevel_load)
        x = nominal * sin(roll) + row['bevel_x']
        z = nominal * cos(roll) + row['bevel_z']
        size = hypot(x, z)
        needle, steering = true_needle(
            inputs.needle,
            inputs.steering,
            self._prior,
            lengths=(row['bending_length'], row['skin']),
            layers=[row[name] for name in LAYERS[: len(inputs.plan.layers)]],
            bevel=size,
            path_noise=row['path_noise'],
        )
        radius, angle = row['entry_radius'], row['entry_angle']
        origin = row['entry_x'] + radius * cos(angle), row['entry_z'] + radius * sin(angle)
        one = SteeredNeedle(
            needle,
            steering,
            tilt=(row['tilt_x'], row['tilt_z']),
            roll=float(np.arctan2(x, z)) if size else roll,
            seed=seed,
        )
        frame = row['frame_x'], row['frame_z']
        return _PlannedPlant(one, inputs.plan, inputs.line, frame, origin)

    def _in_image(self, row: Row, points: FloatArray) -> FloatArray:
        """Return points of the frame of the plan in the image: without errors the same ones."""
        from scipy.spatial.transform import Rotation

        axes, entry = self._inputs.line.axes, self._inputs.line.entry
        shift, turn = (
            np.array([row[f'{name}_{axis}'] for axis in 'xyz']) @ axes
            for name in ('registration', 'rotation')
        )
        if not (shift.any() or turn.any()):
            return points
        matrix = Rotation.from_rotvec(turn).as_matrix()
        return np.asarray((points - entry - shift) @ matrix + entry)


class _PlannedPlant(SteeringPlant):
    """Plant that keeps the shapes of the shaft."""

    def __init__(
        self,
        needle: SteeredNeedle,
        plan: Plan,
        line: Line,
        frame: tuple[float, float],
        origin: tuple[float, float],
    ) -> None:
        super().__init__(needle, plan.depths, frame, origin)
        self._line = line
        self._error = np.array(origin), np.array(frame)
        self._along = np.linspace(0.0, plan.length, ceil(plan.length / _SPACING) + 1)
        self.shafts: list[FloatArray] = []  #: points of the shaft, shape (k, 3) [m] each
        self.sag = 0.0  #: largest `sag_of` the shaft [m]
        self._keep()

    def _keep(self) -> None:
        # Points ahead of the tip are at the tip.
        points = np.minimum(self._along, self.needle.depth)
        deflections, slopes = inserted_shape(self.needle, points)
        sag = sag_of(slopes[self._along <= points[-1]], float(self._along[1]))
        self.sag = max(self.sag, sag)
        origin, frame = self._error
        deflections = deflections + origin + points[:, np.newaxis] * frame
        self.shafts.append(self._line.points(points, deflections))

    def guide(self, to: GuideSetpoint) -> None:
        # The needle is not turned; its own bevel may have another direction.
        super().guide(to._replace(roll=0.0))
        self._keep()

    def insert(self) -> None:
        begin, end = self.depths[self.step], self.depths[self.step + 1]
        for depth in np.linspace(begin, end, ceil((end - begin) / _SPACING) + 1)[1:-1].tolist():
            self.needle.move(depth=depth)
            self._keep()
        super().insert()
        self._keep()
