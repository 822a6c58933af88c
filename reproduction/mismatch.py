# SPDX-License-Identifier: Apache-2.0
"""
Simulate the control laws with 30 % mismatch of friction and stiffness.

The sampled laws of the controller node run at 1 kHz with default gains, and as in the paper:
inverse dynamics without feedback, PID without integral. They actuate the base (`physical`). The
nominal model is the preset; the plant parameters are sampled for each run.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from matplotlib.figure import Figure
from needle_controller import (
    Axis,
    ControllerSettings,
    InverseDynamics,
    InverseDynamicsGains,
    Law,
    LoopBatch,
    MinimumJerk,
    Pid,
    PidGains,
    ReferenceLimits,
    run_batch,
    Setpoint,
)
from needle_dynamics import FloatArray, NeedleModel, NeedleParameters
from needle_dynamics.parameters import PAPER_NEEDLE
from needle_insertion.report.content import Picture
import numpy as np
from reproduction.content import Grid, ReportSection
from reproduction.figures import LAW_COLORS
from reproduction.runs import LAWS

#: Largest relative deviation of the uniform distributions, and the sampled constants.
WIDTH: Final = 0.3
DRAWN: Final = ('coulomb_friction', 'viscous_friction', 'tissue_stiffness')

#: Insertion: start and target depth [m], and duration of the run [s]; the reference takes 9.4 s.
START: Final = 0.02
TARGET: Final = 0.07
DURATION: Final = 11.5
DEFLECTION: Final = 5e-4

#: Longest step [s]: the modal flow is exact; a step of 1/100 changes no error by a nanometer.
STEP: Final = 1e-3

PRESET: Final = PAPER_NEEDLE  #: Preset of the nominal model, and mean of the plants.

#: Cases: description and delay [periods].
CASES: Final[Mapping[str, tuple[str, int]]] = {
    'inverse_dynamics': ('inverse dynamics', 1),
    'pid': ('PID', 1),
    'paper_inverse_dynamics': ('inverse dynamics, as in the paper', 1),
    'paper_pid': ('PID, as in the paper', 1),
    'paper_inverse_dynamics_at_once': ('inverse dynamics, as in the paper, no delay', 0),
    'paper_pid_at_once': ('PID, as in the paper, no delay', 0),
}

_MEASURES: Final = {
    'final': 'depth error at the end',
    'largest': 'largest depth error',
    'rms': 'rms depth error',
}


@dataclass(frozen=True, slots=True, eq=False)
class Mismatch:
    """Results of the mismatch study."""

    factors: FloatArray  #: Ratio of true to nominal mu_s, mu_v and k_a, shape (runs, 3).
    #: Runs of each of `CASES`, and run of each case without mismatch.
    batches: Mapping[str, LoopBatch]
    nominal: Mapping[str, LoopBatch]

    def shares(self, law: str) -> FloatArray:
        """Return the variance of the means in 20 bins of a factor over the whole, shape (3,)."""
        final = self.batches[law].final
        shares = np.zeros(len(DRAWN))
        for k, factor in enumerate(self.factors.T):
            bins = np.array_split(final[np.argsort(factor)], min(20, len(final)))
            spread = sum(len(one) * (one.mean() - final.mean()) ** 2 for one in bins)
            shares[k] = spread / max(len(final) * final.var(), np.finfo(float).tiny)
        return shares


def study(
    runs: int = 1000,
    seed: int = 2014,
    *,
    step: float = STEP,
    progress: Callable[[], object] | None = None,
) -> Mismatch:
    """Run all `CASES` on the same plants; ``step`` is the longest integrator step [s]."""
    nominal = NeedleParameters.preset(PRESET)
    factors = np.random.default_rng(seed).uniform(1.0 - WIDTH, 1.0 + WIDTH, (runs, len(DRAWN)))
    means = np.array([getattr(nominal, name) for name in DRAWN])
    drawn: list[dict[str, Any]] = [
        dict(zip(DRAWN, map(float, row), strict=True)) for row in factors * means
    ]
    plants = [replace(nominal, **constants) for constants in drawn]
    start = NeedleModel(nominal).state_at(START, DEFLECTION)
    reference = MinimumJerk(Setpoint(START), TARGET, ReferenceLimits())
    settings = ControllerSettings()

    def run(case: str, needles: list[NeedleParameters]) -> LoopBatch:
        return run_batch(
            laws[case.removesuffix('_at_once')],
            needles,
            start,
            reference,
            delay=CASES[case][1],
            limit=settings.force_limit,
            duration=DURATION,
            step=step,
            progress=progress,
        )

    laws = sampled_laws(nominal, 1.0 / settings.rate)
    return Mismatch(
        factors,
        {case: run(case, plants) for case in CASES},
        {case: run(case, [nominal]) for case in CASES},
    )


def sampled_laws(parameters: NeedleParameters, period: float) -> dict[str, Law]:
    """Return the insertion laws for a nominal model, default and paper gains; period in s."""
    axis = Axis.insertion(parameters)

    def inverse(gains: InverseDynamicsGains) -> InverseDynamics:
        return InverseDynamics(axis=axis, gains=gains, period=period)

    return {
        'inverse_dynamics': inverse(InverseDynamicsGains()),
        'pid': Pid(axis=axis, gains=PidGains(), period=period),
        'paper_inverse_dynamics': inverse(InverseDynamicsGains(bandwidth=0.0)),
        'paper_pid': Pid(axis=axis, gains=PidGains(ki=0.0), period=period),
    }


def _table(found: Mismatch) -> Grid:
    """Return median, 95 % quantile and maximum of each error, and the error without mismatch."""
    rows = []
    for law, batch in found.batches.items():
        for name, words in _MEASURES.items():
            values = 1e3 * np.abs(getattr(batch, name))
            middle, most = np.quantile(values, (0.5, 0.95))
            known = 1e3 * abs(float(getattr(found.nominal[law], name)[0]))
            cells = (f'{value:.3g}' for value in (known, middle, most, values.max()))
            rows.append((f'{CASES[law][0]}: {words} [mm]', *cells))
    return Grid(
        caption=f'{len(found.factors)} insertions with friction and stiffness up to '
        f'{100.0 * WIDTH:g} % off',
        heads=('error', 'needle known', 'median', '95 % below', 'largest'),
        rows=tuple(rows),
    )


def _figure(found: Mismatch) -> Figure:
    """Draw the distribution of each error, and the final error against the mismatch of mu_s."""
    figure = Figure(figsize=(12.0, 4.2), layout='constrained')
    axes = figure.subplots(1, 4)
    drawn = {law: found.batches[law] for law in LAWS}
    for panel, (name, words) in zip(axes[:3], _MEASURES.items(), strict=True):
        for law, batch in drawn.items():
            values = np.sort(1e3 * np.abs(getattr(batch, name)))
            share = np.arange(1, len(values) + 1) / len(values)
            panel.step(values, share, where='post', color=LAW_COLORS[law], label=LAWS[law])
            known = 1e3 * abs(float(getattr(found.nominal[law], name)[0]))
            panel.axvline(known, color=LAW_COLORS[law], linestyle=':', linewidth=1.0)
        panel.set(xscale='log', xlabel=f'{words} [mm]', ylim=(0.0, 1.0))
    axes[0].set_ylabel('fraction of the runs')
    axes[0].legend(fontsize='small')
    friction = 100.0 * (found.factors[:, 0] - 1.0)
    for law, batch in drawn.items():
        axes[3].plot(friction, 1e3 * batch.final, '.', markersize=2.5, color=LAW_COLORS[law])
    axes[3].set(xlabel=r'true $\mu_s$ over nominal - 1 [%]', ylabel='signed error at the end [mm]')
    for panel in axes:
        panel.grid(visible=True, alpha=0.3)
    return figure


def section(found: Mismatch) -> ReportSection:
    final = {name: 1e6 * np.median(np.abs(b.final)) for name, b in found.batches.items()}
    rms = {name: 1e6 * np.median(b.rms) for name, b in found.batches.items()}
    stiffness = 100.0 * found.shares('inverse_dynamics')[2]
    caption = (
        'Distribution of the errors over the runs (dotted: exact model), and the final error '
        'against the error in mu_s. The integral of each law continues until the '
        'error is within its tolerance.'
    )
    return ReportSection(
        title='Mismatch between needle and model',
        paragraphs=(
            (
                f'{len(found.factors)} insertions from {100.0 * START:g} to {100.0 * TARGET:g} cm '
                'in 9.4 s with each law, at 1 kHz, default gains, f_y alone. mu_s, mu_v, k_a of '
                'the needle are each uniform within 30 % of the nominal values (preset '
                f'{PRESET}; the same needles for all laws). No observer: the laws do not '
                'compensate the force of the bent needle, whose initial deflection of 0.5 mm '
                'decays within tens of milliseconds.'
            ),
            (
                f'Inverse dynamics with its feedback ends {final["inverse_dynamics"]:.2g} um from '
                f'the goal in the median, with an rms error of {rms["inverse_dynamics"]:.2g} um; '
                f'PID {final["pid"]:.2g} um and {rms["pid"]:.2g} um. The integral of both removes '
                'unmodeled forces, and the feed-forward of inverse dynamics reduces them. '
                f'k_a explains {stiffness:.0f} % of the variance of its final error: the '
                'stiffness of the tissue does not affect the base of a nearly straight needle.'
            ),
            (
                'As in the paper, inverse dynamics has no feedback of the mismatch, '
                'and compensates friction with the measured velocity. With a delay of one '
                f'period it ends {final["paper_inverse_dynamics"]:.2g} um from the goal (PID '
                f'without integral: {final["paper_pid"]:.2g} um). Without delay it '
                'overcompensates friction and oscillates: '
                f'{final["paper_inverse_dynamics_at_once"]:.2g} um '
                f'({final["paper_pid_at_once"]:.2g} um).'
            ),
        ),
        tables=(_table(found),),
        pictures=(Picture('mismatch', caption, _figure(found)),),
    )
