# SPDX-License-Identifier: Apache-2.0
"""The observer against exact conditional means, its own statistics, and the simulated needle."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import islice, pairwise
from math import nan
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from needle_controller import Measurement, Observer, ObserverSettings
from needle_controller.load_estimator import LoadEstimator
from needle_controller.observer.observer import Consistency
from needle_dynamics import (
    FloatArray,
    InsertionDepthError,
    Integrator,
    NeedleError,
    NeedleModel,
    NeedleParameters,
    ParameterError,
    ShapeError,
)
from needle_dynamics.analysis import observability
from needle_dynamics.compiled.step import Interval
from needle_dynamics.linearization import linearize, operating_point
from needle_dynamics.simulated.force_sensor import ForceSensor, ForceSensorParameters
from needle_dynamics.simulated.plant import Plant, PlantSample
from needle_dynamics.simulated.tip_sensor import TipParameters, TipSensor
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.linalg import cholesky, eigh, expm, solve_discrete_lyapunov
from scipy.signal import butter, lfilter

preset = NeedleParameters.preset

PERIOD = 1e-3


def ns(time: float) -> int:
    """Return a stamp [ns] of a time [s]."""
    return round(1e9 * time)


#: Longest step of the plant by default [s], and insertion speed [m/s].
STEP, SPEED = 2e-5, 0.008

#: Needle without a lateral force at the tip, and sensor without offset, as in the plant.
NO_LOADS: dict[str, Any] = {'tip_force': 0.0, 'force_offset': 0.0, 'torque_offset': 0.0}

#: Least depth at which n modes are distinguishable.
LEAST_DEPTH = {1: 0.001, 2: 0.001, 3: 0.03}


def phantom(modes: int = 2, **changes: Any) -> NeedleParameters:
    return preset('phantom', modes=modes, minimum_depth=LEAST_DEPTH[modes], **changes)


class Reference:
    """
    The linear model of the observer, in dense form with matrix exponentials.

    The state is q, p = rho A G q_dot, the impulses of lateral force and moment, the integral of
    the tip deflection, and a lateral force at the tip; depth is frozen at its mean over a sample.
    """

    def __init__(self, parameters: NeedleParameters, options: ObserverSettings) -> None:
        self.model, self.options = NeedleModel(parameters), options
        self.n = parameters.modes
        self.sections = [butter(2, cut, fs=options.filter_rate) for cut in options.cutoffs]
        self.ticks = round(options.filter_rate * PERIOD)
        # Standard deviation of the noise before the low-pass, from its impulse response.
        impulse = np.zeros(20_000)
        impulse[0] = 1.0
        for b, a in self.sections:
            impulse = lfilter(b, a, impulse)
        gain = np.sqrt((impulse**2).sum())
        self.noise = np.array([options.force_noise, options.torque_noise]) / gain

    def low_pass(self, values: FloatArray, memory: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Filter values over the first axis, section by section, sample by sample."""
        memory, result = memory.copy(), []
        for value in values:
            for (b, a), own in zip(self.sections, memory, strict=True):
                read = b[0] * value + own[0]
                own[:] = b[1] * value - a[1] * read + own[1], b[2] * value - a[2] * read
                value = read  # noqa: PLW2901
            result.append(value)
        return np.array(result), memory

    def rates(self, depth: float, speed: float, time: float) -> FloatArray:
        """Matrix of the differential equation at a frozen depth."""
        model, n, p = self.model, self.n, self.model.parameters
        at, rho = model.modes.integrals(depth), p.linear_density
        mass, stiff = rho * at.gram, model.stiffness_matrix(depth, time)
        growth = model.tissue.growth(time)
        to_rate = np.linalg.inv(mass)
        force_q, force_p = -stiff, -p.tissue_damping * at.gram @ to_rate
        # Acceleration of the moving needle, with the momentum that dG/dt takes.
        convected = rho * speed * np.outer(at.value, at.value)
        accel_q = np.linalg.solve(mass, force_q)
        accel_p = np.linalg.solve(mass, force_p - convected @ to_rate)
        layer = int(np.searchsorted(model.tissue.starts, depth, side='right')) - 1
        layers = model.tissue.layers(model.modes)
        above = layers.area[layer], layers.moment[layer]
        a = np.zeros((2 * n + 4, 2 * n + 4))
        a[n : 2 * n, -1] = at.value
        a[:n, n : 2 * n] = to_rate
        a[n : 2 * n, :n] = force_q
        a[n : 2 * n, n : 2 * n] = force_p
        for row, shape, lever in ((0, at.area, 1.0), (1, at.moment, depth)):
            held = growth * (model.tissue.stiffnesses[layer] * shape + above[row])
            a[2 * n + row, :n] = rho * shape @ accel_q + held
            a[2 * n + row, n : 2 * n] = rho * shape @ accel_p
            a[2 * n + row, n : 2 * n] += (
                p.tissue_damping * shape + rho * speed * lever * at.value
            ) @ to_rate
            a[2 * n + row, -1] = rho * shape @ np.linalg.solve(mass, at.value) - lever
        a[2 * n + 1] += (p.length - depth) * a[2 * n]
        a[2 * n + 2, :n] = at.value
        return a

    def noise_root(self, depth: float) -> FloatArray:
        """Root of the density of the noise on p."""
        gram = self.model.modes.integrals(depth).gram
        return np.asarray(self.options.irregularity * cholesky(gram, lower=True), float)

    def prior(self, depth: float) -> tuple[FloatArray, FloatArray]:
        """Root of the covariance of (q, p), and of the memories of the low-pass, at the start."""
        p, n = self.model.parameters, self.n
        at = self.model.modes.integrals(depth)
        squares, normal = eigh(self.model.stiffness_matrix(depth), p.linear_density * at.gram)
        tip = at.value @ normal / np.sqrt(squares)
        size = self.options.initial_deflection / np.sqrt(tip @ tip)
        rates = np.linalg.inv(normal).T
        root = np.zeros((2 * n, 2 * n))
        root[:n, :n], root[n:, n:] = size * normal / np.sqrt(squares), size * rates
        order = 2 * len(self.sections)
        memory = np.zeros((2 * order, 2 * (order + 1)))
        if order:
            # Matrices of the low-pass, from its response to unit vectors.
            a, b = np.empty((order, order)), np.empty(order)
            for k in range(order):
                unit = np.eye(order)[k].reshape(-1, 2)
                a[:, k] = self.low_pass(np.zeros(1), unit)[1].ravel()
            b[:] = self.low_pass(np.ones(1), np.zeros((order // 2, 2)))[1].ravel()
            white = np.linalg.cholesky(solve_discrete_lyapunov(a, np.outer(b, b)))
            steady = np.linalg.solve(np.eye(order) - a, b)
            tick = PERIOD / self.ticks
            impulse = expm(tick * self.rates(depth, 0.0, 0.0))[2 * n : 2 * n + 2, : 2 * n] @ root
            reaction = (impulse**2).sum(axis=1) / tick**2
            for c in range(2):
                rows, first = slice(c * order, (c + 1) * order), c * (order + 1)
                memory[rows, first] = np.sqrt(reaction[c]) * steady
                spread = np.sqrt(self.noise[c] ** 2 + reaction[c])
                memory[rows, first + 1 : first + 1 + order] = spread * white
        return root, memory

    def loads(self, start: FloatArray, steps: FloatArray) -> tuple[FloatArray, FloatArray]:
        """
        Return force at the tip and offsets of both readings: at the start, and in each sample.

        Shapes of the standard normal inputs: (3, cases) and (samples, 3, cases).
        """
        o = self.options
        sizes = np.array([o.tip_force, o.force_offset, o.torque_offset])[:, np.newaxis]
        kept = np.exp(-PERIOD / np.array([o.tip_force_time, *[o.offset_time] * 2]))[:, np.newaxis]
        first = sizes * start
        loads, load = [], first
        for step in steps:
            load = load + np.sqrt(1.0 - kept**2) * sizes * step
            loads.append(load)
            load = kept * load
        return first, np.array(loads)

    def remembered(self, loads: FloatArray) -> FloatArray:
        """Return the contribution of loads, shape (3, cases), to the memories of the low-pass."""
        arms = 1.0, self.model.parameters.length
        parts = []
        for c in range(2):
            values = np.ones((20_000, 1))
            steady = self.low_pass(values, np.zeros((len(self.sections), 2, 1)))[1].ravel()
            parts.append(np.outer(steady, loads[1 + c] - arms[c] * loads[0]))
        return np.concatenate(parts)

    def run(
        self,
        start: FloatArray,
        memory: FloatArray,
        kicks: FloatArray,
        noise: FloatArray,
        depths: FloatArray,
        speeds: FloatArray,
        windows: list[tuple[float, float]],
        loads: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """
        Return states (q, p) on the grid, readings of the wrench, and means over windows.

        The last axis of all inputs and results is the case. ``kicks`` is the noise at both ends of
        each sample, shape (samples, 2, n, cases).
        """
        n, count, cases = self.n, len(depths) - 1, start.shape[-1]
        x = start.copy()
        states, readings = [x], []
        means = np.zeros((len(windows), cases))
        memories = [memory[c * len(memory) // 2 :][: len(memory) // 2] for c in range(2)]
        sections = len(self.sections)
        root = self.noise_root(depths[0])
        loads = np.zeros((count, 3, cases)) if loads is None else loads
        frozen = (depths[0], 0.0)
        tick = PERIOD / self.ticks
        for k in range(count):
            # Mean of the cubic through depths and speeds at both ends.
            middle = 0.5 * (depths[k] + depths[k + 1])
            middle += PERIOD * (speeds[k] - speeds[k + 1]) / 12.0
            speed, time = 0.5 * (speeds[k] + speeds[k + 1]), (k + 1) * PERIOD
            rates = self.rates(middle, speed, time)
            scale = np.sqrt(0.5 * PERIOD)
            x = x.copy()
            x[n:] += scale * root @ kicks[k, 0]
            x = self.carry(frozen, (middle, time), -0.5 * PERIOD, 0.5 * PERIOD) @ x
            frozen = (middle, time)
            for w, (begin, end) in enumerate(windows):
                low = min(max(begin - k * PERIOD, 0.0), PERIOD)
                high = min(max(end - k * PERIOD, 0.0), PERIOD)
                if high > low:
                    part = expm(high * rates)[2 * n + 2] - expm(low * rates)[2 * n + 2]
                    means[w] += (part[: 2 * n] @ x + part[-1] * loads[k, 0]) / (end - begin)
            step = expm(tick * rates)
            for i in range(self.ticks):
                inputs = step[2 * n : 2 * n + 2, : 2 * n] @ x
                inputs = (inputs + np.outer(step[2 * n : 2 * n + 2, -1], loads[k, 0])) / tick
                x = step[: 2 * n, : 2 * n] @ x + np.outer(step[: 2 * n, -1], loads[k, 0])
                read = []
                for c in range(2):
                    value = inputs[c] + loads[k, 1 + c] + self.noise[c] * noise[k, i, c]
                    own = memories[c].reshape(sections, 2, cases)
                    out, after = self.low_pass(value[np.newaxis], own)
                    memories[c] = after.reshape(-1, cases)
                    read.append(out[0])
            readings.append(read)
            root = self.noise_root(middle)
            x[n:] += scale * root @ kicks[k, 1]
            states.append(x)
        return np.array(states), np.array(readings), means

    def modes(self, depth: float, time: float) -> tuple[FloatArray, FloatArray]:
        """Frequencies, and the matrix from c = omega a and b of the normal modes to (q, p)."""
        p, n = self.model.parameters, self.n
        mass = p.linear_density * self.model.modes.integrals(depth).gram
        squares, normal = eigh(self.model.stiffness_matrix(depth, time), mass)
        matrix = np.zeros((2 * n, 2 * n))
        matrix[:n, :n] = normal / np.sqrt(squares)
        matrix[n:, n:] = mass @ normal
        return np.sqrt(squares), matrix

    def carry(
        self, old: tuple[float, float], new: tuple[float, float], since: float, until: float
    ) -> FloatArray:
        """Change of (q, p) from one depth and time to others, spread over a time."""
        n = self.n
        _, before = self.modes(*old)
        omega, after = self.modes(*new)
        change = np.linalg.solve(after, before)
        # The sign of each mode is arbitrary.
        signs = np.tile(np.sign(np.diag(change)[:n]), 2)
        after *= signs
        change = signs[:, np.newaxis] * change - np.eye(2 * n)
        times = np.linspace(since, until, 4001)
        turns = np.zeros((len(times), 2 * n, 2 * n))
        for i in range(n):
            angle = omega[i] * times
            turns[:, i, i] = turns[:, n + i, n + i] = np.cos(angle)
            turns[:, i, n + i], turns[:, n + i, i] = np.sin(angle), -np.sin(angle)
        turned = turns.transpose(0, 2, 1) @ change @ turns
        weights = np.full(len(times), 2.0)
        weights[1::2], weights[0], weights[-1] = 4.0, 1.0, 1.0
        mean = np.tensordot(weights / weights.sum(), turned, 1)
        return np.asarray(after @ (np.eye(2 * n) + mean) @ np.linalg.inv(before))

    def present(self, x: FloatArray, depths: FloatArray, speeds: FloatArray) -> FloatArray:
        """Return (q, q_dot) at the last depth, from (q, p) at the mean one of the last sample."""
        end, time = depths[-1], PERIOD * (len(depths) - 1)
        middle = 0.5 * (depths[-2] + end) + PERIOD * (speeds[-2] - speeds[-1]) / 12.0
        x = self.carry((middle, time), (end, time), -0.5 * PERIOD, 0.0) @ x
        gram = self.model.modes.integrals(end).gram
        x[self.n :] = np.linalg.solve(self.model.parameters.linear_density * gram, x[self.n :])
        return x


def draw(reference: Reference, depth: float, count: int, cases: int, rng: Any) -> list[FloatArray]:
    """Draw starts, memories, kicks and noise from the prior of the observer."""
    root, memory = reference.prior(depth)
    return [
        root @ rng.normal(size=(len(root), cases)),
        memory @ rng.normal(size=(memory.shape[1], cases)),
        rng.normal(size=(count, 2, reference.n, cases)),
        rng.normal(size=(count, reference.ticks, 2, cases)),
        rng.normal(size=(3, cases)),
        rng.normal(size=(count, 3, cases)),
    ]


BATCH_CASES: dict[str, tuple[int, dict[str, Any], dict[str, Any]]] = {
    'one mode': (1, {}, {}),
    'two modes': (2, {}, {}),
    'three modes': (3, {}, {}),
    'undamped': (2, {'tissue_damping': 0.0}, {'irregularity': 0.0}),
    'beyond critical damping': (2, {'tissue_damping': 60.0}, {}),
    'layers that swell': (
        2,
        {
            'layer_depths': (0.05, 0.0601),
            'layer_stiffnesses': (4000.0, 90.0),
            'swelling': 0.5,
            'swelling_time': 0.02,
        },
        {},
    ),
    'long exposure': (2, {}, {'tip_exposure': 4.7e-3}),
    'short exposure': (2, {}, {'tip_exposure': 1e-4}),
    'no low-pass': (2, {}, {'cutoffs': ()}),
    'no loads': (2, {}, NO_LOADS),
    'fast loads': (2, {}, {'tip_force_time': 0.01, 'offset_time': 0.05}),
    'slow sensor': (2, {}, {'cutoffs': (125.0,), 'filter_rate': 1000.0}),
}


@pytest.mark.parametrize('case', BATCH_CASES)
def test_estimate_is_the_conditional_mean_of_all_measurements(case: str) -> None:
    """With late, early, disordered and missing samples it equals a dense batch solution."""
    modes, changes, options = BATCH_CASES[case]
    parameters = phantom(modes, **changes)
    settings = ObserverSettings(
        **{'irregularity': 3e-3, 'force_resolution': 0.02, 'torque_resolution': 2e-3, **options}
    )
    reference = Reference(parameters, settings)
    count, n = 24, modes
    time = PERIOD * np.arange(count + 1)
    depths = 0.06 + 0.02 * time + 1e-4 * np.sin(300.0 * time)
    speeds = 0.02 + 0.03 * np.cos(300.0 * time)
    exposure = settings.tip_exposure
    ends = np.array([0.3, 6.0, 11.25, 16.4, 17.0 + 1e3 * exposure, 23.0]) * 1e-3
    ends = ends[ends - exposure >= 0.0]
    windows = [(end - exposure, end) for end in ends]

    root, memory = reference.prior(depths[0])
    shapes = [
        (root.shape[1],),
        (memory.shape[1],),
        (count, 2, n),
        (count, reference.ticks, 2),
        (3,),
        (count, 3),
    ]
    sizes = [int(np.prod(shape)) for shape in shapes]
    borders = np.cumsum([0, *sizes])
    units = np.eye(borders[-1])

    def simulated(unknowns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        parts = [unknowns[low:high] for low, high in pairwise(borders)]
        parts = [part.reshape(*shape, -1) for part, shape in zip(parts, shapes, strict=True)]
        start, memories, kicks, noise, first, steps = parts
        at_start, loads = reference.loads(first, steps)
        whole = memory @ memories + reference.remembered(at_start)
        return reference.run(root @ start, whole, kicks, noise, depths, speeds, windows, loads)

    rng = np.random.default_rng(5)
    states, wrenches, tips = simulated(units)
    truth = rng.normal(size=len(units))
    wrench_read = wrenches @ truth
    tip_read = tips @ truth
    counts = np.array([settings.force_resolution, settings.torque_resolution]) / np.sqrt(12.0)
    wrench_read += counts * rng.normal(size=wrench_read.shape)
    tip_read += settings.tip_noise * rng.normal(size=tip_read.shape)
    wrench_read[rng.random(wrench_read.shape) < 0.2] = nan

    observer = Observer(parameters, settings, PERIOD)
    # Out of order: one wrench before its sample, the first wrench last.
    arrivals = {3: [1], 14: [3, 2], 20: [5, 4], count: [0]} if len(ends) == 6 else {9: [1, 0, 2]}
    for k in range(count + 1):
        wrench = None if k == 0 else (float(wrench_read[k - 1, 0]), float(wrench_read[k - 1, 1]))
        observer.update(ns(time[k]), float(depths[k]), float(speeds[k]), wrench)
        for w in arrivals.get(k, []):
            if w < len(ends):
                observer.add_tip(ns(ends[w]), float(tip_read[w]))
    known = np.isfinite(wrench_read)
    taken = sorted({w for late in arrivals.values() for w in late if w < len(ends)})
    a = np.vstack([wrenches[known], tips[taken]])
    y = np.concatenate([wrench_read[known], tip_read[taken]])
    r = np.concatenate(
        [
            np.broadcast_to(counts**2, known.shape)[known],
            np.full(len(taken), settings.tip_noise**2),
        ]
    )
    innovation = a @ a.T + np.diag(r)
    to_state = reference.present(states[-1], depths, speeds)
    gain = np.linalg.solve(innovation, a @ to_state.T).T
    expected = gain @ y
    covariance = to_state @ to_state.T - gain @ a @ to_state.T

    assert observer.refused == 0
    assert observer.nis.degrees == len(y)
    deviation = np.sqrt(np.diag(covariance))
    # 1e-6 of a standard deviation: the batch solution inverts matrices over many decades.
    assert_allclose(
        np.concatenate(observer.modal) / deviation, expected / deviation, rtol=0.0, atol=1e-6
    )
    assert_allclose(
        observer.covariance / np.outer(deviation, deviation),
        covariance / np.outer(deviation, deviation),
        rtol=0.0,
        atol=1e-6,
    )
    # The innovations are white: their squares are the likelihood's exponent.
    assert_allclose(
        observer.nis.ratio * observer.nis.degrees, y @ np.linalg.solve(innovation, y), rtol=1e-6
    )


def test_observer_is_consistent_over_200_runs() -> None:
    """NEES and NIS within their bands of 95 %, with the model and its noise as the truth."""
    parameters, settings = phantom(), ObserverSettings(tip_exposure=5e-3)
    reference = Reference(parameters, settings)
    cases, count = 200, 100
    rng = np.random.default_rng(3)
    time = PERIOD * np.arange(count + 1)
    speeds = np.full(count + 1, 0.05)
    depths = 0.1 + speeds * time
    ends = np.arange(10, count + 1, 20) * PERIOD
    windows = [(end - settings.tip_exposure, end) for end in ends]
    drawn = draw(reference, depths[0], count, cases, rng)
    start, memory, kicks, noise, first, steps = drawn
    at_start, loads = reference.loads(first, steps)
    memory += reference.remembered(at_start)
    states, wrench, tips = reference.run(
        start, memory, kicks, noise, depths, speeds, windows, loads
    )
    counts = np.array([settings.force_resolution, settings.torque_resolution]) / np.sqrt(12.0)
    wrench += counts[:, np.newaxis] * rng.normal(size=wrench.shape)
    tips += settings.tip_noise * rng.normal(size=tips.shape)
    looks = {20, 60, count}
    nees = dict.fromkeys(looks, 0.0)
    squares, degrees = 0.0, 0
    truth = {k: reference.present(states[k], depths[: k + 1], speeds[: k + 1]) for k in looks}
    for case in range(cases):
        observer = Observer(parameters, settings, PERIOD)
        observer.update(ns(0.0), depths[0], speeds[0])
        for k in range(1, count + 1):
            lateral, moment = wrench[k - 1, :, case].tolist()
            observer.update(ns(time[k]), float(depths[k]), 0.05, (lateral, moment))
            if k % 20 == 10 and k > 10:
                observer.add_tip(ns(ends[k // 20 - 1]), float(tips[k // 20 - 1, case]))
            if k in looks:
                nees[k] += observer.nees(truth[k][:2, case], truth[k][2:, case])
        seen = observer.nis
        squares, degrees = squares + seen.ratio * seen.degrees, degrees + seen.degrees
    for total in nees.values():
        assert Consistency.of(total, 4 * cases).holds
    assert degrees == cases * (2 * count + 4)
    assert Consistency.of(squares, degrees).holds


def under_tip_force(
    force: float, tip_period: int, late: int, settings: ObserverSettings, cases: int, count: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """
    Observe needles at 10 cm that begin to bend under a constant force at the tip.

    A tip sample is received every ``tip_period`` samples, ``late`` samples after its exposure.
    Returns error and standard deviation of the tip at the end, NEES, and NIS with its degrees, by
    case.
    """
    parameters = phantom()
    reference = Reference(parameters, settings)
    rng = np.random.default_rng(11)
    depths, speeds = np.full(count + 1, 0.1), np.zeros(count + 1)
    ends = range(tip_period, count + 1, tip_period)
    windows = [(end * PERIOD - settings.tip_exposure, end * PERIOD) for end in ends]
    start, memory, kicks, noise, first, steps = draw(reference, 0.1, count, cases, rng)
    at_start, loads = reference.loads(first, steps)
    at_start[0], loads[:, 0] = force, force
    memory += reference.remembered(at_start)
    states, wrench, tips = reference.run(
        start, memory, kicks, noise, depths, speeds, windows, loads
    )
    counts = np.array([settings.force_resolution, settings.torque_resolution]) / np.sqrt(12.0)
    wrench += counts[:, np.newaxis] * rng.normal(size=wrench.shape)
    tips += settings.tip_noise * rng.normal(size=tips.shape)
    end = reference.present(states[-1], depths, speeds)
    deflection = reference.model.modes.integrals(0.1).value @ end[:2]
    found = np.empty((4, cases))
    for case in range(cases):
        observer = Observer(parameters, settings, PERIOD)
        observer.update(ns(0.0), 0.1, 0.0)
        for k in range(1, count + 1):
            lateral, moment = wrench[k - 1, :, case].tolist()
            observer.update(ns(k * PERIOD), 0.1, 0.0, (lateral, moment))
            if k > late and (k - late) % tip_period == 0:
                taken = (k - late) // tip_period - 1
                observer.add_tip(ns(ends[taken] * PERIOD), float(tips[taken, case]))
        value, spread = observer.tip_deflection
        nees = observer.nees(end[:2, case], end[2:, case])
        found[:, case] = value - deflection[case], spread, nees, observer.nis.ratio
    return found[0], found[1], found[2], found[3]


@pytest.mark.parametrize('force', [0.05, 0.5])
@pytest.mark.parametrize('sensor', ['1 kHz', '25 Hz, 50 ms late'])
def test_constant_tip_force_is_estimated_consistently(force: float, sensor: str) -> None:
    """Bevel force: consistent errors, far smaller than the errors of the sensor."""
    if sensor == '1 kHz':
        settings, (tip_period, late) = ObserverSettings(tip_noise=1e-4), (1, 0)
    else:
        settings = ObserverSettings(tip_noise=3e-4, tip_exposure=0.02)
        tip_period, late = 40, 50
    cases = 60
    error, spread, nees, nis = under_tip_force(force, tip_period, late, settings, cases, 600)
    # Of 60 cases the root of the mean square has an error of 9 %: two of them.
    assert np.sqrt(np.mean(error**2)) < 1.2 * np.sqrt(np.mean(spread**2))
    assert Consistency.of(float(nees.sum()), 4 * cases).holds
    assert abs(nis.mean() - 1.0) < 0.05
    assert np.sqrt(np.mean(error**2)) < 0.5 * settings.tip_noise


@pytest.mark.parametrize('rate', [30.0, 300.0, 1500.0])
def test_observer_is_consistent_at_any_sample_rate(rate: float) -> None:
    """Rates that do not divide the rate of the force sensor."""
    parameters, period, settings = phantom(), 1.0 / rate, ObserverSettings(tip_exposure=2e-4)
    needle = Integrator(parameters, NeedleModel(parameters).state_at(0.1, 1e-3), 1e-4)
    reference = Reference(parameters, settings)
    observer = Observer(parameters, settings, period)
    observer.update(ns(0.0), 0.1, 0.0)
    rng = np.random.default_rng(2)
    memories = [np.zeros((len(reference.sections), 2)) for _ in range(2)]
    errors, spreads, samples = [], [], 1
    for tick in range(1, 8001):
        seen = needle.advance_moved(1.0 / settings.filter_rate, 0.0)
        wrench = []
        for c, value in enumerate((seen.lateral_force, seen.moment)):
            noisy = np.array([value + reference.noise[c] * rng.normal()])
            read, memories[c] = reference.low_pass(noisy, memories[c])
            wrench.append(float(read[0]))
        if tick / settings.filter_rate < samples * period:
            continue
        # The newest reading, up to an eighth of a millisecond late.
        observer.update(ns(samples * period), 0.1, 0.0, (wrench[0], wrench[1]))
        true = needle.model.tip_deflection(needle.state)
        observer.add_tip(ns(samples * period), true + settings.tip_noise * rng.normal())
        value, spread = observer.tip_deflection
        errors.append(value - true)
        spreads.append(spread)
        samples += 1
    error, said = (np.sqrt(np.mean(np.square(x[len(x) // 2 :]))) for x in (errors, spreads))
    assert error < 2.0 * said
    assert error < settings.tip_noise
    assert observer.refused == 0


def test_tip_latency_corrects_receive_stamps() -> None:
    """`tip_latency` is equivalent to a shift of the stamp."""
    plain, late = (
        Observer(phantom(), ObserverSettings(tip_latency=latency), PERIOD)
        for latency in (0.0, 0.06)
    )
    for k in range(101):
        for observer in (plain, late):
            observer.update(ns(k * PERIOD), 0.1, 0.0)
    plain.add_tip(ns(0.03), 1e-3)
    late.add_tip(ns(0.09), 1e-3)
    assert late.tip_deflection == pytest.approx(plain.tip_deflection, rel=1e-9)


class Irregular(Integrator):
    """The simulated needle with the distributed noise force of the observer model."""

    def __init__(
        self, parameters: NeedleParameters, state: FloatArray, size: float, seed: int
    ) -> None:
        super().__init__(parameters, state, STEP)
        self._size = size / parameters.linear_density
        self._rng = np.random.default_rng([seed, 2])
        self._known = 0.0

    def advance(self, duration: float, *inputs: Any, **options: Any) -> Interval:
        n = self.model.modes.count
        if abs(self.depth - self._known) > 1e-3 * self.depth:
            # G grows at most with the fifth power of the depth: accurate to half a percent.
            self._known = self.depth
            root = cholesky(self.model.modes.integrals(self.depth).gram, lower=True)
            self._root = self._size * np.linalg.inv(root.T)
        # Half of the noise at either end: p = rho A G q_dot gains, and q_dot accordingly.
        kicks = np.sqrt(0.5 * duration) * self._root @ self._rng.normal(size=(n, 2))
        self._state[4 + n :] += kicks[:, 0]
        seen = super().advance(duration, *inputs, **options)
        self._state[4 + n :] += kicks[:, 1]
        return seen


@cache
def prior(parameters: NeedleParameters, settings: ObserverSettings, depth: float) -> FloatArray:
    """Root of the covariance of (q, p) at the start."""
    return Reference(parameters, settings).prior(depth)[0]


def plant(
    seed: int,
    parameters: NeedleParameters,
    depth: float,
    settings: ObserverSettings,
    irregularity: float = 0.0,
) -> tuple[Plant, float]:
    """Return the plant with default sensors, bent by the prior, and a force to move it."""
    rng = np.random.default_rng(seed)
    root, model, n = prior(parameters, settings, depth), NeedleModel(parameters), parameters.modes
    start = root @ rng.normal(size=2 * n)
    gram = parameters.linear_density * model.modes.integrals(depth).gram
    state = model.state_at(depth)
    state[2 : 2 + n], state[2 + n] = start[:n], -SPEED
    state[4 + n :] = np.linalg.solve(gram, start[n:])
    rate = 1.0 / PERIOD
    simulated = Plant(
        Irregular(parameters, state, irregularity, seed),
        ForceSensor(ForceSensorParameters(), rate, seed),
        rate,
        tip=TipSensor(TipParameters(), rate, seed),
    )
    return simulated, parameters.friction.force(SPEED, 0.0)


def watch_plant(
    observer: Observer, simulated: Plant, force: float, count: int
) -> list[PlantSample]:
    """Update the observer by the plant's sensors."""
    needle = simulated.integrator
    observer.reset()
    observer.update(ns(0.0), needle.depth, needle.velocity)
    samples = []
    for k in range(1, count + 1):
        shown = simulated.advance(force)
        wrench = float(shown.wrench[2]), float(shown.wrench[3])
        observer.update(ns(k * PERIOD), shown.joint_position, shown.velocity, wrench)
        if shown.tip is not None:
            observer.add_tip(ns((k - shown.tip.age) * PERIOD), shown.tip.deflection)
        samples.append(shown)
    return samples


def test_defaults_of_plant_and_observer_agree() -> None:
    """The sensor settings of observer and plant are equal, with noise behind the filters."""
    settings, sensor, tip = ObserverSettings(), ForceSensorParameters(), TipParameters()
    assert (settings.cutoffs, settings.filter_rate) == (sensor.cutoffs, sensor.rate)
    impulse = np.zeros(20_000)
    impulse[0] = 1.0
    for cutoff in sensor.cutoffs:
        impulse = lfilter(*butter(2, cutoff, fs=sensor.rate), impulse)
    read = np.sqrt((impulse**2).sum()) * sensor.per_axis('noise')[2:4]
    # Rounded to four digits, so that they read well.
    assert_allclose((settings.force_noise, settings.torque_noise), read, rtol=1e-3)
    counts = settings.force_resolution, settings.torque_resolution
    assert counts == tuple(sensor.per_axis('resolution')[2:4])
    assert settings.tip_noise == tip.noise
    # A sample of the tip with every one of the plant, which by default is every millisecond.
    assert (tip.rate, tip.delay, settings.tip_exposure) == (0.0, 0.0, PERIOD)


@pytest.mark.parametrize(
    ('name', 'irregularity'), [('phantom', ObserverSettings().irregularity), ('paper_mm', 0.0)]
)
def test_observer_is_consistent_on_the_plant_over_200_runs(name: str, irregularity: float) -> None:
    """
    NEES, error of the tip and NIS within their bands of 95 % for the nominal needle.

    The plant moves under a force with its default sensors; the observer has its defaults, with
    tissue as irregular as configured, or regular.
    """
    parameters = preset(name)
    # The initial state of the low-pass is a guess: NIS is computed from later samples.
    settings = ObserverSettings(irregularity=irregularity, history=0.06, **NO_LOADS)
    observer = Observer(parameters, settings, PERIOD)
    runs, count, n = 200, 100, parameters.modes
    nees, tip, squares, degrees = 0.0, 0.0, 0.0, 0
    for seed in range(runs):
        simulated, force = plant(seed, parameters, 0.1, settings, irregularity)
        watch_plant(observer, simulated, force, count)
        now = simulated.integrator.state
        nees += observer.nees(now[2 : 2 + n], now[4 + n :])
        estimate, spread = observer.tip_deflection
        tip += ((estimate - simulated.integrator.model.tip_deflection(now)) / spread) ** 2
        seen = observer.nis
        squares, degrees = squares + seen.ratio * seen.degrees, degrees + seen.degrees
    assert observer.restarts == observer.refused == 0
    assert degrees > 3 * 55 * runs
    for total, freedom in ((nees, 2 * n * runs), (tip, runs), (squares, degrees)):
        assert Consistency.of(total, freedom).holds


def test_observer_is_conservative_without_irregularity_and_tip_noise() -> None:
    """Errors are smaller than predicted: NEES and NIS below their bands."""
    parameters, settings = preset('paper_mm'), ObserverSettings()
    observer = Observer(parameters, settings, PERIOD)
    nees, squares, degrees = 0.0, 0.0, 0
    for seed in range(20):
        simulated, force = plant(seed, parameters, 0.1, settings)
        perfect = Plant(simulated.integrator, ForceSensor(ForceSensorParameters(), 1e3, seed), 1e3)
        watch_plant(observer, perfect, force, 100)
        now = perfect.integrator.state
        nees += observer.nees(now[2:4], now[6:])
        seen = observer.nis
        squares, degrees = squares + seen.ratio * seen.degrees, degrees + seen.degrees
    assert Consistency.of(nees, 80).ratio < Consistency.of(nees, 80).low
    assert 0.4 < squares / degrees < 0.8


def simulate(
    seed: int,
    parameters: NeedleParameters,
    depth: float,
    count: int,
    *,
    nominal: NeedleParameters | None = None,
    **options: Any,
) -> tuple[Observer, FloatArray]:
    """
    Observe the plant with its default force sensor; the tip at 50 Hz, 20 ms late.

    The pull of the bent needle is small against friction: the speed is constant.

    Returns the observer, and for every sample NEES, true tip deflection, its estimate, the
    standard deviation of the estimate, and the last received tip sample.
    """
    settings = ObserverSettings(**options)
    rng = np.random.default_rng([seed, 3])
    n = parameters.modes
    carried = replace(parameters, viscous_friction=1e6)
    simulated, force = plant(seed, carried, depth, settings)
    needle = simulated.integrator
    observer = Observer(nominal or parameters, settings, PERIOD)
    observer.update(ns(0.0), needle.depth, needle.velocity)
    late: list[tuple[int, float]] = []
    rows, raw = [], 0.0
    for k in range(1, count + 1):
        shown = simulated.advance(force)
        wrench = float(shown.wrench[2]), float(shown.wrench[3])
        observer.update(ns(k * PERIOD), shown.depth, shown.velocity, wrench)
        if k % 20 == 0:
            late.append((k, shown.tip_deflection + settings.tip_noise * rng.normal()))
        if late and late[0][0] == k - 20:
            taken, raw = late.pop(0)
            observer.add_tip(ns(taken * PERIOD), raw)
        now = shown.state
        rows.append(
            [
                observer.nees(now[2 : 2 + n], now[4 + n :]),
                needle.model.tip_deflection(now),
                *observer.tip_deflection,
                raw,
            ]
        )
    return observer, np.array(rows)


def test_low_pass_is_part_of_the_state() -> None:
    """As white noise, the output of the sensor's filter would be neither white nor in time."""
    parameters = preset('paper_mm')
    cases: list[tuple[dict[str, Any], bool]] = [({}, True), ({'cutoffs': ()}, False)]
    for options, consistent in cases:
        observer, rows = simulate(1, parameters, 0.1, 80, irregularity=0.0, **options)
        error = abs(rows[40:, 2] - rows[40:, 1]).max()
        assert (observer.nis.ratio < 1.5) == consistent
        assert (error < 5.0 * rows[40:, 3].max()) == consistent


def test_action_of_fast_modes_is_conserved_while_the_depth_changes() -> None:
    """
    At 2 cm, where a sample is 2 and 22 periods of the modes, without configured irregularity.

    An abrupt change of basis, at any phase of the modes, has an error of a thousandth each time:
    after 150 samples the errors would be ten times the prediction.
    """
    nees = np.zeros(150)
    for seed in range(10):
        # Limited by the range of the force sensor: with 1 mm the moment would be 9 N m.
        _, rows = simulate(
            seed, preset('paper_mm'), 0.02, 150, irregularity=0.0, initial_deflection=2e-4
        )
        nees += rows[:, 0] / 40.0
    # Band of 95 % up to 1.48, and the error of a depth frozen over each sample.
    assert nees[[50, 100, 149]].max() < 2.0


@pytest.mark.parametrize(
    ('name', 'depth'),
    [('paper_mm', 0.03), ('paper_mm', 0.18), ('phantom', 0.02), ('phantom', 0.1)],
)
@pytest.mark.parametrize('modes', [1, 2])
def test_tip_estimate_is_better_than_the_tip_sensor(name: str, depth: float, modes: int) -> None:
    parameters = preset(name, modes=modes)
    size = min(1e-3, 0.01 * depth)
    _, rows = simulate(3, parameters, depth, 240, initial_deflection=size, **NO_LOADS)
    _, truth, estimate, spread, raw = rows[60:].T
    noise = ObserverSettings().tip_noise
    error = np.sqrt(np.mean((estimate - truth) ** 2))
    # Several periods of the needle pass before a late sample.
    # At large depth the wrench is insensitive: a sample of the force has 0.05 N of noise.
    assert error < 0.75 * noise
    assert error < 0.75 * np.sqrt(np.mean((raw - truth) ** 2))
    assert error < 1.5 * np.sqrt(np.mean(spread**2))


# Not 3 cm, where a mode has the sample rate: the wrench does not observe it.
@pytest.mark.parametrize('depth', [0.035, 0.06, 0.1])
@pytest.mark.parametrize('factor', [0.7, 1.3])
def test_default_irregularity_covers_a_stiffness_mismatch(depth: float, factor: float) -> None:
    """Stiffness 30 % off on the undamped needle: errors are approximately consistent."""
    nominal = preset('paper_mm')
    parameters = preset('paper_mm', tissue_stiffness=factor * nominal.tissue_stiffness)
    observer, rows = simulate(4, parameters, depth, 300, nominal=nominal)
    _, truth, estimate, spread, _ = rows[60:].T
    assert np.sqrt(np.mean((estimate - truth) ** 2)) < 2.0 * np.sqrt(np.mean(spread**2))
    assert observer.nis.ratio < 1.5
    # Without configured irregularity it is inconsistent, and detects it.
    observer, _ = simulate(4, parameters, depth, 300, nominal=nominal, irregularity=0.0)
    assert observer.nis.ratio > 2.0 * observer.nis.high


@pytest.mark.parametrize('modes', [1, 2, 3])
@pytest.mark.parametrize('depth', [0.03, 0.08, 0.2])
@pytest.mark.parametrize('name', ['paper_mm', 'phantom'])
def test_deflection_is_observable(name: str, depth: float, modes: int) -> None:
    """Modal coordinates and rates are observable by the tip only, and better with the wrench."""
    parameters = preset(name, modes=modes, minimum_depth=LEAST_DEPTH[modes])
    model = NeedleModel(parameters)
    system = linearize(model, operating_point(model, depth, 0.0, 0.01))
    a, _, c = system.scaled()
    keep = [k for k, label in enumerate(system.scaled_names) if label.startswith('bending')]
    names = tuple(system.scaled_names[k] for k in keep)
    a, c = a[np.ix_(keep, keep)], c[:, keep]
    tip = observability(a, c, names)
    assert tip.rank == 2 * modes
    assert tip.lost == ()

    rates = Reference(parameters, ObserverSettings()).rates(depth, 0.0, 0.0)
    gram = parameters.linear_density * model.modes.integrals(depth).gram
    to_state = np.kron(np.eye(2), np.eye(modes))
    to_state[modes:, modes:] = gram
    middle = model.coordinates
    rows = [*range(2, middle), *range(middle + 2, 2 * middle)]
    transform = system.transform[np.ix_(rows, keep)]
    wrench = rates[2 * modes : 2 * modes + 2, : 2 * modes] @ to_state @ transform
    wrench /= np.abs(wrench).max(axis=1, keepdims=True)
    both = observability(a, np.vstack([c, wrench]), names)
    assert both.rank == 2 * modes
    assert both.margin >= tip.margin * (1.0 - 1e-9)


def exact(depth: float, modes: int, **changes: Any) -> tuple[Observer, Integrator]:
    """Observe the simulated needle with very accurate sensors."""
    parameters = phantom(modes, **changes)
    needle = Integrator(parameters, NeedleModel(parameters).state_at(depth, 1e-3), 2e-6)
    settings = ObserverSettings(
        irregularity=0.0, tip_noise=1e-9, force_noise=1e-6, torque_noise=1e-8,
        force_resolution=0.0, torque_resolution=0.0, cutoffs=(), filter_rate=1.0 / PERIOD,
        **NO_LOADS,
    )  # fmt: skip
    observer = Observer(parameters, settings, PERIOD)
    observer.update(ns(0.0), depth, 0.0)
    for k in range(1, 31):
        seen = needle.advance_moved(PERIOD, 0.0)
        observer.update(ns(k * PERIOD), depth, 0.0, (seen.lateral_force, seen.moment))
        observer.add_tip(ns(k * PERIOD), seen.tip_deflection)
    return observer, needle


@pytest.mark.parametrize('modes', [1, 2, 3])
@pytest.mark.parametrize('depth', [0.03, 0.1])
def test_agrees_with_the_simulated_needle(depth: float, modes: int) -> None:
    """Modal state, tip deflection and load agree with the model."""
    observer, needle = exact(depth, modes, tissue_damping=0.0)
    model, state = needle.model, needle.state
    modal, rates = observer.modal
    # 1e-4 of the largest: with a minute noise of 1e-6 and thirty samples.
    assert_allclose(modal, state[2 : 2 + modes], rtol=0, atol=1e-4 * abs(modal).max())
    assert_allclose(rates, state[4 + modes :], rtol=0, atol=1e-4 * abs(rates).max())
    value, spread = observer.tip_deflection
    assert_allclose(value, model.tip_deflection(state), rtol=0, atol=1e-7)
    assert 0.0 < spread < 1e-7
    # The load includes only modes below half the sample rate.
    mass, stiffness = model.mass_matrix(state)[2:, 2:], model.stiffness_matrix(depth)
    squares, shapes = eigh(stiffness, mass)
    kept = shapes[:, np.sqrt(squares) * PERIOD < np.pi]
    slow = state.copy()
    for part in (slice(2, 2 + modes), slice(4 + modes, None)):
        slow[part] = kept @ (kept.T @ mass @ state[part])
    bias = model.bias_forces(slow)[0]
    assert_allclose(observer.load, -bias, rtol=0, atol=1e-3 * abs(bias) + 1e-12)
    tip = np.concatenate([model.modes.integrals(depth).value, np.zeros(modes)])
    assert_allclose(np.sqrt(tip @ observer.covariance @ tip), spread, rtol=1e-6)


@settings(deadline=None, max_examples=15)
@given(st.permutations(range(1, 21)), st.integers(1, 20))
def test_wrench_is_used_at_its_stamp_in_any_order(order: list[int], shown: int) -> None:
    """Late, early, in any order relative to its encoder sample."""
    together, apart = (Observer(phantom(), ObserverSettings(), PERIOD) for _ in range(2))
    clock = 1_700_000_000_000_000_000

    def wrench(k: int) -> tuple[float, float]:
        return 0.1 * float(np.sin(k)), nan if k == 7 else 0.01 * float(np.cos(k))

    for k in range(21):
        together.update(clock + ns(k * PERIOD), 0.1, 0.0, wrench(k))
        apart.update(clock + ns(k * PERIOD), 0.1, 0.0)
        if k == shown:
            # At most sixteen wrenches wait.
            late = [j for j in order if j <= k] + [j for j in order if j > k][:16]
            for j in late:
                apart.add_wrench(clock + ns(j * PERIOD), *wrench(j))
    for j in set(order) - set(late):
        apart.add_wrench(clock + ns(j * PERIOD), *wrench(j))
    assert apart.refused == 0
    assert apart.nis.degrees == together.nis.degrees == 39
    for one, other in zip(together.modal, apart.modal, strict=True):
        # Rounding: the steps are computed again from the sample before.
        assert_allclose(one, other, rtol=0, atol=1e-9 * abs(one).max())
    for bad in ((0.5, 0.0), (5.0, 0.0), (3.0, nan), (-2.0, 0.0)):
        apart.add_wrench(clock + ns(bad[0] * PERIOD), bad[1], bad[1])
    assert apart.refused == 4


ticks = st.integers(1, 40)
readings = st.floats(-1e-3, 1e-3)


def watch(
    tips: list[tuple[float, float]], sign: float = 1.0, origin: int = 0, at_once: bool = True
) -> Observer:
    """Forty samples with an artificial wrench; tips at their time, or at the end."""
    observer = Observer(phantom(), ObserverSettings(), PERIOD)
    waiting = list(tips)
    for k in range(41):
        lateral, moment = 0.1 * np.sin(0.4 * k), 0.01 * np.cos(0.3 * k)
        wrench = (sign * float(lateral), sign * float(moment))
        observer.update(origin + ns(k * PERIOD), 0.1 + 1e-5 * k, 0.01, wrench)
        for tip in [tip for tip in waiting if at_once and tip[0] <= k * PERIOD]:
            observer.add_tip(origin + ns(tip[0]), sign * tip[1])
            waiting.remove(tip)
    for stamp, value in waiting:
        observer.add_tip(origin + ns(stamp), sign * value)
    return observer


@settings(deadline=None, max_examples=25)
@given(st.dictionaries(ticks, readings, max_size=8), st.randoms(use_true_random=False))
def test_estimate_is_independent_of_the_order_of_arrival(
    samples: dict[int, float], random: Any
) -> None:
    """Of tip samples."""
    tips = [(k * PERIOD, value) for k, value in samples.items()]
    inorder = watch(sorted(tips))
    random.shuffle(tips)
    shuffled = watch(tips, at_once=False)
    for one, other in zip(inorder.modal, shuffled.modal, strict=True):
        # 1e-9: exposures that meet are cut where the earlier one ends, up to rounding.
        assert_allclose(one, other, rtol=0, atol=1e-9 * abs(one).max())
    spread = np.sqrt(np.diag(inorder.covariance))
    change = (inorder.covariance - shuffled.covariance) / np.outer(spread, spread)
    assert_allclose(change, 0.0, rtol=0, atol=1e-9)
    assert inorder.nis.degrees == shuffled.nis.degrees == 80 + len(samples)


@settings(deadline=None, max_examples=25)
@given(st.dictionaries(ticks, readings, max_size=8), st.integers(-(2**62), 2**62))
def test_estimate_is_invariant_to_mirror_and_clock_origin(
    samples: dict[int, float], origin: int
) -> None:
    """A mirrored needle has a mirrored estimate; the origin of the clock [ns] has no effect."""
    tips = sorted((k * PERIOD, value) for k, value in samples.items())
    plain, mirrored, moved = watch(tips), watch(tips, sign=-1.0), watch(tips, origin=origin)
    for one, other, later in zip(plain.modal, mirrored.modal, moved.modal, strict=True):
        assert_allclose(one, -other, rtol=0, atol=0)
        assert_allclose(one, later, rtol=0, atol=0)
    assert plain.load == mirrored.load


def test_repeated_and_invalid_samples_are_rejected() -> None:
    clean, tips = watch([(0.02, 1e-4)]), [(0.02, 1e-4)]
    observer = watch(tips)
    before = observer.modal
    bad = [(0.02, 5e-4), (0.0203, 5e-4), (0.03, nan), (-1.0, 0.0), (9.0, 0.0)]
    for stamp, value in bad:
        observer.add_tip(ns(stamp), value)
    observer.update(ns(0.04), 0.2, 0.0)
    observer.update(ns(0.03), 0.2, 0.0)
    assert observer.refused == len(bad) + 2
    assert observer.warning is None
    assert_allclose(np.array(observer.modal), np.array(before), rtol=0, atol=0)
    assert_allclose(np.array(observer.modal), np.array(clean.modal), rtol=0, atol=0)


@pytest.mark.requirement('S-062')
@pytest.mark.parametrize('missing', [(nan, nan), (nan, 0.01), (0.1, nan), (float('inf'), 0.01)])
def test_each_channel_may_be_missing(missing: tuple[float, float]) -> None:
    observer = Observer(phantom(), ObserverSettings(), PERIOD)
    for k in range(10):
        observer.update(ns(k * PERIOD), 0.1, 0.0, missing)
    given = sum(np.isfinite(value) for value in missing)
    assert observer.nis.degrees == 9 * given
    assert np.isfinite(observer.covariance).all()
    without = Observer(phantom(), ObserverSettings(), PERIOD)
    for k in range(10):
        without.update(ns(k * PERIOD), 0.1, 0.0)
    informed, ignorant = (np.diag(o.covariance) for o in (observer, without))
    assert (informed <= ignorant * (1.0 + 1e-9)).all()
    assert (informed.sum() < ignorant.sum()) == bool(given)


def test_invalid_encoder_samples_do_not_change_the_estimate() -> None:
    observer = watch([(0.02, 1e-4)])
    before = observer.modal
    for bad in ((nan, 0.0), (0.1, float('inf'))):
        with pytest.raises(ParameterError, match='must be finite'):
            observer.update(ns(0.05), *bad)
    for method in (observer.update, observer.add_wrench):
        with pytest.raises(ParameterError, match=r'must be an integer \[ns\], got 0.05'):
            method(0.05, 0.1, 0.0)  # type: ignore[arg-type]
    for depth in (0.0005, 0.21, -1.0):
        with pytest.raises(InsertionDepthError, match='the estimate is held'):
            observer.update(ns(0.05), depth, 0.0)
    assert_allclose(np.array(observer.modal), np.array(before), rtol=0, atol=0)
    observer.update(ns(0.045), 0.1004, 0.0)
    assert observer.warning is None


@pytest.mark.parametrize(
    ('sample', 'reason'),
    [
        ((0.041, 0.11, 0.0), 'depth jumped from 0.1004 to 0.11 m'),
        ((0.5, 0.1, 0.0), 'encoders went from 0.04 to 0.5 s'),
        ((-5.0, 0.1, 0.0), 'encoders went from 0.04 to -5 s'),
    ],
)
def test_observer_restarts_after_implausible_samples(
    sample: tuple[float, float, float], reason: str
) -> None:
    observer = watch([(0.02, 1e-4)])
    observer.update(ns(sample[0]), *sample[1:])
    assert observer.warning is not None
    assert reason in observer.warning
    assert observer.restarts == 1
    assert observer.nis.degrees == 0
    value, spread = observer.tip_deflection
    assert value == 0.0
    assert_allclose(spread, ObserverSettings().initial_deflection, rtol=1e-9)
    observer.reset()
    assert not observer.ready
    assert observer.warning is None
    with pytest.raises(NeedleError, match='before the first encoder sample'):
        observer.modal  # noqa: B018


def test_gap_in_encoder_samples_is_bridged() -> None:
    """Missing encoder samples have no effect for a depth linear in time."""
    whole, gap = (Observer(phantom(), ObserverSettings(), PERIOD) for _ in range(2))
    for k in range(31):
        wrench = (0.1, 0.01) if k < 10 or k == 30 else None
        whole.update(ns(k * PERIOD), 0.1 + 1e-5 * k, 0.01, wrench)
        if k < 10 or k == 30:
            gap.update(ns(k * PERIOD), 0.1 + 1e-5 * k, 0.01, wrench)
    # 1e-9: depths in between differ by rounding only.
    for one, other in zip(whole.modal, gap.modal, strict=True):
        assert_allclose(one, other, rtol=1e-9, atol=0)
    assert_allclose(whole.covariance, gap.covariance, rtol=1e-9, atol=0)


@pytest.mark.requirement('S-062')
@pytest.mark.parametrize('name', ['paper_mm', 'phantom'])
def test_covariance_stays_finite_without_measurements(name: str) -> None:
    """Ten minutes of encoders only: the covariance grows as the noise, symmetric and positive."""
    parameters = preset(name)
    # Longer samples for less time spent here: a gap is ten of them.
    observer = Observer(parameters, ObserverSettings(history=0.06, **NO_LOADS), 5.0 * PERIOD)
    observer.update(ns(0.0), 0.05, 0.0)
    for k in range(1, 12_001):
        observer.update(ns(k * 0.05), 0.05 + 2e-4 * (k % 2), 0.0)
    assert observer.restarts == 0
    covariance = observer.covariance
    assert np.isfinite(covariance).all()
    assert (covariance == covariance.T).all()
    scale = np.sqrt(np.diag(covariance))
    assert np.linalg.eigvalsh(covariance / np.outer(scale, scale))[0] > 0.0
    # Undamped, the noise of ten minutes adds up: S t / (2 rho omega^2) a mode; damped it does not.
    assert observer.tip_deflection[1] < (1e-2 if name == 'paper_mm' else 1e-3)


def test_covariance_stays_positive_with_very_accurate_measurements() -> None:
    observer, _ = exact(0.05, 2)
    covariance = observer.covariance
    scale = np.sqrt(np.diag(covariance))
    assert np.linalg.eigvalsh(covariance / np.outer(scale, scale))[0] > 0.0


def test_consistency_bands_follow_chi_squared() -> None:
    rng = np.random.default_rng(7)
    sums = (rng.normal(size=(4000, 30)) ** 2).sum(axis=1)
    inside = sum(Consistency.of(total, 30).holds for total in sums)
    # 95 % within four standard deviations of the count.
    assert abs(inside / 4000 - 0.95) < 4.0 * np.sqrt(0.05 * 0.95 / 4000)
    assert Consistency.of(0.0, 0).holds


@pytest.mark.parametrize(
    ('options', 'period', 'match'),
    [
        ({'irregularity': -1.0}, PERIOD, 'irregularity must be'),
        ({'tip_noise': 0.0}, PERIOD, 'tip_noise must be'),
        ({'cutoffs': (4000.0,)}, PERIOD, r'cutoffs must be in \[0.8, 4000\) Hz'),
        ({'cutoffs': 'no'}, PERIOD, 'cutoffs must be'),
        ({}, 0.0, 'period must be > 0'),
        ({'filter_rate': 1234.5}, PERIOD, 'whole multiple of the sample rate'),
        ({}, 1e-4, 'whole multiple of the sample rate'),
    ],
)
def test_invalid_settings_are_rejected(options: dict[str, Any], period: float, match: str) -> None:
    with pytest.raises(ParameterError, match=match):
        Observer(phantom(), ObserverSettings(**options), period)


def test_printed_formulation_is_rejected() -> None:
    with pytest.raises(ParameterError, match="formulation must be 'complete'"):
        Observer(phantom(formulation='as_printed'), ObserverSettings(), PERIOD)


def test_nees_rejects_wrong_shapes() -> None:
    observer = watch([])
    with pytest.raises(ShapeError, match=r'must have shape \(2,\) each'):
        observer.nees([0.0], [0.0])


def test_tips_before_the_encoders_are_not_lost() -> None:
    """Each tip that waits for an encoder sample reaches the observer, in order."""
    found = []
    for waiting in (False, True):
        observer = Observer(phantom(), ObserverSettings(), PERIOD)
        bending = LoadEstimator(phantom(), observer)
        for k in range(20):
            # The encoders have half the rate of the tip.
            for stamp in (2 * k * 10**6 - 10**6, 2 * k * 10**6) if k else ():
                take = bending.take_tip if waiting else observer.add_tip
                take(stamp, 1e-3)
            bending.take_encoders(2 * k * 10**6, Measurement(2e-3 * k, 0.1, 0.0))
            bending.update()
        found.append(observer.tip_deflection)
        assert observer.refused == 0
    assert found[0] == found[1]


@settings(deadline=None, max_examples=15)
@given(st.floats(-0.49, 0.49), st.integers(1, 4))
def test_force_sensor_with_its_own_clock_is_used(apart: float, readings: int) -> None:
    """Readings between the encoder samples count for the nearest sample, one for each."""
    estimators = [
        LoadEstimator(phantom(), Observer(phantom(), ObserverSettings(), PERIOD)) for _ in range(2)
    ]
    # The last encoder sample has no reading of its own.
    events: list[tuple[float, int, int]] = [(float(k), 1, k) for k in range(1, 41)]
    # Several readings within less than half a period end at the given distance from a sample.
    spread = 0.5 + min(apart, 0.0)
    for k in range(1, 40):
        events += [(k + apart - spread * j / readings, 0, k) for j in range(readings)]
    for time, kind, k in sorted(events):
        moment = 0.01 * float(np.cos(k))
        same, own = estimators
        if kind == 0:
            own.take_wrench(ns(time * PERIOD), 0.1, moment)
            continue
        if k < 40:
            same.take_wrench(ns(k * PERIOD), 0.1, moment)
        for one in estimators:
            one.take_encoders(
                ns(k * PERIOD), Measurement(time=k * PERIOD, depth=0.1, velocity=0.0)
            )
            one.update()
    found = [one.observer.modal for one in estimators if one.observer is not None]
    # Rounding: after a late reading the steps are computed again from the sample before.
    for one, other in zip(*found, strict=True):
        assert_allclose(one, other, rtol=0, atol=1e-9 * abs(one).max())


def test_inconsistent_observer_is_not_used() -> None:
    """An alternating moment gives a warning and zero load; both end with the moment."""
    bending = LoadEstimator(phantom(), Observer(phantom(), ObserverSettings(), PERIOD))
    rng, stamps = np.random.default_rng(4), iter(range(0, 10**10, 10**6))

    def watch(count: int, size: float) -> None:
        for stamp in islice(stamps, count):
            moment = size * float(rng.choice([-1.0, 1.0]))
            bending.take_wrench(stamp, 0.5, 0.1 + moment)
            bending.take_encoders(stamp, Measurement(time=1e-9 * stamp, depth=0.1, velocity=0.0))
            bending.update()

    watch(600, 0.0)
    assert bending.warning is None
    assert bending.load != 0.0
    watch(300, 0.2)
    assert 'inconsistent with the measurements: NIS is' in str(bending.warning)
    assert bending.load == 0.0
    watch(1000, 0.0)
    assert bending.warning is None
