# SPDX-License-Identifier: Apache-2.0
"""Insert sampled flexible needles to a depth, under a control law or in open loop."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import copysign, nan
from typing import Any, Final, NamedTuple

import needle_controller as control
from needle_controller.gains import LAW_OF
from needle_controller.in_loop.observed import TipObserver
from needle_controller.in_loop.sampled import motion_of, run_insertions
from needle_controller.laws.law import Law, require_complete
from needle_controller.observer.observer import check_period
from needle_controller.observer.settings import ObserverSettings
from needle_controller.safety.safety import Guard
from needle_controller.stability import Uncertainty
from needle_dynamics import find_needle, FloatArray, NeedleModel, NeedleParameters, simulate_batch
from needle_dynamics.parameters import PAPER_NEEDLE
from needle_ros import contract
from needle_ros.errors import ParameterError
from needle_ros.settings import check_choice, constant, from_values, same_field
from needle_ros.timing import NANOSECONDS
from needle_study import scenario
from needle_study.scenario import MeasuredRun, Metric, Row, Scenario, Streams, Variable
import numpy as np
from scipy.optimize import brentq

OPEN_LOOP: Final = 'open loop'
CONTROLLERS: Final = (*control.LAWS, OPEN_LOOP)  #: control laws, and the open loop
_REST: Final = 1e-5  #: largest speed of a needle at rest [m/s]
_MOST: Final = 1_000_000  #: most samples of an insertion
_AT_ONCE: Final = 32  #: insertions per batch, whose samples are all in memory

#: Settings that are mappings or words.
_PARTS: Final = (
    'needle', 'constants', 'controller', 'gains', 'uncertainty', 'reference', 'observer'
)  # fmt: skip
#: Settings of the observer without those of the wrench, and of a tip sensor with exposure.
_OBSERVER: Final = (
    'irregularity', 'initial_deflection', 'tip_force', 'tip_force_time', 'tip_noise', 'history'
)  # fmt: skip

METRICS: Final[Mapping[str, Metric]] = {
    'error': Metric('m', 'distance of the needle from the target depth at the end'),
    'hit': Metric('', 'the needle ends within the tolerance of the target depth'),
    'overshoot': Metric('m', 'largest overshoot of the target depth'),
    'following': Metric('m', 'root mean square of the tracking error'),
    'force': Metric('N', 'largest force'),
    'deflection': Metric('m', 'largest tip deflection'),
    'rest': Metric('s', 'time until the needle remains at rest'),
    'reversals': Metric('1', 'reversals of the velocity after the end of the reference'),
    'stopped': Metric('', 'the guard stopped the needle'),
    'left': Metric('', 'the needle left its range of depths'),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class InsertionStudy(control.ReferenceLimits):
    """Settings of the scenario that are the same for all samples."""

    rate: float = same_field(control.ControllerSettings, 'rate')
    delay: float = same_field(control.ControllerSettings, 'delay')
    force_limit: float = same_field(control.ControllerSettings, 'force_limit')
    speed_limit: float = same_field(control.SafetyLimits, 'speed')
    error_limit: float = same_field(control.SafetyLimits, 'tracking_error')
    deflection_limit: float = same_field(control.SafetyLimits, 'tip_deflection')
    wait: float = constant(1.0, 's', 'time after the end of the reference', open_low=True)
    push: float = constant(3.0, 'N', 'force of the open loop', open_low=True)
    tolerance: float = constant(1e-4, 'm', 'largest error of a hit', open_low=True)
    step: float = constant(2e-4, 's', 'longest step of the simulated needle', low=1e-7)


class _Insertion(NamedTuple):
    #: Insertion depth [m], velocity [m/s] and tip deflection [m] at the samples, shape (3, k + 1).
    motion: FloatArray
    commands: FloatArray  #: command of each sample [N], shape (k,)
    forces: FloatArray  #: force that acts from each sample on [N], shape (k,)
    #: Errors of measured depth [m], velocity [m/s] and tip deflection [m], shape (k, 3).
    noise: FloatArray
    goal: FloatArray  #: reference [m], shape (k + 1,); NaN without a reference
    stopped: float  #: as in `METRICS`
    left: float

    @property
    def measured(self) -> FloatArray:
        """Measured depth [m], velocity [m/s] and deflection [m], (3, k + 1); the last is exact."""
        found = self.motion.copy()
        count = min(len(self.noise), found.shape[1])
        found[:, :count] += self.noise[:count].T
        return found

    def until(self, end: int) -> '_Insertion':
        return self._replace(
            motion=self.motion[:, : end + 1], goal=self.goal[: end + 1],
            noise=self.noise[: end + 1], commands=self.commands[:end], forces=self.forces[:end],
        )  # fmt: skip


class InsertionScenario(Scenario):
    """
    Insert needles that differ from the nominal model to a depth.

    `settings` holds ``needle``, as `find_needle`; nominal ``constants``; ``controller`` of
    `CONTROLLERS` with ``gains`` that are stable for the ``uncertainty``; ``reference`` of
    `REFERENCES`; ``observer``, true or some of its settings; and the fields of `InsertionStudy`.
    """

    metrics, at_once = METRICS, _AT_ONCE

    def __init__(self, settings: Mapping[str, Any]) -> None:
        scenario.check_names(
            'settings: ', settings, [*_PARTS, *InsertionStudy.__dataclass_fields__]
        )
        given = {name: value for name, value in settings.items() if name not in _PARTS}
        self._numbers = from_values(InsertionStudy, given, 'settings.')
        words: dict[str, str] = {}
        for name, valid in (('controller', CONTROLLERS), ('reference', tuple(control.REFERENCES))):
            words[name] = settings.get(name, valid[0])
            check_choice(f'settings: {name}', words[name], valid)
        constants, gains, uncertainty = (
            scenario.mapping(f'settings: {name}', settings.get(name))
            for name in ('constants', 'gains', 'uncertainty')
        )
        needle = settings.get('needle', PAPER_NEEDLE)
        self._needle = from_values(
            NeedleParameters,
            {**asdict(find_needle(needle).needle), **constants},
            'settings.constants.',
        )
        self.files = scenario.needle_files(needle)
        self._kind = control.REFERENCES[words['reference']]
        self._period = 1.0 / self._numbers.rate
        self._limits = control.SafetyLimits(
            speed=self._numbers.speed_limit,
            tracking_error=self._numbers.error_limit,
            tip_deflection=self._numbers.deflection_limit,
        )
        plants = from_values(Uncertainty, uncertainty, 'settings.uncertainty.')
        self._law = self._made(words['controller'], gains, plants)
        self._observer = self._observed(settings.get('observer', False))
        p, numbers = self._needle, self._numbers
        # Upper bound of the duration of an insertion.
        if self._law is None:
            longest = _time(control.Axis.insertion(p), numbers.push, p.length - p.minimum_depth)
        else:
            longest = self._kind(control.Setpoint(p.minimum_depth), p.length, numbers).duration
        samples = (longest + numbers.wait) * numbers.rate
        if samples > _MOST:
            raise ParameterError(
                f'settings: an insertion must have <= {_MOST} samples, and would have up to '
                f'{samples:.3g}: see rate, wait, speed and push'
            )
        deepest, most = p.length, NeedleModel(p).modes.reach * p.length
        self.variables: Mapping[str, Variable] = {
            'target': Variable(0.5 * p.length, 'm', 'target depth', p.minimum_depth, deepest),
            'depth': Variable(
                max(0.1 * p.length, p.minimum_depth), 'm', 'insertion depth at the start',
                p.minimum_depth, deepest,
            ),
            'tip': Variable(0.0, 'm', 'tip deflection at the start', -most, most),
            'coulomb_friction': Variable(1.0, '1', 'mu_s over its nominal value', 0.0, 1e3),
            'viscous_friction': Variable(1.0, '1', 'mu_v over its nominal value', 0.0, 1e3),
            'carriage_mass': Variable(
                p.carriage_mass, 'kg', 'mass moved along with the needle', 0.0, 1e3
            ),
            'tissue_stiffness': Variable(1.0, '1', 'k_a over its nominal value', 0.0, 1e3),
            'tissue_damping': Variable(1.0, '1', 'c_a over its nominal value', 0.0, 1e3),
            'depth_noise': Variable(0.0, 'm', 'standard deviation of a measured depth', 0.0),
            'velocity_noise': Variable(
                0.0, 'm/s', 'standard deviation of a measured velocity', 0.0
            ),
            'force_noise': Variable(
                0.0, 'N', 'standard deviation of the additional force on the needle', 0.0
            ),
            'late': Variable(
                0.0, 'periods', 'delay that is not in the model of the law, to whole periods',
                0.0, 100.0,
            ),
        }  # fmt: skip
        if self._observer is not None:
            usual = ObserverSettings().tip_noise
            self.variables = {
                **self.variables,
                'tip_noise': Variable(
                    usual, 'm', 'standard deviation of a measured tip deflection', 0.0
                ),
            }

    def _observed(self, given: Any) -> TipObserver | None:
        """Return the observer of the law; none for false."""
        if given is False:
            return None
        if self._law is None:
            raise ParameterError(f'settings: observer is for {", ".join(control.LAWS)}')
        chosen = {} if given is True else scenario.mapping('settings: observer', given)
        scenario.check_names('settings: observer: ', chosen, _OBSERVER)
        own = from_values(ObserverSettings, chosen, 'settings.observer.')
        found = TipObserver(self._needle, own, self._period, self._limits.axial_load)
        try:
            check_period(own, self._period)
        except ParameterError as error:
            raise ParameterError(f'settings: observer: {error}') from error
        return found

    def _made(
        self, controller: str, gains: Mapping[str, Any], uncertainty: Uncertainty
    ) -> Law | None:
        p = self._needle
        if controller == OPEN_LOOP:
            if gains:
                raise ParameterError(f'settings: gains are for {", ".join(control.LAWS)}')
            friction = p.coulomb_friction * max(1.0, p.withdrawal_friction)
            if not self._numbers.push > friction:
                raise ParameterError(
                    f'settings.push must be > Coulomb friction, {friction:g} N, got '
                    f'{self._numbers.push!r}'
                )
            return None
        require_complete(p)
        usual = control.DEFAULT_GAINS[controller]['insertion']
        chosen = from_values(type(usual), {**asdict(usual), **gains}, 'settings.gains.')
        axis = control.Axis.insertion(p)
        law = LAW_OF[type(usual)](axis=axis, gains=chosen, period=self._period)
        plants = uncertainty.axes(axis, carriage=True)
        control.check_stability(
            law, int(self._numbers.delay), f'{controller} gains', plants=plants
        )
        return law

    def insert(self, rows: Sequence[Row], streams: Streams) -> Iterator[dict[str, float]]:
        return map(self._metrics_of, rows, self._simulate(rows, streams))

    def replay(self, sample: Row, rng: np.random.Generator) -> Iterator[MeasuredRun]:
        """Yield joints, tip and commands at each sample up to a stop, and the target."""
        row = self.row(sample)
        (run,) = self._simulate([row], [rng])
        yield MeasuredRun(contract.TARGET, 0, (0.0, row['target'], 0.0))
        # The effort acted up to the sample.
        columns = [run.motion[0], *run.measured, np.concatenate([[0.0], run.forces])]
        for k, row_of in enumerate(np.stack(columns, axis=1).tolist()):
            stamp = round(k * self._period * NANOSECONDS)
            depth, position, velocity, tip, effort = row_of
            values = (position, 0.0, velocity, 0.0, effort, 0.0)
            yield MeasuredRun(contract.JOINT_STATES, stamp, values)
            at = (0.0, depth, tip)
            yield MeasuredRun(contract.TIP_DEFLECTION, stamp, at)
            if k < len(run.commands):
                force = (0.0, float(run.commands[k]), 0.0)
                yield MeasuredRun(contract.WRENCH_COMMAND, stamp, (*force, 0.0, 0.0, 0.0))

    def _truth(self, row: Row) -> NeedleParameters:
        p, stiffness = self._needle, row['tissue_stiffness']
        factors = ('coulomb_friction', 'viscous_friction', 'tissue_damping', 'tissue_stiffness')
        return replace(
            p,
            **{name: row[name] * getattr(p, name) for name in factors},
            layer_stiffnesses=tuple(stiffness * one for one in p.layer_stiffnesses),
            carriage_mass=row['carriage_mass'],
        )

    def _simulate(self, rows: Sequence[Row], streams: Streams) -> Iterator[_Insertion]:
        law = self._law
        if law is None:
            return self._open(rows, streams)
        return self._closed(law, rows, streams)

    def _noise(self, row: Row, rng: np.random.Generator, count: int) -> FloatArray:
        """Return the noise of depth, velocity, force and tip for each period, (count, 4)."""
        sizes = [row[name] for name in ('depth_noise', 'velocity_noise', 'force_noise')]
        noise = np.zeros((count, 4))
        noise[:, :3] = sizes * rng.standard_normal((count, 3))
        if 'tip_noise' in row:
            noise[:, 3] = row['tip_noise'] * rng.standard_normal(count)
        return noise

    def _closed(self, law: Law, rows: Sequence[Row], streams: Streams) -> Iterator[_Insertion]:
        numbers, models, references, noises = self._numbers, [], [], []
        for row, rng in zip(rows, streams, strict=True):
            models.append(NeedleModel(self._truth(row)))
            # The reference starts at the measured depth.
            begin = row['depth'] + row['depth_noise'] * float(rng.standard_normal())
            reference = self._kind(control.Setpoint(begin), row['target'], numbers)
            count = max(1, round((reference.duration + numbers.wait) * numbers.rate))
            references.append(reference)
            noises.append(self._noise(row, rng, count))
        lates = [round(row['late']) for row in rows]
        delay = int(numbers.delay)
        found = run_insertions(
            law,
            models,
            [
                model.state_at(row['depth'], row['tip'])
                for model, row in zip(models, rows, strict=True)
            ],
            references,
            noises,
            lates,
            delay=delay,
            limit=numbers.force_limit,
            step=numbers.step,
            observer=self._observer,
        )
        for noise, late, one in zip(noises, lates, found, strict=True):
            acting = np.concatenate([np.zeros(delay + late), one.commands])[: len(noise)]
            run = _Insertion(
                one.motion, one.commands, acting + noise[:, 2], noise[:, [0, 1, 3]], one.goal, 0.0,
                float(one.completed < len(noise)),
            ).until(one.completed)  # fmt: skip
            end = self._stop(run)
            yield run if end is None else run._replace(stopped=1.0, left=0.0).until(end)

    def _stop(self, run: _Insertion) -> int | None:
        """Return the sample of the stop by the guard, or None."""
        depth, velocity, tip = run.measured
        samples = (depth, velocity, run.goal - depth, tip)
        # Limits are intervals: nearly always the extremes are within them, and so all samples.
        extremes = [(one.min(), one.min(), one.max(), one.max()) for one in samples]
        if self._violated(np.transpose(extremes)) is None:
            return None
        return self._violated(np.stack(samples, axis=1))

    def _violated(self, samples: FloatArray) -> int | None:
        """Return the first row of depth, velocity, error and deflection that the guard rejects."""
        guard = Guard(self._limits, (self._needle.minimum_depth, self._needle.length))
        for k, (depth, velocity, error, tip) in enumerate(samples.tolist()):
            measured = control.Measurement(time=0.0, depth=depth, velocity=velocity)
            if guard.encoders(measured) or guard.tracking(error) or guard.tip(tip):
                return k
        return None

    def _open(self, rows: Sequence[Row], streams: Streams) -> Iterator[_Insertion]:
        """Simulate insertions under a constant force, for the duration of the nominal needle."""
        numbers, nominal = self._numbers, control.Axis.insertion(self._needle)
        models, starts, commands, noise = [], [], [], []
        for row, rng in zip(rows, streams, strict=True):
            models.append(NeedleModel(self._truth(row)))
            starts.append(models[-1].state_at(row['depth'], row['tip']))
            distance = row['target'] - row['depth']
            force = copysign(numbers.push, distance)
            pushed = round(_time(nominal, force, distance) * numbers.rate)
            count = pushed + max(1, round(numbers.wait * numbers.rate))
            commands.append(np.where(np.arange(count) < pushed, force, 0.0))
            noise.append(self._noise(row, rng, count))
        forces = np.zeros((len(rows), max(map(len, commands))))
        for line, pushes, blur in zip(forces, commands, noise, strict=True):
            line[: len(pushes)] = pushes + blur[:, 2]
        batch = simulate_batch(
            [model.parameters for model in models],
            starts,
            forces,
            duration=forces.shape[1] * self._period,
            interval=self._period,
            step=numbers.step,
            workers=1,
        )
        for k, (model, pushes, blur) in enumerate(zip(models, commands, noise, strict=True)):
            count = len(pushes)
            done = min(round(batch.completed[k] * numbers.rate), count)
            yield _Insertion(
                motion_of(model, batch.states[k]), pushes, forces[k], blur[:, [0, 1, 3]],
                np.full(count + 1, nan), nan, float(done < count),
            ).until(done)  # fmt: skip

    def _metrics_of(self, row: Row, run: _Insertion) -> dict[str, float]:
        (depth, velocity, tip), target = run.motion, row['target']
        error = abs(target - float(depth[-1]))
        beyond = copysign(1.0, target - row['depth']) * (depth - target)
        moving = np.flatnonzero(np.abs(velocity) > _REST)
        still = 0 if not len(moving) else int(moving[-1]) + 1
        after = velocity[-(1 + round(self._numbers.wait * self._numbers.rate)) :]
        directions = np.sign(after[np.abs(after) > _REST])
        whole = not (run.left or run.stopped == 1.0)
        return {
            'error': error,
            'hit': float(whole and error <= self._numbers.tolerance),
            'overshoot': max(0.0, float(beyond.max())),
            'following': float(np.sqrt(np.square(run.goal - depth).mean())),
            'force': float(np.abs(run.forces).max(initial=0.0)),
            'deflection': float(np.abs(tip).max()),
            'rest': still * self._period if whole and still < len(velocity) else nan,
            'reversals': float(np.count_nonzero(np.diff(directions))) if whole else nan,
            'stopped': run.stopped,
            'left': run.left,
        }


def _time(axis: control.Axis, force: float, distance: float) -> float:
    """Return the time in which a constant force moves an axis by a distance, from rest [s]."""
    if distance == 0.0:
        return 0.0

    def missing(time: float) -> float:
        return abs(distance) - abs(axis.propagate(0.0, 0.0, force, time)[0])

    most = 1e-3
    while missing(most) > 0.0:
        most *= 2.0
    return float(brentq(missing, 0.0, most, xtol=1e-9))
