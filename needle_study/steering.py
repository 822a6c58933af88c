# SPDX-License-Identifier: Apache-2.0
"""Insert sampled needles to a target, steered by a law or in open loop."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from math import nan
from typing import Any, Final

from needle_controller import OutOfReachError, SteeringModel, SteeringPrior
from needle_controller.steering import simulation
from needle_controller.steering.checked_law import expected_of
from needle_controller.steering.law import (
    build_law,
    DEFAULT_LAW,
    find_law,
    LawError,
    SteeringFaultError,
    SteeringLaw,
)
from needle_controller.steering.settings import SIMULATION_LIMITS, SteeringLimits, step_depths
from needle_dynamics import DEFAULT_NEEDLE, find_needle, insert_batch
from needle_dynamics.simulated.tip_sensor import TipErrorParameters
from needle_dynamics.steering.parameters import longest_insertion
from needle_ros import contract
from needle_ros.errors import ParameterError
from needle_ros.settings import constant, from_values, same_field
from needle_ros.timing import NANOSECONDS
from needle_study import scenario
from needle_study.scenario import MeasuredRun, Metric, Row, Scenario, Streams, Variable
import numpy as np

#: Law of a guide at rest, for which a batch is simulated without a law.
_OPEN_LOOP: Final = 'open_loop'

_SPEED: Final = 0.01  #: insertion speed of a replay [m/s]
_JOINTS: Final = contract.steered_states(efforts=False)
_EXACT: Final = simulation.SteppedTipErrors()  # of a sensor with white noise alone
_SEEDS: Final = 2**63  # upper bound of the seeds of paths
_SHORTEST: Final = 1e-6  # lower bound of times and lengths of errors [s, m]
_OF_BEVEL: Final = 'load of the bevel where it is largest; in other layers in proportion'
_AT_ONCE: Final = 256  #: insertions per batch, which are in memory together
_PARTS: Final = ('needle', 'constants', 'prior', 'law')  #: settings that are mappings or words

#: Variables of the errors of the tip sensor beyond white noise and losses.
_SENSOR_ERRORS: Final[Mapping[str, Variable]] = {
    item.name: Variable(
        getattr(_EXACT, item.name),
        item.metadata['unit'],
        item.metadata['description'],
        _SHORTEST if item.metadata['open_low'] else 0.0,
    )
    for item in fields(TipErrorParameters)
    if item.name != 'dropout'
}

METRICS: Final[Mapping[str, Metric]] = {
    'miss': Metric('m', 'distance of the tip from the target at the end'),
    'hit': Metric('', 'the tip ends within the hit radius of the target'),
    'tip_x': Metric('m', 'final tip position, in the frame of the sensor'),
    'tip_z': Metric('m', 'final tip position, in the frame of the sensor'),
    'guide_travel': Metric('m', 'distance traveled by the guide'),
    'turns': Metric('1', 'number of needle rotations'),
    'load': Metric('N', 'largest lateral force on the guide after its motions'),
    'refused': Metric('', 'the target was rejected as outside the reachable set'),
    'stopped': Metric('', 'the law stopped the insertion before the target depth'),
    'warned': Metric('', 'a warning before the target depth: target outside the reachable set'),
    'expected_x': Metric('m', 'expected final tip position of the law'),
    'expected_z': Metric('m', 'expected final tip position of the law'),
    'covered': Metric('', 'the tip is in the 95 % ellipse of the law'),
}


def steered_variables(prior: SteeringPrior) -> dict[str, Variable]:
    """Return the variables of a needle and its tip sensor in any steered insertion."""
    return {
        'bending_length': Variable(1.0, '1', 'bending length over its nominal value', 0.1, 10),
        'skin': Variable(
            1.0, '1', 'skin over tissue stiffness, relative to its nominal value', 0.0, 1e3
        ),
        'tilt_x': Variable(0.0, 'rad', 'tilt of the guide', -0.5, 0.5),
        'tilt_z': Variable(0.0, 'rad', 'tilt of the guide', -0.5, 0.5),
        'path_noise': Variable(
            prior.path_noise, 'rad^2/m', 'variance of the direction of the path', 0.0
        ),
        'tip_noise': Variable(prior.noise, 'm', 'standard deviation of a tip measurement', 0.0),
        'lost': Variable(0.0, '1', 'fraction of lost tip measurements', 0.0, 1.0),
        **_SENSOR_ERRORS,
    }


def path_seed(rng: np.random.Generator) -> int:
    """Draw the seed of the noise of a path."""
    return int(rng.integers(_SEEDS))


def steer_sample(
    law: SteeringLaw,
    plant: simulation.SteeringPlant,
    row: Row,
    seed: int,
    rng: np.random.Generator,
    *,
    limits: SteeringLimits,
    interval: float = _EXACT.interval,
    watch: Callable[[simulation.SteeringPlant], object] | None = None,
    roll: float = 0.0,
) -> simulation.SteeringRun | None:
    """Insert a needle with the sensor of a sample; return None if the law stops the insertion."""
    errors = simulation.SteppedTipErrors(
        interval=interval, dropout=row['lost'], **{name: row[name] for name in _SENSOR_ERRORS}
    )
    sensor = simulation.SteppedTipSensor(plant, row['tip_noise'], errors, seed, rng, rng)
    try:
        return simulation.simulate_steering(law, plant, sensor, watch, limits, roll)
    except LawError:
        raise
    except SteeringFaultError:
        return None


@dataclass(frozen=True, slots=True, kw_only=True)
class SteeringStudy(SteeringLimits):
    """Settings of the scenario that are the same for all samples; its limits are of the law."""

    depth: float = constant(0.1, 'm', 'depth of the target', open_low=True)
    hit_radius: float = constant(1e-3, 'm', 'largest miss of a hit', open_low=True)
    interval: float = same_field(simulation.SteppedTipErrors, 'interval')


class SteeringScenario(Scenario):
    """
    Steer needles that differ from the nominal model to a target.

    `settings` holds ``needle``, as `find_needle`; nominal ``constants``; ``prior``, their
    uncertainty; ``law``, as for `build_law`; and the fields of `SteeringStudy`.
    """

    metrics, at_once = METRICS, _AT_ONCE

    def __init__(self, settings: Mapping[str, Any]) -> None:
        scenario.check_names(
            'settings: ', settings, [*_PARTS, *SteeringStudy.__dataclass_fields__]
        )
        given = {name: value for name, value in settings.items() if name not in _PARTS}
        self._numbers = numbers = from_values(
            SteeringStudy, {**asdict(SIMULATION_LIMITS), **given}, 'settings.'
        )
        needle = settings.get('needle', DEFAULT_NEEDLE)
        nominal = find_needle(needle)
        self.files = scenario.needle_files(needle)
        self._law = str(settings.get('law', DEFAULT_LAW))
        self.files |= scenario.class_files(self._law, find_law(self._law))
        constants = scenario.mapping('settings: constants', settings.get('constants'))
        try:
            self._needle, self._steering, _ = nominal.changed(constants)
        except ParameterError as error:
            raise ParameterError(f'settings.constants: {error}') from error
        prior = scenario.mapping('settings: prior', settings.get('prior'))
        self._prior = from_values(SteeringPrior, prior, 'settings.prior.')
        reach = longest_insertion(self._needle, self._steering)
        if numbers.depth > reach:
            raise ParameterError(
                f'settings.depth must be <= {reach:g} m, the length of the needle without its '
                f'free length, got {numbers.depth:g} m'
            )
        self._depths = step_depths(numbers.depth, numbers.step_length, name='settings.step_length')
        bevel, length = max(self._steering.bevel_load), self._needle.length
        self.variables: Mapping[str, Variable] = {
            **dict.fromkeys(
                ('target_x', 'target_z'),
                Variable(0.0, 'm', 'lateral position of the target', -length, length),
            ),
            **steered_variables(self._prior),
            'bevel_x': Variable(0.0, 'N', _OF_BEVEL, -1e3, 1e3),
            'bevel_z': Variable(bevel, 'N', _OF_BEVEL, -1e3, 1e3),
            'frame_x': Variable(0.0, 'rad', 'rotation of the frame of the sensor', -0.5, 0.5),
            'frame_z': Variable(0.0, 'rad', 'rotation of the frame of the sensor', -0.5, 0.5),
        }

    def check(self) -> None:
        """Raise `ParameterError` if the law cannot be constructed with these limits."""
        if self._law == _OPEN_LOOP:
            return
        try:
            build_law(self._law, self._model, (0.0, 0.0), self._numbers)
        except OutOfReachError:  # of this target alone
            pass
        except ParameterError as error:
            raise ParameterError(f'settings: {error}') from error

    @cached_property
    def _model(self) -> SteeringModel:
        return SteeringModel(self._needle, self._steering, self._depths, self._prior)

    def insert(self, rows: Sequence[Row], streams: Streams) -> Iterator[dict[str, float]]:
        truths = [self._truth(row, rng) for row, rng in zip(rows, streams, strict=True)]
        steered = map(self._steered, truths, rows, streams)
        each = self._open(truths) if self._law == _OPEN_LOOP else steered
        for row, found in zip(rows, each, strict=True):
            x, z = (found.get(f'tip_{axis}', nan) - row[f'target_{axis}'] for axis in 'xz')
            miss = float(np.hypot(x, z))
            yield {**found, 'miss': miss, 'hit': float(miss <= self._numbers.hit_radius)}

    def _truth(self, row: Row, rng: np.random.Generator) -> simulation.GroundTruth:
        bevel = np.array([row['bevel_x'], row['bevel_z']])
        needle, steering = simulation.true_needle(
            self._needle,
            self._steering,
            self._prior,
            lengths=(row['bending_length'], row['skin']),
            bevel=float(np.hypot(*bevel)),
            path_noise=row['path_noise'],
        )
        return simulation.GroundTruth(
            needle=needle,
            steering=steering,
            tilt=(row['tilt_x'], row['tilt_z']),
            bevel=bevel,
            frame=np.array([row['frame_x'], row['frame_z']]),
            seed=path_seed(rng),
        )

    def _open(self, truths: Sequence[simulation.GroundTruth]) -> Iterable[dict[str, float]]:
        depth = self._depths[-1]
        tilts = np.array([truth.tilt for truth in truths])[:, np.newaxis, :]
        rolls = np.array([np.arctan2(*truth.bevel) for truth in truths])[:, np.newaxis]
        tips = insert_batch(
            [truth.needle for truth in truths],
            [truth.steering for truth in truths],
            self._depths,
            tilts=np.broadcast_to(tilts, (len(truths), len(self._depths), 2)),
            rolls=np.broadcast_to(rolls, (len(truths), len(self._depths))),
            seeds=[truth.seed for truth in truths],
            workers=1,
        )
        frames = np.array([truth.frame for truth in truths])
        return [
            {'tip_x': x, 'tip_z': z, 'guide_travel': 0.0, 'turns': 0.0}
            for x, z in (tips[:, -1, [0, 2]] + frames * depth).tolist()
        ]

    def replay(self, sample: Row, rng: np.random.Generator) -> Iterator[MeasuredRun]:
        """Yield the target, and joints and tip after each step; the insertion speed is 1 cm/s."""
        row = self.row(sample)
        tilt = row['tilt_x'], row['tilt_z']
        still, messages = [0.0] * len(_JOINTS.joints), list[MeasuredRun]()

        def watch(plant: simulation.SteeringPlant) -> None:
            one = plant.needle
            stamp = round(one.depth / _SPEED * NANOSECONDS)
            joints = (one.depth, *one.guide, *tilt, one.roll, *still)
            messages.append(MeasuredRun(_JOINTS, stamp, joints))
            x, z = plant.tip.tolist()
            messages.append(MeasuredRun(contract.TIP_DEFLECTION, stamp, (x, one.depth, z)))

        self._steered(self._truth(row, rng), row, rng, watch)
        target = (row['target_x'], float(self._depths[-1]), row['target_z'])
        yield MeasuredRun(contract.TARGET, 0, target)
        yield from messages

    def _steered(
        self,
        truth: simulation.GroundTruth,
        row: Row,
        rng: np.random.Generator,
        watch: Callable[[simulation.SteeringPlant], object] | None = None,
    ) -> dict[str, float]:
        try:
            target = row['target_x'], row['target_z']
            law = build_law(self._law, self._model, target, self._numbers)
        except OutOfReachError:
            return {'refused': 1.0}

        metrics, plant = {'refused': 0.0, 'stopped': 0.0}, truth.plant(self._depths)
        limits, interval = self._numbers, self._numbers.interval
        done = steer_sample(
            law, plant, row, truth.seed, rng, limits=limits, interval=interval, watch=watch
        )
        if done is None:
            return {**metrics, 'stopped': 1.0}
        tip = plant.tip
        metrics |= {
            'tip_x': float(tip[0]), 'tip_z': float(tip[1]), 'guide_travel': done.travel,
            'turns': float(done.turns), 'load': done.load,
        }  # fmt: skip
        estimate = expected_of(law)
        if estimate is not None:
            metrics |= {
                'expected_x': float(estimate.mean[0]),
                'expected_z': float(estimate.mean[1]),
                'covered': float(estimate.contains(tip)),
                'warned': float(bool(done.warning)),
            }
        return metrics
