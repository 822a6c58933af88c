# SPDX-License-Identifier: Apache-2.0
"""Cost of a control step."""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle
from math import copysign, exp, inf
from typing import Final

from benchmarks.measure import Bar, least_times
from benchmarks.page import Answer, PageSection, Tick
from needle_controller import (
    Adaptive,
    AdaptiveGains,
    Axis,
    InverseDynamics,
    InverseDynamicsGains,
    Law,
    Observer,
    ObserverSettings,
    Pid,
    PidGains,
    Setpoint,
)
from needle_controller.laws.law import SampledLoop
from needle_dynamics import FloatArray, NeedleParameters
import numpy as np

#: Sample period [s], delay in periods, and the largest part of a period that a step may take [%].
PERIOD: Final = 1e-3
DELAY: Final = 1
BUDGET: Final = 5.0

#: Name of the law of the paper, of which there are two more programs.
_PAPER: Final = 'insertion only, no feedback'

#: Calls per job: a single call is too short for the clock.
_CALLS: Final = 100
_ROUNDS: Final = 15

_DEPTH: Final = 0.1
_SPEED: Final = 0.01
_LIMIT: Final = 15.0


class FloatInverseDynamics:
    """
    Inverse dynamics of the paper with a delay, in plain floats of Python, for comparison.

    In contrast to `InverseDynamics`, it has no feedback of deviations from the model.
    """

    def __init__(self, parameters: NeedleParameters, gains: InverseDynamicsGains) -> None:
        p, h = parameters, PERIOD
        rate = p.viscous_friction / p.moving_mass
        self.fall = exp(-rate * h)
        self.flow = (1.0 - self.fall) / rate
        self.dry, self.viscous = p.coulomb_friction, p.viscous_friction
        self.kp, self.kv, self.breakaway = gains.kp, gains.kv, gains.breakaway_speed
        self.last = 0.0

    def command(
        self, position: float, speed: float, target: float, velocity: float, acceleration: float
    ) -> float:
        """Return the force [N] for measured depth and velocity and a target."""
        fall, drive = self.fall, copysign(self.dry, speed) if speed else 0.0
        steady = (self.last - drive) / self.viscous
        position += self.flow * speed + (PERIOD - self.flow) * steady
        speed = fall * speed + (1.0 - fall) * steady
        ahead = speed + PERIOD * (
            acceleration + self.kp * (target - position) + self.kv * (velocity - speed)
        )
        lean = min(max(ahead / self.breakaway, -1.0), 1.0)
        force = (ahead - fall * speed) * self.viscous / (1.0 - fall) + lean * self.dry
        self.last = min(max(force, -_LIMIT), _LIMIT)
        return self.last


class NumpyInverseDynamics:
    """
    Inverse dynamics of the paper with a delay, in matrices of NumPy, for comparison.

    In contrast to `InverseDynamics`, it has no feedback of deviations from the model.
    """

    def __init__(self, parameters: NeedleParameters, gains: InverseDynamicsGains) -> None:
        self.p, self.gains = parameters, gains
        self.last = 0.0

    def command(self, position: float, speed: float, target: FloatArray) -> float:
        """Return the force [N] for measured depth and velocity and a target of shape (3,)."""
        p, g, h = self.p, self.gains, PERIOD
        rate = p.viscous_friction / p.moving_mass
        fall = exp(-rate * h)
        drive = np.sign(speed) * p.coulomb_friction
        steady = (self.last - drive) / p.viscous_friction
        state = np.array([position, speed])
        flow = np.array([[1.0, (1.0 - fall) / rate], [0.0, fall]])
        push = np.array([h - (1.0 - fall) / rate, 1.0 - fall])
        state = flow @ state + push * steady
        wanted = target[2] + np.array([g.kp, g.kv]) @ (target[:2] - state)
        ahead = state[1] + h * wanted
        linear = (ahead - fall * state[1]) * p.viscous_friction / (1.0 - fall)
        lean = np.clip((state[1] + h * wanted) / g.breakaway_speed, -1.0, 1.0)
        self.last = float(np.clip(linear + lean * p.coulomb_friction, -_LIMIT, _LIMIT))
        return self.last


def jobs() -> dict[str, Callable[[], object]]:
    """Return the measured control steps by name, for a moving needle."""
    parameters = NeedleParameters.preset('phantom')
    goal, still = Setpoint(_DEPTH + _SPEED * PERIOD, _SPEED), Setpoint(0.0)
    observer = Observer(parameters, ObserverSettings(), PERIOD)
    samples = cycle([(0.01, 0.001), (0.012, 0.0012), (0.009, 0.0009)])
    clock = [0.0]

    def observe() -> float:
        clock[0] += PERIOD
        # Oscillation within the tissue, with an unlimited duration.
        phase = clock[0] % 10.0
        depth = _DEPTH + _SPEED * min(phase, 10.0 - phase)
        observer.update(
            round(1e9 * clock[0]), depth, _SPEED if phase < 5.0 else -_SPEED, next(samples)
        )
        return observer.load

    found: dict[str, Callable[[], object]] = {}
    along = _laws(Axis.insertion(parameters), PidGains())
    around = _laws(Axis.rotation(parameters), PidGains(kp=1e-6, ki=1e-6, kd=1e-8))
    for name, law in along.items():
        loop = SampledLoop(law, DELAY, _LIMIT)
        rotation = SampledLoop(around[name], DELAY, inf)

        def physical(
            loop: SampledLoop = loop, rotation: SampledLoop = rotation, load: float = 0.0
        ) -> float:
            rotation.command(0.0, 0.0, still)
            return loop.command(_DEPTH, _SPEED, goal, load)

        found[name] = physical
        found[f'{name}, with observer'] = _observed(physical, observe)
    found['observer'] = observe
    gains = InverseDynamicsGains(bandwidth=0.0)
    axis = Axis.insertion(parameters)
    alone = SampledLoop(InverseDynamics(axis=axis, gains=gains, period=PERIOD), DELAY, _LIMIT)
    numpy, floats = (
        NumpyInverseDynamics(parameters, gains),
        FloatInverseDynamics(parameters, gains),
    )
    wanted = goal.position, goal.velocity, goal.acceleration
    target = np.array(wanted)
    found[_PAPER] = lambda: alone.command(_DEPTH, _SPEED, goal)
    found['the same in NumPy'] = lambda: numpy.command(_DEPTH, _SPEED, target)
    found['the same in Python floats'] = lambda: floats.command(_DEPTH, _SPEED, *wanted)
    return found


def _observed(physical: Callable[..., float], observe: Callable[[], float]) -> Callable[[], float]:
    """Return the control step of a law with the load from the observer."""
    return lambda: physical(load=observe())


def _laws(axis: Axis, pid: PidGains) -> dict[str, Law]:
    """Return the laws of an axis by name; only the gains of PID depend on the axis."""
    return {
        'adaptive': Adaptive(axis=axis, gains=AdaptiveGains(), period=PERIOD),
        'inverse_dynamics': InverseDynamics(
            axis=axis, gains=InverseDynamicsGains(), period=PERIOD
        ),
        'pid': Pid(axis=axis, gains=pid, period=PERIOD),
    }


def compare(tick: Tick) -> Answer:
    """Measure the cost of a control step."""

    def several(job: Callable[[], object]) -> Callable[[], None]:
        def run() -> None:
            for _ in range(_CALLS):
                job()

        return run

    tick('control step')
    times = {
        name: value / _CALLS
        for name, value in least_times(
            {name: several(job) for name, job in jobs().items()}, _ROUNDS
        ).items()
    }
    rows = []
    for name, value in times.items():
        ratio = f'{value / times[_PAPER]:.2f} x' if name.startswith('the same') else ''
        rows.append((name, f'{1e6 * value:.2f}', f'{100.0 * value / PERIOD:.2f} %', ratio))
    section = PageSection(
        'Cost of a control step',
        ('control step', 'cost [us]', 'of 1 ms', 'over ours'),
        rows,
        f'Preset phantom, two modes, delay of {DELAY} period, {1.0 / PERIOD:g} Hz. A step has '
        f'insertion and rotation, with feedback. *{_PAPER.capitalize()}* is the law of the paper, '
        'which the two programs below it compute, too; ours also checks its arguments.',
    )
    bars = [
        Bar(
            f'{name}, with observer, of 1 ms',
            100.0 * times[f'{name}, with observer'] / PERIOD,
            BUDGET,
            '%',
        )
        for name in ('adaptive', 'inverse_dynamics', 'pid')
    ]
    return [section], bars
