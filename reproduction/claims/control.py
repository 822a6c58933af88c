# SPDX-License-Identifier: Apache-2.0
"""Verdicts on claims about the controllers and their figures, sections 3.2.7 and 3.2.8."""

from math import exp, sqrt

from needle_controller import Axis, LoopRun, Pid, PidGains
from needle_controller.stability import stability_limit
from needle_dynamics import NeedleParameters
import numpy as np
from reproduction import runs
from reproduction.claims.claim import Finding, finding


def _with_hub(law: str, factors: tuple[float, float] = (1.0, 1.0)) -> LoopRun:
    """Return a closed loop of figure 7 or 8 with 0.3 N s/mm."""
    return runs.closed_loop(law, 'paper_mm', 'complete', hub_stop=True, factors=factors)


def _error_equation() -> Finding:
    """Compare the error of inverse dynamics with the exact solution of its equation."""
    run = runs.closed_loop('inverse_dynamics', 'paper_si', 'complete')
    early = run.time <= 20.0
    times, start = run.time[early], run.model.state_at(runs.DEPTH, runs.DEFLECTION)
    error = 0.0
    for k in (0, 2, 3):
        damping = 0.5 * runs.INVERSE_DYNAMICS_KV[k]
        w = sqrt(runs.INVERSE_DYNAMICS_KP[k] - damping**2)
        exact = np.exp(-damping * times) * (np.cos(w * times) + damping / w * np.sin(w * times))
        error = max(error, float(np.abs(run.states[early, k] / start[k] - exact).max()))
    p = run.model.parameters
    return finding(
        {
            'error': error,
            'pushed_mn': 1e3
            * p.moving_mass
            * runs.INVERSE_DYNAMICS_KP[0]
            * (p.length - runs.DEPTH),
            'friction': p.coulomb_friction,
        },
        always=False,
        sometimes=error < 1e-3,
    )


def _positive_definite() -> Finding:
    """Test stability by the poles of the sampled loop."""
    p = NeedleParameters.preset('paper_mm')
    gains = PidGains(kp=runs.PID_KP, ki=0.0, kd=runs.PID_KV, tolerance=0.0)
    slow, fast = (
        stability_limit(Pid(axis=Axis.insertion(p), gains=gains, period=1.0 / rate), 1).radius
        for rate in (1e3, 1e6)
    )
    # The textbook form holds the force of the last sample for a period of 1 ms.
    decay = exp(-p.viscous_friction / p.moving_mass * 1e-3)
    textbook = decay - (1.0 - decay) * runs.PID_KV / p.viscous_friction
    ends = [runs.RunOutcome.of(_with_hub(law)).final for law in runs.LAWS]
    return finding(
        {'at_1_khz': slow, 'at_1_mhz': fast, 'textbook': textbook},
        always=max(slow, fast) < 1.0,
        sometimes=max(ends) < 1e-6,
    )


def _same_inputs() -> Finding:
    """Test the inputs by the forces at the start of figures 6 to 8."""
    inverse, pid = (
        runs.closed_loop(law, 'paper_si', 'complete', hub_stop=True).forces[0, 2:]
        for law in runs.LAWS
    )
    return finding(
        {
            'inverse_1': float(inverse[0]),
            'inverse_2': float(inverse[1]),
            'pid_1': float(pid[0]),
            'pid_2': float(pid[1]),
        },
        always=not inverse.any() and not pid.any(),
        sometimes=True,
    )


def _turns(run: LoopRun) -> int:
    tip = run.tip_deflection
    tip = tip[np.abs(tip) > 1e-9]
    return int(np.count_nonzero(np.diff(np.sign(tip))))


def _tip_varies() -> Finding:
    """Test figure 4 by the peak of the tip deflection."""
    found = [runs.RunOutcome.of(runs.open_loop(*case)) for case in runs.CASES]
    return finding(
        {
            'turns': _turns(runs.open_loop(*runs.CASES[0])),
            'peak_mm': 1e3 * found[0].peak,
            'peak_ms': 1e3 * found[0].peak_time,
        },
        always=all(abs(one.peak) > runs.DEFLECTION for one in found),
    )


def _smoother() -> Finding:
    """Compare sign changes of the tip deflection per second."""

    def rate(run: LoopRun) -> float:
        return _turns(run) / float(run.time[-1])

    free_run = runs.open_loop('paper_mm', 'complete')
    free, controlled = rate(free_run), max(rate(_with_hub(law)) for law in runs.LAWS)
    alone = min(rate(runs.base_alone(law, 'paper_mm')) for law in runs.LAWS)
    peaks = [
        1e3 * abs(runs.RunOutcome.of(run).peak) for run in (free_run, *map(_with_hub, runs.LAWS))
    ]
    return finding(
        {
            'free': free,
            'controlled': controlled,
            'alone': alone,
            **dict(zip(('free_mm', 'inverse_mm', 'pid_mm'), peaks, strict=True)),
        },
        always=alone < 1.0,
        sometimes=controlled < 0.1 * free,
    )


def _zero_deflection() -> Finding:
    """Test the remaining deflection under inverse dynamics."""
    modal = max(
        runs.RunOutcome.of(runs.closed_loop('inverse_dynamics', *case, hub_stop=hub)).final
        for case in runs.CASES
        for hub in (False, True)
    )
    alone = min(
        runs.RunOutcome.of(runs.base_alone('inverse_dynamics', reading)).final
        for reading in runs.READINGS
    )
    pid = runs.RunOutcome.of(_with_hub('pid')).final
    return finding(
        {'modal_nm': 1e9 * modal, 'alone_mm': 1e3 * alone, 'pid_nm': 1e9 * pid},
        always=alone < 1e-6,
        sometimes=modal < 1e-6,
    )


def _fully_inserted() -> Finding:
    """Test the target state by the insertion depth."""
    free, held = (
        runs.closed_loop('inverse_dynamics', 'paper_si', 'complete', hub_stop=hub)
        for hub in (False, True)
    )
    deepest, stopped = runs.RunOutcome.of(free).deepest, runs.RunOutcome.of(held).deepest
    return finding(
        {'deepest_cm': 100.0 * deepest, 'arrival': runs.hub_time(held)},
        always=deepest <= 0.2,
        sometimes=stopped <= 0.2,
    )


def _minimum_deflection() -> Finding:
    """Compare the PID gains with four other pairs of gains by the peak deflection."""
    pairs = (1.0, 1.0), (2.0, 1.0), (0.5, 1.0), (1.0, 2.0), (1.0, 0.5)
    peaks = {pair: 1e3 * abs(runs.RunOutcome.of(_with_hub('pid', pair)).peak) for pair in pairs}
    best = min(peaks, key=lambda pair: peaks[pair])
    paper = peaks[1.0, 1.0]
    return finding(
        {
            'paper_mm': paper,
            'half_kv_mm': peaks[1.0, 0.5],
            'least_mm': peaks[best],
            'kp': best[0],
            'kv': best[1],
            'rank': sorted(peaks.values()).index(paper) + 1,
        },
        always=best == (1.0, 1.0),
    )
