# SPDX-License-Identifier: Apache-2.0
"""
Runs for figures 4 to 8: both readings of Table 1 and both formulations.

The paper does not describe the computation of its figures. Here the integrator of the simulated
plant solves the open loop, and `run_continuous` the closed loops in continuous time, with a
generalized force on every coordinate, as the gain matrices of the paper require (`modal`). For
comparison the same laws run with f_y alone, the only force of a robot at the needle base.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from math import sqrt
from typing import Final

from needle_controller import ContinuousInverseDynamics, ContinuousPid, LoopRun, run_continuous
from needle_controller.laws.continuous import ContinuousLaw
from needle_dynamics import FORMULATIONS, Integrator, NeedleModel, NeedleParameters, simulate
import numpy as np

#: Readings of Table 1, and their combinations with both formulations.
READINGS: Final = ('paper_si', 'paper_mm')
CASES: Final = tuple(product(READINGS, FORMULATIONS))

#: Laws of section 3.2.7 and their names in text.
LAWS: Final[Mapping[str, str]] = {'inverse_dynamics': 'inverse dynamics', 'pid': 'PID'}

#: Section 3.2.8: insertion depth [m], tip deflection [m], and open-loop force [N].
DEPTH: Final = 0.02
DEFLECTION: Final = 5e-4
FORCE: Final = 3.0

#: Gains of section 3.2.8. The paper gives no gains for theta; here they equal the gains of d.
INVERSE_DYNAMICS_KP: Final = (1.0, 1.0, 10.0, 10.0)
INVERSE_DYNAMICS_KV: Final = tuple(0.1 * gain for gain in INVERSE_DYNAMICS_KP)
PID_KP: Final = 1e3
PID_KV: Final = 1e4

#: Duration of the open loop in either reading, and of the closed loop under either law [s].
OPEN_LOOP: Final[Mapping[str, float]] = {'paper_si': 0.035, 'paper_mm': 24.0}
CLOSED_LOOP: Final = {'inverse_dynamics': 150.0, 'pid': 150.0}

SHOWN: Final = 40.0  #: Drawn part of a closed loop, with denser samples [s].


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOutcome:
    """Metrics of a run."""

    #: Signed tip deflection of largest magnitude [m], and its time [s].
    peak: float
    peak_time: float
    final: float  #: Largest magnitude of the tip deflection [m] over the last tenth of the run.
    error: float  #: Final d [m]: the position error, as q_d = 0.
    deepest: float  #: Largest insertion depth [m].
    end: float  #: Final time [s].

    @classmethod
    @cache
    def of(cls, run: LoopRun) -> RunOutcome:
        tip = run.tip_deflection
        k = int(np.abs(tip).argmax())
        late = run.time >= run.time[0] + 0.9 * (run.time[-1] - run.time[0])
        return cls(
            peak=float(tip[k]),
            peak_time=float(run.time[k]),
            final=float(np.abs(tip[late]).max()),
            error=float(run.states[-1, 0]),
            deepest=float(run.depth.max()),
            end=float(run.time[-1]),
        )


def needle(reading: str, formulation: str, *, hub_stop: bool = True) -> NeedleModel:
    """Return the model of the paper's figures for a reading (preset) and a formulation."""
    return NeedleModel(
        NeedleParameters.preset(reading, formulation=formulation, hub_stop=hub_stop)
    )


@cache
def open_loop(reading: str, formulation: str, deflection: float = DEFLECTION) -> LoopRun:
    """Run the open loop of figures 4 and 5: 3 N from a tip deflection [m] to beyond the hub."""
    model = needle(reading, formulation)
    duration = OPEN_LOOP[reading]  # at least 3500 samples
    run = simulate(
        model.parameters,
        model.state_at(DEPTH, deflection),
        FORCE,
        duration=duration,
        interval=1e-5 if duration < 1.0 else 1e-4,
        step=1e-5,
    )
    forces = np.zeros((len(run.time), model.coordinates))
    forces[:, 0] = FORCE
    return LoopRun(model, run.time, run.states, forces)


def paper_law(
    name: str, model: NeedleModel, factors: tuple[float, float] = (1.0, 1.0)
) -> ContinuousLaw:
    """Return a continuous law with the paper's gains times ``factors`` on k_p and k_v, `modal`."""
    kp, kv = factors
    if name == 'pid':
        ones = np.ones(model.coordinates)
        return ContinuousPid(
            model=model, actuation='modal', kp=kp * PID_KP * ones, kd=kv * PID_KV * ones
        )
    return ContinuousInverseDynamics(
        model=model,
        actuation='modal',
        kp=kp * np.array(INVERSE_DYNAMICS_KP),
        kv=kv * np.array(INVERSE_DYNAMICS_KV),
    )


@cache
def closed_loop(
    law: str,
    reading: str,
    formulation: str,
    *,
    hub_stop: bool = False,
    factors: tuple[float, float] = (1.0, 1.0),
) -> LoopRun:
    """
    Run a closed loop of figures 6 to 8, with a generalized force on every coordinate.

    Reading and formulation apply to plant and law; ``factors`` scale k_p and k_v. Samples are 25
    ms apart up to 40 s, and 100 ms up to 150 s unless the hub stops the needle before or the
    factors are not 1.
    """
    model = needle(reading, formulation, hub_stop=hub_stop)
    # With the hub, inverse dynamics reaches its target within two seconds and stays there. Runs
    # with other gains are used for their peaks within 20 s, with relative accuracy 1e-3.
    brief = factors != (1.0, 1.0) or (hub_stop and law == 'inverse_dynamics')
    times = np.linspace(0.0, SHOWN, round(40.0 * SHOWN) + 1)
    if not brief:
        end = CLOSED_LOOP[law]
        late = np.linspace(SHOWN, end, round(10.0 * (end - SHOWN)) + 1)
        times = np.append(times, late[1:])
    return run_continuous(
        paper_law(law, model, factors),
        model,
        model.state_at(DEPTH, DEFLECTION),
        np.zeros((3, model.coordinates)),
        times,
        tolerance=1e-6 if factors == (1.0, 1.0) else 1e-4,
        method='Radau' if law == 'pid' else 'DOP853',
    )


@cache
def base_alone(law: str, reading: str) -> LoopRun:
    """
    Run a closed loop with the paper's gains on d and no force on q1 and q2, `complete`.

    Inverse dynamics imposes the motion of its error equation on d, so the base is moved by it.
    Under PID with a constant target, k_v e_dot is added to the viscous friction of the plant.
    Samples are 5 ms apart, up to 10 s (inverse dynamics, stopped by the hub) or 120 s (PID).
    """
    model = needle(reading, 'complete')
    parameters, state = model.parameters, model.state_at(DEPTH, DEFLECTION)
    period, count = 5e-3, 2000
    if law == 'pid':
        count = 24000
        viscous = parameters.viscous_friction + PID_KV
        parameters = replace(parameters, viscous_friction=viscous)
    integrator = Integrator(parameters, state, graded=True)
    states = [integrator.state]
    forces = np.zeros((count + 1, model.coordinates))
    for k in range(count):
        if law == 'pid':
            # Constant over 5 ms, 5e-4 of the time constant k_v / k_p.
            force = PID_KP * float(states[-1][0])
            integrator.advance(period, force)
            forces[k, 0] = force - PID_KV * integrator.velocity
        else:
            speed = 0.0 if states[-1][0] <= 0.0 else _error_speed((k + 1) * period)
            forces[k, 0] = integrator.advance_moved(period, speed).axial_force
        states.append(integrator.state)
    time = period * np.arange(count + 1, dtype=np.float64)
    return LoopRun(model, time, np.array(states), forces)


def _error_speed(time: float) -> float:
    """Return the insertion velocity of e_ddot + k_v e_dot + k_p e = 0 from rest [m/s]."""
    damping, square = 0.5 * INVERSE_DYNAMICS_KV[0], INVERSE_DYNAMICS_KP[0]
    frequency = sqrt(square - damping**2)
    start = NeedleParameters().length - DEPTH
    swing = np.exp(-damping * time) * np.sin(frequency * time)
    return float(start * square / frequency * swing)


def hub_time(run: LoopRun) -> float:
    """Return the time at which a run reached the hub [s]; nan if it did not."""
    there = np.flatnonzero(run.states[:, 0] <= 0.0)
    return float(run.time[there[0]]) if len(there) else float('nan')
