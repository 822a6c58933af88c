"""
Figures 4 to 8 of the paper, run anew: both readings of Table 1 and both formulations.

The paper does not say how its figures were computed. Here the open loop is integrated by the
structure-preserving integrator and the continuous closed loops by `run_continuous`, with a
generalized force on every coordinate as the paper's gain matrices ask for (`modal`). What the same
laws do with f_y alone (`physical`) stands beside them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from math import sqrt
from typing import Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from needle_controller import (
    ContinuousInverseDynamics,
    ContinuousLaw,
    ContinuousPid,
    LoopRun,
    run_continuous,
)
from needle_dynamics import (
    FloatArray,
    FORMULATIONS,
    Integrator,
    NeedleModel,
    NeedleParameters,
    simulate_batch,
)
from needle_insertion.report.picture import Picture
from needle_insertion.report.section import Grid, Section
import numpy as np

#: Both readings of Table 1, in the order of the figures.
READINGS: Final = ('paper_si', 'paper_mm')
CASES: Final = tuple(product(READINGS, FORMULATIONS))

#: Laws of section 3.2.7, and how they are called and drawn.
LAWS: Final[Mapping[str, str]] = {'inverse_dynamics': 'inverse dynamics', 'pid': 'PID'}
LAW_COLORS: Final[Mapping[str, str]] = {'inverse_dynamics': '#c25a00', 'pid': '#1f5fa8'}

#: Section 3.2.8: 2 cm inserted, tip deflected by 0.5 mm, 3 N in the open loop.
DEPTH: Final = 0.02
DEFLECTION: Final = 5e-4
FORCE: Final = 3.0

#: Gains of section 3.2.8; the paper leaves theta out, which here keeps the gain of d.
INVERSE_DYNAMICS_KP: Final = (1.0, 1.0, 10.0, 10.0)
INVERSE_DYNAMICS_KV: Final = tuple(0.1 * gain for gain in INVERSE_DYNAMICS_KP)
PID_KP: Final = 1e3
PID_KV: Final = 1e4

#: Duration of the open loop in either reading, and of the closed loop under either law [s].
OPEN_LOOP: Final[Mapping[str, float]] = {'paper_si': 0.035, 'paper_mm': 24.0}
CLOSED_LOOP: Final = {'inverse_dynamics': 150.0, 'pid': 150.0}

#: What of a closed loop is drawn [s].
_SHOWN: Final = 40.0

_COLORS: Final = dict(zip(CASES, ('#1f5fa8', '#c25a00', '#2a9d5c', '#7b3fa0'), strict=True))
_DASHES: Final = dict(zip(CASES, ('-', '--', '-.', ':'), strict=True))


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """
    What came out of one run.

    Attributes
    ----------
    peak, peak_time : float
        Largest tip deflection, with its sign [m], and when it was reached [s].
    final : float
        Largest modulus of the tip deflection [m] over the last tenth of the run.
    error : float
        d at the end [m]: the position error, as q_d = 0.
    deepest : float
        Largest inserted length [m].
    end : float
        Time at the end [s].

    """

    peak: float
    peak_time: float
    final: float
    error: float
    deepest: float
    end: float

    @classmethod
    @cache
    def of(cls, run: LoopRun) -> Outcome:
        """Take it from a run."""
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

    def row(self) -> tuple[str, ...]:
        """Return the cells of a table, in millimeters and seconds."""
        return (
            f'{1e3 * self.peak:.4g}',
            f'{self.peak_time:.4g}',
            _millimeters(self.final),
            _millimeters(self.error),
            f'{1e3 * self.deepest:.4g}',
            f'{self.end:.4g}',
        )


_HEADS: Final = (
    *('peak of the tip [mm]', 'at [s]', 'tip at the end [mm]', 'd at the end [mm]'),
    *('most inserted [mm]', 'end [s]'),
)


def _millimeters(value: float) -> str:
    """Write a length; what is less than a nanometer is rounding of the solver."""
    return f'{1e3 * value:.3g}' if abs(value) >= 1e-9 else '< 1e-6'


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperFigure:
    """
    One figure of the paper, run anew.

    Attributes
    ----------
    picture : Picture
        Figure and caption.
    outcomes : Mapping[tuple of str, Outcome]
        What came out, by reading and formulation, and for a closed loop 'hub' or 'no hub'.

    """

    picture: Picture
    outcomes: Mapping[tuple[str, ...], Outcome]

    def table(self, title: str = '') -> Grid:
        """
        Return the numbers as a table.

        Parameters
        ----------
        title : str
            What it is of; the figure if empty.

        Returns
        -------
        Grid
            One row a run.

        """
        title = title or self.picture.caption.partition(',')[0]
        rows = tuple((_label(case), *found.row()) for case, found in self.outcomes.items())
        return Grid(
            caption=f'{title}: what came out of each run', heads=('run', *_HEADS), rows=rows
        )


def needle(reading: str, formulation: str, *, hub_stop: bool = True) -> NeedleModel:
    """Return the needle of the paper's figures."""
    return NeedleModel(
        NeedleParameters.preset(reading, formulation=formulation, hub_stop=hub_stop)
    )


@cache
def open_loop(reading: str, formulation: str, deflection: float = DEFLECTION) -> LoopRun:
    """
    Run the open loop of figures 4 and 5: 3 N from the start, up to the hub and beyond.

    Parameters
    ----------
    reading, formulation : str
        Preset and formulation.
    deflection : float
        Initial deflection of the tip [m].

    Returns
    -------
    LoopRun
        3500 samples or more; some modes are faster than they are.

    """
    model = needle(reading, formulation)
    duration = OPEN_LOOP[reading]
    interval = 1e-5 if duration < 1.0 else 1e-4
    batch = simulate_batch(
        model.parameters,
        model.state_at(DEPTH, deflection),
        FORCE,
        duration=duration,
        interval=interval,
        step=1e-5,
        workers=1,
    )
    forces = np.zeros((len(batch.time), model.coordinates))
    forces[:, 0] = FORCE
    return LoopRun(model, batch.time, batch.states[0], forces)


def paper_law(
    name: str, model: NeedleModel, factors: tuple[float, float] = (1.0, 1.0)
) -> ContinuousLaw:
    """
    Return a law of section 3.2.7 with the paper's gains, in continuous time, `modal`.

    Parameters
    ----------
    name : str
        One of `LAWS`.
    model : NeedleModel
        Needle that the law believes in.
    factors : tuple of float
        Factors on k_p and k_v.

    Returns
    -------
    ContinuousLaw
        The law.

    """
    kp, kv = factors
    if name == 'pid':
        count = model.coordinates
        return ContinuousPid(
            model=model,
            actuation='modal',
            kp=np.full(count, kp * PID_KP),
            kd=np.full(count, kv * PID_KV),
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

    Parameters
    ----------
    law : str
        One of `LAWS`.
    reading, formulation : str
        Preset and formulation, of the needle and of the law.
    hub_stop : bool
        Whether the hub stops the needle.
    factors : tuple of float
        Factors on k_p and k_v.

    Returns
    -------
    LoopRun
        Samples every 25 ms up to 40 s, and every 100 ms up to 150 s if the hub does not stop the
        needle before and the factors are 1.

    """
    model = needle(reading, formulation, hub_stop=hub_stop)
    # With the hub, inverse dynamics reaches its goal within two seconds and stays there. Other
    # gains are for their peaks, within 20 s, to a thousandth.
    brief = factors != (1.0, 1.0) or (hub_stop and law == 'inverse_dynamics')
    times = np.linspace(0.0, _SHOWN, round(40.0 * _SHOWN) + 1)
    if not brief:
        end = CLOSED_LOOP[law]
        late = np.linspace(_SHOWN, end, round(10.0 * (end - _SHOWN)) + 1)
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
    Run a closed loop with the paper's gains on d and nothing on q1 and q2, formulation complete.

    That is all a robot that holds the needle at its base can do. Inverse dynamics of the needle
    itself gives d the motion of its error equation exactly, so that the base is moved by it. Under
    PID with the goal at rest, k_v e_dot is a viscous friction, so that the needle gets it as one.

    Parameters
    ----------
    law : str
        One of `LAWS`.
    reading : str
        Preset.

    Returns
    -------
    LoopRun
        Samples every 5 ms, up to 10 s (inverse dynamics; the hub stops it) or 120 s (PID).

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
            # Held over 5 ms: 5e-4 of the time constant k_v / k_p.
            force = PID_KP * float(states[-1][0])
            integrator.advance(period, force)
            forces[k, 0] = force - PID_KV * integrator.speed
        else:
            speed = 0.0 if states[-1][0] <= 0.0 else _error_speed((k + 1) * period)
            forces[k, 0] = integrator.advance_moved(period, speed).axial_force
        states.append(integrator.state)
    time = period * np.arange(count + 1, dtype=np.float64)
    return LoopRun(model, time, np.array(states), forces)


def _error_speed(time: float) -> float:
    """Return the insertion speed that e_ddot + k_v e_dot + k_p e = 0 asks of d, from rest."""
    damping, square = 0.5 * INVERSE_DYNAMICS_KV[0], INVERSE_DYNAMICS_KP[0]
    frequency = sqrt(square - damping**2)
    start = NeedleParameters().length - DEPTH
    swing = np.exp(-damping * time) * np.sin(frequency * time)
    return float(start * square / frequency * swing)


# Drawing.


def _label(case: tuple[str, ...]) -> str:
    reading = {'paper_si': '0.3 N s/m', 'paper_mm': '0.3 N s/mm'}[case[0]]
    return ', '.join((reading, *case[1:]))


def _envelope(axes: Axes, time: FloatArray, values: FloatArray, color: str) -> None:
    """Draw a line, or the band that it fills if it has more turns than there are pixels."""
    bins = 800
    width = len(time) // bins
    if width < 8:
        axes.plot(time, values, color=color, linewidth=0.8)
        return
    count = bins * width
    parts = values[:count].reshape(bins, width)
    middle = time[:count].reshape(bins, width).mean(axis=1)
    axes.fill_between(
        middle, parts.min(axis=1), parts.max(axis=1), color=color, linewidth=0.4, alpha=0.9
    )


def _open_outcomes() -> dict[tuple[str, ...], Outcome]:
    return {case: Outcome.of(open_loop(*case)) for case in CASES}


def hub_time(run: LoopRun) -> float:
    """Return when a run reached the hub [s]; not a number if it did not."""
    there = np.flatnonzero(run.states[:, 0] <= 0.0)
    return float(run.time[there[0]]) if len(there) else float('nan')


def figure_4() -> PaperFigure:
    """
    Draw the tip deflection in the open loop.

    Returns
    -------
    PaperFigure
        Figure 4.

    """
    figure = Figure(figsize=(10.0, 6.0), layout='constrained')
    grid = figure.subplots(2, 2, sharex='row')
    for axes, case in zip(grid.flat, CASES, strict=True):
        run = open_loop(*case)
        fast = case[0] == 'paper_si'
        _envelope(axes, run.time * (1e3 if fast else 1.0), 1e3 * run.tip_deflection, _COLORS[case])
        axes.axvline(
            hub_time(run) * (1e3 if fast else 1.0), color='0.4', linewidth=0.8, linestyle=':'
        )
        axes.set(title=_label(case), xlabel='time [ms]' if fast else 'time [s]')
        axes.grid(visible=True, alpha=0.3)
    for axes in grid[:, 0]:
        axes.set_ylabel('tip deflection [mm]')
    found = _open_outcomes()
    peaks = {case: 1e3 * abs(one.peak) for case, one in found.items()}
    times = {case: hub_time(open_loop(*case)) for case in CASES}
    si, printed = ('paper_si', 'complete'), ('paper_si', 'as_printed')
    slow, slow_printed = ('paper_mm', 'complete'), ('paper_mm', 'as_printed')
    caption = (
        f'Figure 4, tip deflection under {FORCE:g} N. With mu_v = 0.3 N s/m the needle is at its '
        f'hub after {1e3 * times[si]:.1f} ms (dotted), with 0.3 N s/mm after {times[slow]:.1f} s. '
        f'The tip does not keep its 0.5 mm: it rings, at kilohertz first, with up to '
        f'{peaks[si]:.3g} mm and {peaks[slow]:.3g} mm by the complete equations and '
        f'{peaks[printed]:.3g} mm and {peaks[slow_printed]:.3g} mm by those as printed. Nothing '
        'damps it. Bands are vibration too fast to be drawn.'
    )
    return PaperFigure(picture=Picture('figure_4', caption, figure), outcomes=found)


def figure_5() -> PaperFigure:
    """
    Draw the state variables in the open loop.

    Returns
    -------
    PaperFigure
        Figure 5.

    """
    figure = Figure(figsize=(12.0, 7.0), layout='constrained')
    grid = figure.subplots(3, 4, sharex='col')
    for column, case in zip(grid.T, CASES, strict=True):
        run = open_loop(*case)
        fast = case[0] == 'paper_si'
        time = run.time * (1e3 if fast else 1.0)
        for axes, k, scale in zip(column, (0, 2, 3), (1e3, 1e3, 1e3), strict=True):
            _envelope(axes, time, scale * run.states[:, k], _COLORS[case])
            axes.grid(visible=True, alpha=0.3)
        column[0].set_title(_label(case), fontsize='medium')
        column[-1].set_xlabel('time [ms]' if fast else 'time [s]')
    for axes, name in zip(
        grid[:, 0],
        ('d [mm]', r'$q_1$ [$10^{-3}$ m$^{3/2}$]', r'$q_2$ [$10^{-3}$ m$^{3/2}$]'),
        strict=True,
    ):
        axes.set_ylabel(name)
    apart = {
        reading: 1e3
        * float(
            np.abs(
                open_loop(reading, 'complete').states[:, 0]
                - open_loop(reading, 'as_printed').states[:, 0]
            ).max()
        )
        for reading in READINGS
    }
    caption = (
        'Figure 5, state variables under 3 N. d falls to the hub and stays there. By the complete '
        'equations q1 and q2 shrink as the needle goes in, since the same deflection of a longer '
        'needle takes less of them; by those as printed they do not. The two differ in d by at '
        'most '
        f'{apart["paper_si"]:.2g} mm (0.3 N s/m) and {apart["paper_mm"]:.2g} mm (0.3 N s/mm): the '
        'printed ones have no force of the deflection on d.'
    )
    return PaperFigure(picture=Picture('figure_5', caption, figure), outcomes=_open_outcomes())


def _closed_outcomes(law: str) -> dict[tuple[str, ...], Outcome]:
    return {
        (*case, 'hub' if hub_stop else 'no hub'): Outcome.of(
            closed_loop(law, *case, hub_stop=hub_stop)
        )
        # PID comes to rest before the hub.
        for hub_stop in ((True,) if law == 'pid' else (False, True))
        for case in CASES
    }


def spread(law: str, *, hub_stop: bool = False) -> float:
    """Return how far apart the tips of the four cases are at most [m]."""
    tips = [closed_loop(law, *case, hub_stop=hub_stop).tip_deflection for case in CASES]
    return float(np.ptp(tips, axis=0).max())


def _draw_closed(axes: Axes, law: str, *, hub_stop: bool, k: int | None, scale: float) -> None:
    for case in CASES:
        run = closed_loop(law, *case, hub_stop=hub_stop)
        shown = run.time <= _SHOWN
        values = run.tip_deflection if k is None else run.states[:, k]
        axes.plot(
            run.time[shown],
            scale * values[shown],
            color=_COLORS[case],
            linestyle=_DASHES[case],
            linewidth=2.2 if _DASHES[case] == '-' else 1.4,
            label=_label(case),
        )
    axes.grid(visible=True, alpha=0.3)


def figure_6() -> PaperFigure:
    """
    Draw the state variables under inverse dynamics.

    Returns
    -------
    PaperFigure
        Figure 6.

    """
    figure = Figure(figsize=(11.0, 7.0), layout='constrained')
    grid = figure.subplots(3, 2, sharex=True)
    names = ('d [mm]', r'$q_1$ [$10^{-3}$ m$^{3/2}$]', r'$q_2$ [$10^{-3}$ m$^{3/2}$]')
    for column, hub_stop in zip(grid.T, (False, True), strict=True):
        for axes, k in zip(column, (0, 2, 3), strict=True):
            _draw_closed(axes, 'inverse_dynamics', hub_stop=hub_stop, k=k, scale=1e3)
        column[0].set_title('the hub stops the needle' if hub_stop else 'without a hub')
        column[-1].set_xlabel('time [s]')
    for axes, name in zip(grid[:, 0], names, strict=True):
        axes.set_ylabel(name)
    grid[0, 1].legend(fontsize='small')
    found = _closed_outcomes('inverse_dynamics')
    free = found['paper_si', 'complete', 'no hub']
    caption = (
        'Figure 6, state variables under inverse dynamics with the gains of the paper. All four '
        'cases lie on one another: a law that knows its needle exactly cancels friction, '
        'stiffness '
        'and formulation alike and leaves e_ddot + k_v e_dot + k_p e = 0, with a damping ratio of '
        '0.05 in d and 0.16 in q1 and q2. d overshoots to '
        f'{1e3 * (NeedleParameters().length - free.deepest):.0f} mm, {1e3 * free.deepest:.0f} mm '
        'of a 200 mm needle inserted, which only an equation without a hub can do; on the hub, '
        'the needle stops where it should.'
    )
    return PaperFigure(picture=Picture('figure_6', caption, figure), outcomes=found)


def figure_7() -> PaperFigure:
    """
    Draw the tip deflection under inverse dynamics.

    Returns
    -------
    PaperFigure
        Figure 7.

    """
    figure = Figure(figsize=(11.0, 4.2), layout='constrained')
    for axes, hub_stop in zip(figure.subplots(1, 2), (False, True), strict=True):
        _draw_closed(axes, 'inverse_dynamics', hub_stop=hub_stop, k=None, scale=1e3)
        axes.set(
            title='the hub stops the needle' if hub_stop else 'without a hub',
            xlabel='time [s]',
            xlim=(0.0, 20.0),
        )
    figure.axes[0].set_ylabel('tip deflection [mm]')
    figure.axes[1].legend(fontsize='small')
    found = _closed_outcomes('inverse_dynamics')
    free, held = (found['paper_si', 'complete', word] for word in ('no hub', 'hub'))
    caption = (
        'Figure 7, tip deflection under inverse dynamics. It goes to zero, after a detour: q1 and '
        'q2 are slow (3.2 rad/s) and the needle is pushed in while they last, so that the tip '
        f'swings to {1e3 * free.peak:.0f} mm at {free.peak_time:.1f} s without a hub and to '
        f'{1e3 * held.peak:.0f} mm at {held.peak_time:.1f} s with it, from 0.5 mm at the start. '
        'So large a deflection is outside a linear beam model.'
    )
    return PaperFigure(picture=Picture('figure_7', caption, figure), outcomes=found)


def figure_8() -> PaperFigure:
    """
    Draw the tip deflection under PID, and the position error that it leaves.

    Returns
    -------
    PaperFigure
        Figure 8.

    """
    figure = Figure(figsize=(11.0, 4.2), layout='constrained')
    left, right = figure.subplots(1, 2)
    _draw_closed(left, 'pid', hub_stop=True, k=None, scale=1e3)
    left.set(xlabel='time [s]', ylabel='tip deflection [mm]')
    left.legend(fontsize='small')
    for law, name in LAWS.items():
        run = closed_loop(law, 'paper_mm', 'complete', hub_stop=law == 'pid')
        right.semilogy(run.time, 1e3 * np.abs(run.states[:, 0]), color=LAW_COLORS[law], label=name)
    bound = NeedleParameters().coulomb_friction / PID_KP
    right.axhline(1e3 * bound, color='0.4', linestyle=':', label=r'$\mu_s / k_p$')
    right.set(xlabel='time [s]', ylabel='position error |d| [mm]', ylim=(1e-2, 3e2))
    right.grid(visible=True, alpha=0.3)
    right.legend(fontsize='small')
    found = _closed_outcomes('pid')
    fast, one = (found[reading, 'complete', 'hub'] for reading in READINGS)
    caption = (
        'Figure 8, PID with the gains of the paper. Left: the tip deflection grows to '
        f'{1e3 * abs(fast.peak):.1f} mm (0.3 N s/m) or {1e3 * abs(one.peak):.1f} mm '
        f'(0.3 N s/mm) at {one.peak_time:.0f} s and then goes to zero, as under '
        'inverse dynamics: the gains on q1 and q2 act on errors that friction does not hold. '
        f'Right (0.3 N s/mm, complete): d stops at {1e3 * one.error:.2f} mm = mu_s / k_p, where '
        'friction holds the proportional force and nothing integrates; the error of inverse '
        'dynamics, without a hub, falls as exp(-0.05 t).'
    )
    return PaperFigure(picture=Picture('figure_8', caption, figure), outcomes=found)


FIGURES: Final = {
    'figure-4': figure_4,
    'figure-5': figure_5,
    'figure-6': figure_6,
    'figure-7': figure_7,
    'figure-8': figure_8,
}


def comparison() -> Grid:
    """
    Compare the two laws: what each leaves of the deflection and of the position error.

    Returns
    -------
    Grid
        Modal and physical actuation, complete equations, with the hub.

    """
    rows = []
    for reading in READINGS:
        for law in LAWS:
            runs = {
                'forces on d, q1, q2': closed_loop(law, reading, 'complete', hub_stop=True),
                'f_y alone': base_alone(law, reading),
            }
            rows += [
                (f'{LAWS[law]}, {_label((reading,))}, {how}', *Outcome.of(run).row())
                for how, run in runs.items()
            ]
    return Grid(
        caption='What each controller leaves, by what it can push on (hub on, complete equations)',
        heads=('controller', *_HEADS),
        rows=tuple(rows),
    )


def section() -> Section:
    """
    Return figures 4 to 8 and the comparison of the controllers.

    Returns
    -------
    Section
        Plain data.

    """
    figures = [draw() for draw in FIGURES.values()]
    pid = Outcome.of(closed_loop('pid', 'paper_mm', 'complete', hub_stop=True))
    alone = {law: Outcome.of(base_alone(law, 'paper_mm')) for law in LAWS}
    return Section(
        title='Figures 4 to 8',
        paragraphs=(
            (
                'Start of all runs: 2 cm inserted, tip deflected by 0.5 mm in the shape that a '
                'force '
                'at the tip would hold (the paper gives the tip alone). Gains: inverse dynamics '
                'k_p = diag(1, 10, 10), k_v = 0.1 k_p; PID k_p = 1000, k_v = 10 k_p on each of d, '
                'q1 '
                'and q2, no integral. The wanted state is zero.'
            ),
            (
                'Final deflection: both controllers bring it to zero, each with generalized '
                'forces on '
                'q1 and q2 that no motor of a needle robot applies. With f_y alone neither does: '
                'the '
                'needle is at its depth and its tip rings on, with up to '
                f'{1e3 * alone["inverse_dynamics"].final:.2g} mm under inverse dynamics and '
                f'{1e3 * alone["pid"].final:.2g} mm under PID (0.3 N s/mm), as the model has no '
                'damping.'
            ),
            (
                'Final position error: inverse dynamics none, since it compensates Coulomb '
                'friction '
                f'exactly; PID {1e3 * pid.error:.2f} mm = mu_s / k_p, since it has no integral. '
                'Either '
                'an integral or knowledge of mu_s takes this error away; knowledge of the rest of '
                'the '
                'model has no part in it.'
            ),
        ),
        tables=(
            comparison(),
            figures[0].table('Figures 4 and 5'),
            figures[2].table('Figures 6 and 7'),
            figures[4].table(),
        ),
        pictures=tuple(one.picture for one in figures),
    )
