# SPDX-License-Identifier: Apache-2.0
"""Control laws in the simulation: set-valued friction, sampled loops, and batches."""

from dataclasses import replace
import re
from typing import Any

from needle_controller import (
    Axis,
    ContinuousInverseDynamics,
    ContinuousPid,
    Controller,
    ControllerOutput,
    ControllerSettings,
    InverseDynamics,
    InverseDynamicsGains,
    LoopBatch,
    LoopRun,
    Measurement,
    MinimumJerk,
    Pid,
    PidGains,
    ReferenceLimits,
    run_batch,
    run_continuous,
    run_controller,
    Setpoint,
)
from needle_controller.in_loop.sampled import motion_of, run_insertions
from needle_controller.laws.law import SampledLoop
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
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.linalg import expm

#: Friction with a slow transient, and damped deflection.
MODEL = NeedleModel(
    NeedleParameters.preset('phantom', viscous_friction=0.5, coulomb_friction=0.02)
)
STRAIGHT = MODEL.state_at(0.15)
PERIOD = 1e-3


def goal(depth: float) -> np.ndarray:
    """Return the goal of a straight needle at rest at a depth."""
    wanted = np.zeros((3, 4))
    wanted[0, 0] = MODEL.parameters.length - depth
    return wanted


def pid(kp: float, kd: float) -> ContinuousPid:
    """Return a continuous PID of the base."""
    return ContinuousPid(model=MODEL, kp=[kp, 1e-6], kd=[kd, 1e-8])


def test_sliding_is_linear_flow_with_constant_dry_friction() -> None:
    """Until the first rest: M x_ddot = - kp x - (kd + mu_v) x_dot - mu_s, for x = e."""
    law, p = pid(2.0, 0.01), MODEL.parameters
    run = run_continuous(law, MODEL, STRAIGHT, goal(0.19), np.linspace(0.0, 0.4, 81))
    # The goal shifted by mu_s / kp, because friction acts against the insertion.
    center = 0.19 - p.coulomb_friction / 2.0
    m = p.moving_mass
    flow = np.array([[0.0, 1.0], [-2.0 / m, -(0.01 + p.viscous_friction) / m]])
    for t, depth in zip(run.time[::20], run.depth[::20], strict=True):
        expected = center + (expm(t * flow) @ [0.15 - center, 0.0])[0]
        # 1e-6: ten times the solver's tolerance, over the distance of 4 cm.
        assert_allclose(depth, expected, atol=4e-8 * 10.0)


def test_needle_sticks_within_friction_bound_and_reports_the_time() -> None:
    """An underdamped PID oscillates, stops, and stays where abs(kp e) <= mu_s, exactly."""
    model = NeedleModel(replace(MODEL.parameters, viscous_friction=0.01))
    law = ContinuousPid(model=model, kp=[5.0, 1e-6], kd=[0.005, 1e-8])
    run = run_continuous(law, model, STRAIGHT, goal(0.17), np.linspace(0.0, 1.0, 201))
    names = [name for _, name in run.events]
    assert names[-1] == 'stops'
    assert names.count('stops') >= 2
    late = run.time > run.events[-1][0]
    assert late.sum() > 100
    assert np.ptp(run.depth[late]) == 0.0
    assert 5.0 * abs(0.17 - run.depth[-1]) <= model.parameters.coulomb_friction


def test_breakaway_at_the_friction_bound() -> None:
    """A PID with a goal moving at 1 cm/s reaches mu_s = kp v t, and slides from then on."""

    def moving(time: float) -> np.ndarray:
        wanted = goal(0.15 + 0.01 * time)
        wanted[1, 0] = 0.0
        return wanted

    law = pid(10.0, 0.1)
    run = run_continuous(law, MODEL, STRAIGHT, moving, np.linspace(0.0, 0.4, 41))
    time, what = run.events[0]
    assert what == 'breaks away inward'
    # 1e-6 s: the solver finds the root to its own tolerance.
    assert_allclose(time, MODEL.parameters.coulomb_friction / (10.0 * 0.01), atol=1e-6)
    assert_allclose(run.depth[run.time < time], 0.15, rtol=1e-15)
    assert run.depth[-1] > 0.15 + 1e-4


def test_inverse_dynamics_cancels_friction_through_reversals() -> None:
    """With its own model as the plant d obeys its error equation, at rest for an instant only."""
    kp, kv = [400.0, 100.0], [4.0, 20.0]
    law = ContinuousInverseDynamics(model=MODEL, kp=kp, kv=kv)
    run = run_continuous(
        law, MODEL, STRAIGHT, goal(0.17), np.linspace(0.0, 0.6, 61), method='DOP853'
    )
    assert len(run.events) >= 3
    flow = np.array([[0.0, 1.0], [-400.0, -4.0]])
    expected = [0.17 + (expm(t * flow) @ [-0.02, 0.0])[0] for t in run.time]
    # 2e-7: ten times the tolerance of the solver over the 2 cm.
    assert_allclose(run.depth, expected, atol=2e-7)


def test_hub_stops_and_releases_the_needle() -> None:
    """On the hub d = 0 and d_dot = 0; a goal that leaves it moves the needle again."""

    def swinging(time: float) -> np.ndarray:
        return goal(0.25 - 0.15 * time)

    law = pid(20.0, 0.5)
    run = run_continuous(law, MODEL, STRAIGHT, swinging, np.linspace(0.0, 1.0, 201))
    names = [name for _, name in run.events]
    assert 'touches the hub' in names
    assert names.index('breaks away outward') > names.index('touches the hub')
    assert run.states[:, 0].min() == 0.0
    held = run.states[:, 0] == 0.0
    # Except for the sample where it leaves.
    assert np.count_nonzero(run.states[held, 4]) <= 1
    assert held.sum() > 50
    assert run.depth[-1] < 0.15


def test_agrees_with_the_sampled_law_inside_the_integrator() -> None:
    """The implicit PID at a short period, without delay, converges to the continuous PID."""
    law, p = pid(5.0, 0.2), MODEL.parameters
    state = MODEL.state_at(0.15, 5e-4)
    run = run_continuous(law, MODEL, state, goal(0.19), [0.0, 0.1])
    errors = []
    for period in (4e-5, 2e-5, 1e-5):
        sampled = Pid(
            axis=Axis.insertion(p),
            gains=PidGains(kp=5.0, ki=0.0, kd=0.2, tolerance=0.0),
            period=period,
        )
        loop, integrator = SampledLoop(sampled, 0, 100.0), Integrator(p, state, period)
        for _ in range(round(0.1 / period)):
            integrator.advance(
                period, loop.command(integrator.depth, integrator.velocity, Setpoint(0.19))
            )
        errors.append(abs(integrator.depth - run.depth[-1]))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    # First order: a force is held over a period.
    assert_allclose(orders, 1.0, atol=0.15)
    assert errors[-1] < 1e-5


def test_unsupported_models_are_rejected() -> None:
    law = pid(2.0, 0.01)
    with pytest.raises(ShapeError, match='times must be at least two, increasing'):
        run_continuous(law, MODEL, STRAIGHT, goal(0.16), [0.0])
    other = NeedleModel(NeedleParameters(modes=1))
    with pytest.raises(ParameterError, match='same number of modes, got 2 and 1'):
        run_continuous(law, other, other.state_at(0.1), goal(0.1), [0.0, 1.0])
    with pytest.raises(InsertionDepthError, match='left its range'):
        run_continuous(law, MODEL, STRAIGHT, goal(-0.5), np.linspace(0.0, 20.0, 3))
    assert issubclass(InsertionDepthError, NeedleError)


def test_tips_of_a_batch_equal_single_tips() -> None:
    states = np.array([MODEL.state_at(depth, 1e-3 * depth) for depth in (0.02, 0.1, 0.2)])
    found = [MODEL.tip_deflection(x) for x in states]
    # Closed form here, series there: rounding of cosh and sinh at small depth.
    assert_allclose(
        LoopRun(MODEL, np.zeros(3), states, np.zeros((3, 4))).tip_deflection, found, rtol=1e-9
    )


# Sampled loops.

NOMINAL = NeedleParameters.preset('phantom')
START = NeedleModel(NOMINAL).state_at(0.02, 5e-4)
REFERENCE = MinimumJerk(Setpoint(0.02), 0.024, ReferenceLimits())
DURATION = 1.5


def plants(count: int) -> list[NeedleParameters]:
    random = np.random.default_rng(5)
    return [
        replace(
            NOMINAL,
            coulomb_friction=0.56 * float(random.uniform(0.7, 1.3)),
            viscous_friction=300.0 * float(random.uniform(0.7, 1.3)),
            tissue_stiffness=520.0 * float(random.uniform(0.7, 1.3)),
        )
        for _ in range(count)
    ]


@pytest.mark.parametrize('name', ['inverse_dynamics', 'pid'])
@pytest.mark.parametrize('delay', [0, 1, 3])
def test_batch_equals_the_controller_of_the_node(name: str, delay: int) -> None:
    """Every run of a batch equals the run of the controller object, to the bit."""
    axis = Axis.insertion(NOMINAL)
    inverse, gains = InverseDynamicsGains(kp=400.0, kv=40.0), PidGains(kp=1000.0, ki=3000.0)
    law = (
        Pid(axis=axis, gains=gains, period=PERIOD)
        if name == 'pid'
        else InverseDynamics(axis=axis, gains=inverse, period=PERIOD)
    )
    needles = plants(3)
    batch = run_batch(
        law, needles, START, REFERENCE, delay=delay, limit=2.0, duration=DURATION, step=1e-4,
        keep=True, record=True,
    )  # fmt: skip
    for i, plant in enumerate(needles):
        controller = Controller(
            NOMINAL,
            name,
            gains={'inverse_dynamics': {'insertion': inverse}, 'pid': {'insertion': gains}},
            settings=ControllerSettings(delay=float(delay), force_limit=2.0),
            reference='minimum_jerk',
        )
        controller.set_target(0.024)
        run = run_controller(controller, plant, START, duration=DURATION, step=1e-4)
        # 1e-9: the same arithmetic, except for fused operations of the compiler.
        assert_allclose(batch.depths[i], run.depth, rtol=1e-9)
        assert_allclose(batch.states[i], run.states[-1], rtol=1e-9, atol=1e-12)
        # Relative to the range of each coordinate: rates oscillate at kilohertz.
        reached = np.abs(run.states).max(axis=0) + 1e-12
        assert_allclose(batch.trajectories[i] / reached, run.states / reached, atol=1e-9)
        # A command takes effect after its delay.
        acted = run.forces[delay:-1, 0]
        assert_allclose(batch.commands[i, : len(acted)], acted, rtol=1e-9, atol=1e-9)
        wanted = np.array([REFERENCE.at(t).position for t in run.time])
        error = wanted - run.depth
        assert_allclose(batch.final[i], error[-1], atol=1e-12)
        assert_allclose(batch.largest[i], np.abs(error).max(), rtol=1e-6)
        assert_allclose(batch.rms[i], np.sqrt((error**2).mean()), rtol=1e-6)
        assert batch.completed[i] == len(run.time) - 1


class Proportional:
    """A law of the user: a force in proportion to the error, and a torque."""

    period, delay = PERIOD, 2

    def __init__(self) -> None:
        self.seen: list[Measurement] = []
        self.loads: list[float] = []

    def command(self, measured: Measurement, load: float = 0.0) -> ControllerOutput:
        self.seen.append(measured)
        self.loads.append(load)
        return ControllerOutput(force=2000.0 * (0.024 - measured.depth), torque=1e-9)


def test_user_defined_law_runs_in_the_loop() -> None:
    """Its commands act after its delay, on the encoder measurements; the load on request."""
    own = Proportional()
    run = run_controller(own, NOMINAL, START, duration=0.1)
    assert len(own.seen) == len(run.time) - 1 == 100
    assert_allclose([m.depth for m in own.seen], run.depth[:-1], rtol=1e-15)
    assert (run.forces[:2, :2] == 0.0).all()
    assert_allclose(run.forces[2:-1, 0], 2000.0 * (0.024 - run.depth[:-3]), rtol=1e-12)
    assert (run.forces[2:, 1] == 1e-9).all()
    assert not any(own.loads)
    assert run.depth[-1] > run.depth[0]
    told = Proportional()
    run = run_controller(told, NOMINAL, START, duration=0.02, ground_truth=True)
    model = NeedleModel(NOMINAL)
    expected = [-model.bias_forces(x)[0] for x in run.states[:-1]]
    assert_allclose(told.loads, expected, rtol=1e-12)


class Blurred:
    """A controller with measurement noise and an additional force on its commands."""

    def __init__(self, controller: Controller, noise: FloatArray) -> None:
        self._controller, self._noise = controller, iter(noise)
        self.period, self.delay = controller.period, controller.delay

    def command(self, measured: Measurement, load: float = 0.0) -> ControllerOutput:
        depth, speed, _ = next(self._noise)
        return self._controller.command(
            measured._replace(depth=measured.depth + depth, velocity=measured.velocity + speed),
            load,
        )


def test_law_that_returns_a_number_is_rejected() -> None:

    class Number:
        period, delay = PERIOD, 1

        def command(self, _measured: Measurement, _load: float = 0.0) -> float:
            return 0.5

    with pytest.raises(ParameterError, match=r'Number.command must return a ControllerOutput'):
        run_controller(Number(), MODEL.parameters, STRAIGHT, duration=0.01)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ('change', 'complaint'),
    [
        ({'period': 0.0}, 'Proportional.period must be finite, > 0 s, got 0.0'),
        ({'period': np.nan}, 'Proportional.period must be finite, > 0 s, got nan'),
        ({'period': '1'}, "Proportional.period must be a number, got '1'"),
        ({'delay': -1}, 'Proportional.delay must be an integer from 0 to 1000000, got -1'),
        ({'delay': 0.5}, 'Proportional.delay must be an integer from 0 to 1000000, got 0.5'),
        ({'delay': None}, 'Proportional.delay must be an integer from 0 to 1000000, got None'),
        ({'duration': np.nan}, 'duration must be finite, >= 0.001 s, got nan'),
        ({'duration': 0.5 * PERIOD}, 'duration must be finite, >= 0.001 s, got 0.0005'),
        ({'duration': 2.5 * PERIOD}, 'duration must be a whole number of periods, got 0.0025'),
    ],
)
def test_invalid_periods_delays_and_durations_are_rejected(
    change: dict[str, Any], complaint: str
) -> None:
    """At the start, before a command."""
    own = Proportional()
    duration = change.pop('duration', 0.1)
    for name, value in change.items():
        setattr(own, name, value)
    with pytest.raises(ParameterError, match=f'^{re.escape(complaint)}'):
        run_controller(own, NOMINAL, START, duration=duration)
    assert not own.seen


def test_batch_noise_is_encoder_noise() -> None:
    """Noise is added to the measurements, not to the needle; the additional force moves it."""
    law = Pid(axis=Axis.insertion(NOMINAL), gains=PidGains(), period=PERIOD)
    count = round(DURATION / PERIOD)
    noise = np.random.default_rng(3).standard_normal((count, 3)) * [2e-6, 2e-4, 0.0]
    options: Any = {'delay': 1, 'limit': 15.0, 'duration': DURATION, 'step': 1e-4, 'record': True}
    batch = run_batch(law, NOMINAL, START, REFERENCE, noise=noise, **options)
    controller = Controller(
        NOMINAL, 'pid', reference='minimum_jerk', settings=ControllerSettings(rotation=False)
    )
    # The reference of the batch begins where the needle is.
    controller.set_target(0.024)
    controller.guide.at(0.0, 0.02)
    run = run_controller(Blurred(controller, noise), NOMINAL, START, duration=DURATION, step=1e-4)
    reached = np.abs(run.states).max(axis=0) + 1e-12
    assert_allclose(batch.trajectories[0] / reached, run.states / reached, atol=1e-9)
    beside = np.array([0.0, 0.0, 0.1])
    pushed = run_batch(law, NOMINAL, START, REFERENCE, noise=noise + beside, **options)
    plain = run_batch(law, NOMINAL, START, REFERENCE, noise=noise, **options)
    assert (pushed.commands < plain.commands).mean() > 0.9
    with pytest.raises(ParameterError, match='delay and late >= 0'):
        run_batch(law, NOMINAL, START, REFERENCE, late=-1, **options)
    for wrong in (noise[1:], noise.T, noise.ravel(), np.nan * noise, ['a']):
        with pytest.raises(NeedleError, match='noise must'):
            run_batch(law, NOMINAL, START, REFERENCE, noise=wrong, **options)
    for added in ([[0.01, -1.0, 0.0]], [[0.02, 1.0, 0.0], [0.01, 1.0, 0.0]]):
        with pytest.raises(ParameterError, match='added must have increasing depths'):
            run_batch(law, NOMINAL, START, REFERENCE, added=added, **options)
    for limit in (-15.0, np.nan):
        with pytest.raises(ParameterError, match='step and limit > 0'):
            run_batch(law, NOMINAL, START, REFERENCE, **{**options, 'limit': limit})


# Rounding, which the closed loop amplifies; four modes keep five digits, see `LARGEST_CONDITION`.
@pytest.mark.parametrize(
    ('modes', 'least', 'digits'), [(1, 0.0, 1e-9), (2, 0.0, 1e-9), (4, 0.06, 1e-5)]
)
def test_insertions_together_equal_batches_of_one(modes: int, least: float, digits: float) -> None:
    """Each with its own needle, reference, noise and delay; alone or not, to the bit."""
    law = InverseDynamics(
        axis=Axis.insertion(NOMINAL), gains=InverseDynamicsGains(), period=PERIOD
    )
    needle = replace(NOMINAL, modes=modes, minimum_depth=max(least, NOMINAL.minimum_depth))
    start = least + 0.02
    layers = {'layer_depths': (start + 0.001,), 'layer_stiffnesses': (4e3,), 'swelling': 0.2}
    changes: list[dict[str, Any]] = [layers, {'friction_law': 'stribeck'}, {}]
    models = [NeedleModel(replace(needle, **one)) for one in changes]
    starts = [model.state_at(start, 2e-4) for model in models]
    targets = [Setpoint(start), Setpoint(start), Setpoint(start + 1e-4)]
    references = [
        MinimumJerk(one, start + path, ReferenceLimits())
        for one, path in zip(targets, (0.004, 0.002, 0.006), strict=True)
    ]
    rng = np.random.default_rng(2)
    noises = [1e-6 * rng.standard_normal((count, 3)) for count in (700, 400, 900)]
    lates = [0, 1, 2]
    options: Any = {'delay': 1, 'limit': 15.0, 'step': 3e-4}
    together = run_insertions(law, models, starts, references, noises, lates, **options)
    for i, found in enumerate(together):
        one: Any = [[values[i]] for values in (models, starts, references, noises, lates)]
        alone = run_insertions(law, *one, **options)[0]
        assert np.array_equal(found.motion, alone.motion)
        assert np.array_equal(found.commands, alone.commands)
        batch = run_batch(
            law, models[i].parameters, starts[i], references[i], noise=noises[i], late=lates[i],
            duration=len(noises[i]) * PERIOD, record=True, **options,
        )  # fmt: skip
        assert found.completed == len(noises[i]) == len(found.commands)
        assert np.array_equal(found.goal, batch.goal)
        motion = motion_of(models[i], batch.trajectories[0])
        reached = np.abs(motion).max(axis=1, keepdims=True)
        assert_allclose(found.motion / reached, motion / reached, atol=digits)
        assert_allclose(found.commands, batch.commands[0], atol=1e2 * digits)


def test_insertion_ends_where_its_needle_leaves_its_range() -> None:
    """The motion is kept up to there, and the other needles continue."""
    law = Pid(axis=Axis.insertion(NOMINAL), gains=PidGains(), period=PERIOD)
    model, out = NeedleModel(NOMINAL), MinimumJerk(Setpoint(2e-3), -0.01, ReferenceLimits())
    starts = [model.state_at(2e-3)] * 2
    options: Any = {'delay': 1, 'limit': 15.0, 'step': 2e-4}
    rest = MinimumJerk(Setpoint(2e-3), 3e-3, ReferenceLimits())
    found = run_insertions(
        law, [model] * 2, starts, [out, rest], [np.zeros((1000, 3))] * 2, [0, 0], **options
    )
    batch = run_batch(law, NOMINAL, starts[0], out, duration=1.0, record=True, **options)
    ended = found[0].completed
    assert 0 < ended == batch.completed[0] < 1000
    assert np.isfinite(found[0].motion[:, ended]).all()
    assert np.isnan(found[0].motion[:, ended + 1 :]).all()
    assert found[1].completed == 1000
    alone = run_batch(law, NOMINAL, starts[1], rest, duration=1.0, record=True, **options)
    depth = NOMINAL.length - alone.states[0, 0]
    assert_allclose(found[1].motion[0, -1], depth, rtol=1e-9)


def test_batch_is_independent_of_threads_and_step() -> None:
    law = Pid(axis=Axis.insertion(NOMINAL), gains=PidGains(), period=PERIOD)
    needles = plants(5)

    def run(**how: Any) -> LoopBatch:
        return run_batch(law, needles, START, REFERENCE, delay=1, limit=15.0, duration=0.8, **how)

    one, two, fine = run(workers=1, step=PERIOD), run(workers=2, step=PERIOD), run(step=1e-5)
    assert (one.states == two.states).all()
    assert (one.final == two.final).all()
    # Nanometers: the modal flow is exact at any step, and the needle is slow.
    assert_allclose(one.largest, fine.largest, atol=1e-9)


def test_runs_that_leave_the_depth_range_are_marked() -> None:
    shallow = NeedleModel(NOMINAL).state_at(0.0012)
    out = MinimumJerk(Setpoint(0.0012), 0.0, ReferenceLimits())
    law = Pid(axis=Axis.insertion(NOMINAL), gains=PidGains(), period=PERIOD)
    batch = run_batch(law, NOMINAL, shallow, out, delay=1, limit=15.0, duration=1.0)
    assert 0 < batch.completed[0] < 1000


def test_batch_rejects_inconsistent_arguments() -> None:
    law = Pid(axis=Axis.insertion(NOMINAL), gains=PidGains(), period=PERIOD)
    options: Any = {'delay': 1, 'limit': 15.0, 'duration': 0.1}
    with pytest.raises(ShapeError, match='same number of runs'):
        run_batch([law, law], plants(3), START, REFERENCE, **options)
    other = Pid(axis=law.axis, gains=PidGains(), period=2e-3)
    with pytest.raises(ParameterError, match='same period'):
        run_batch([law, other], NOMINAL, START, REFERENCE, **options)
    with pytest.raises(ParameterError, match='duration must be'):
        run_batch(law, NOMINAL, START, REFERENCE, delay=1, limit=15.0, duration=0.0)


def test_friction_change_during_a_run_equals_another_needle() -> None:
    """From the start it equals a needle with more friction; later, the same until the change."""
    needle, start = NeedleParameters.preset('phantom'), Setpoint(0.02)
    reference = MinimumJerk(start, 0.03, ReferenceLimits())
    law = Pid(axis=Axis.insertion(needle), gains=PidGains(), period=1e-3)
    more = replace(needle, coulomb_friction=1.0, viscous_friction=400.0)
    added = 1.0 - needle.coulomb_friction, 400.0 - needle.viscous_friction
    state = NeedleModel(needle).state_at(0.02)

    def run(plant: NeedleParameters, along: Any = ()) -> FloatArray:
        return run_batch(
            law, plant, state, reference, delay=1, limit=15.0, duration=3.0, added=along, keep=True
        ).depths[0]

    plain, whole = run(needle), run(needle, [(0.0, *added)])
    # The sums of friction are rounded.
    assert_allclose(whole, run(more), rtol=0.0, atol=1e-12)
    later = run(needle, [(0.025, *added)])
    same = plain < 0.025
    assert_allclose(later[same], plain[same], rtol=0.0, atol=1e-15)
    assert np.abs(later - plain).max() > 1e-5
    with pytest.raises(ParameterError, match='added must have increasing depths'):
        run(needle, [(0.025, *added), (0.02, *added)])
