# SPDX-License-Identifier: Apache-2.0
"""
Vibration of a needle with fixed base: the integrator of this package, MuJoCo and PyElastica.

For each tool, a search finds the discretization and the time step of least cost with a first
frequency within 1 % of the exact frequency of its own equations. The rods of the other tools have
no tissue. Half of their first element is inside the clamp: a chain of rigid or constant-strain
elements that is clamped at the end of an element converges one order slower. All are undamped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from math import cos, cosh, pi, sqrt
from pathlib import Path
from typing import Any, Final

from benchmarks.measure import (
    Bar,
    geometric,
    least_times,
    NOT_INSTALLED,
    number,
    optional,
    seconds,
)
from benchmarks.page import Answer, PageSection, Tick
from needle_dynamics import FloatArray, Integrator, mode_shapes, NeedleModel, NeedleParameters
from needle_dynamics.simulated.integrator import DEFAULT_STEP
import numpy as np
from scipy.optimize import brentq, minimize_scalar

#: Insertion depth of the vibrating needle [m].
LENGTH: Final = 0.15

#: Largest relative error of the first frequency.
FREQUENCY_ERROR: Final = 0.01

#: Steps per period that resolve the frequency; our integrator has no stability limit.
STEPS_PER_PERIOD: Final = 20

#: Initial tip deflection over the length: small, for the linear exact frequency.
_AMPLITUDE: Final = 1e-3

#: Ratio of neighboring steps in a search.
_STEP_RATIO: Final = 1.0 / 1.05


def beam_frequency(
    length: float, bending_stiffness: float, linear_density: float, foundation: float = 0.0
) -> float:
    """
    Return the first frequency [Hz] of a cantilever (Euler-Bernoulli) on an elastic foundation.

    Units: length [m], bending stiffness E I [N m^2], linear density rho A [kg/m], foundation
    [N/m^2].
    """
    root = brentq(lambda x: cos(x) * cosh(x) + 1.0, 1.5, 2.5, xtol=1e-14)
    bending = bending_stiffness / linear_density * (root / length) ** 4
    return float(sqrt(bending + foundation / linear_density) / (2.0 * pi))


def measured_frequency(time: FloatArray, values: FloatArray, near: float) -> float:
    """
    Return the frequency [Hz] of the best-fit sinusoid to samples (n,).

    The search range is 0.7 to 1.3 times the guess `near` [Hz].
    """

    def misfit(frequency: float) -> float:
        phase = 2.0 * pi * frequency * time
        basis = np.stack([np.cos(phase), np.sin(phase), np.ones_like(phase)], axis=1)
        rest = values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0]
        return float(rest @ rest)

    grid = np.linspace(0.7 * near, 1.3 * near, 61)
    best = int(np.argmin([misfit(frequency) for frequency in grid]))
    low, high = grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)]
    found = minimize_scalar(
        misfit, bounds=(low, high), method='bounded', options={'xatol': 1e-7 * near}
    )
    return float(found.x)


@dataclass(frozen=True, slots=True)
class Setting:
    """
    A tool with its discretization and time step.

    Attributes
    ----------
    tool, discretization : str
        Names.
    step : float
        Time step [s].
    frequency, exact : float
        First frequency of the simulation, and exact frequency of the same equations [Hz].
    job : callable
        Simulates for ``simulated`` seconds.
    simulated : float
        Simulated time of one job [s].

    """

    tool: str
    discretization: str
    step: float
    frequency: float
    exact: float
    job: Callable[[], object]
    simulated: float

    @property
    def error(self) -> float:
        return self.frequency / self.exact - 1.0

    def row(self, spent: float, ours: float) -> tuple[str, ...]:
        """Return a table row; `spent` is the job time [s], `ours` per simulated second."""
        per_second = spent / self.simulated
        return (
            self.tool,
            self.discretization,
            f'{self.step:.3g}',
            f'{self.exact:.2f}',
            f'{self.error:+.2%}',
            number(per_second * 1e3),
            f'{number(per_second / ours)} x',
        )


def needle_exact() -> float:
    """Return the first frequency [Hz] of the needle in its tissue, clamped at the entry."""
    p = NeedleParameters.preset('paper_si')
    return beam_frequency(LENGTH, p.bending_stiffness, p.linear_density, p.tissue_stiffness)


def needle(step: float) -> Setting:
    """Return our integrator with fixed base, sampled at most 20 times per period."""
    p = NeedleParameters.preset('paper_si')
    model = NeedleModel(p)
    start = model.state_at(LENGTH, _AMPLITUDE * LENGTH)
    exact = needle_exact()
    interval = max(step, 1.0 / (STEPS_PER_PERIOD * exact))
    integrator = Integrator(p, start, step)
    time, tips = np.linspace(0.0, 199 * interval, 200), np.empty(200)
    for i in range(time.size):
        tips[i] = model.tip_deflection(integrator.state)
        integrator.advance_moved(interval, 0.0)
    simulated = 10.0
    return Setting(
        'needle_dynamics',
        f'{integrator.state.size // 2 - 2} modes, tissue',
        step,
        measured_frequency(time, tips, exact),
        exact,
        lambda: Integrator(p, start, step).advance_moved(simulated, 0.0),
        simulated,
    )


def _section() -> tuple[float, float, float, float]:
    """Return radius, density and Young's modulus of the rod, and its exact first frequency."""
    p = NeedleParameters.preset('paper_si')
    radius = sqrt(p.area / pi)
    modulus = p.bending_stiffness / (0.25 * pi * radius**4)
    exact = beam_frequency(LENGTH, p.bending_stiffness, p.linear_density)
    return radius, p.density, modulus, exact


_PLUGIN = """
<mujoco>
  <option timestep="{step}" gravity="0 0 0" integrator="{integrator}">
    <flag contact="disable" constraint="disable"/>
  </option>
  <extension><plugin plugin="mujoco.elasticity.cable"/></extension>
  <worldbody>
    <composite type="cable" prefix="needle" curve="s" initial="none"
        count="{points} 1 1" size="{size}" offset="{offset} 0 0">
      <plugin plugin="mujoco.elasticity.cable">
        <config key="bend" value="{modulus}"/><config key="twist" value="0"/>
      </plugin>
      <joint kind="main" damping="0"/>
      <geom type="cylinder" size="{radius}" density="{density}"/>
    </composite>
  </worldbody>
</mujoco>
"""

_FLEX = """
<mujoco>
  <option timestep="{step}" gravity="0 0 0" integrator="{integrator}">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <flexcomp name="needle" type="direct" dim="1" radius="{radius}" mass="{mass}"
        point="{points}" element="{elements}">
      <edge equality="true"/>
      <contact selfcollide="none" contype="0" conaffinity="0"/>
      <elasticity young="{modulus}" poisson="0.3"/>
      <pin id="0 1"/>
    </flexcomp>
  </worldbody>
</mujoco>
"""


class _Cable:
    """Cantilever in MuJoCo: an elastic cable (before 4.0), or a one-dimensional flex."""

    def __init__(self, mujoco: Any, *, plugin: bool, elements: int, how: str, step: float) -> None:
        self._mujoco = mujoco
        radius, density, modulus, _ = _section()
        common = {'step': step, 'integrator': how, 'radius': radius, 'modulus': modulus}
        if plugin:
            size = LENGTH / (elements - 0.5)
            text = _PLUGIN.format(
                **common,
                points=elements + 1,
                size=elements * size,
                offset=-0.5 * size,
                density=density,
            )
            self.model = mujoco.MjModel.from_xml_string(text)
        else:
            # Point masses: the last point has half of the mass.
            size = LENGTH / (elements - 0.5)
            text = _FLEX.format(
                **common,
                points=' '.join(f'{(i - 0.5) * size} 0 0' for i in range(elements + 1)),
                elements=' '.join(f'{i} {i + 1}' for i in range(elements)),
                mass=density * pi * radius**2 * size * (elements + 1),
            )
            self.model = mujoco.MjModel.from_xml_string(text)
            self._moving = [self.model.body(f'needle_{i}').id for i in range(2, elements + 1)]
            self.model.body_mass[self._moving[-1]] *= 0.5
        self.data = mujoco.MjData(self.model)
        if plugin:
            self._tip = self.model.nbody - 1
        else:
            mujoco.mj_setConst(self.model, self.data)
            self._tip = self._moving[-1]
        mujoco.mj_resetData(self.model, self.data)
        self._deflect(plugin=plugin)
        mujoco.mj_forward(self.model, self.data)

    def _deflect(self, *, plugin: bool) -> None:
        """Start with the shape of a static force at the tip."""
        m, d = self.model, self.data
        if plugin:
            for j in range(m.njnt):
                half = 0.5 * 3.0 * _AMPLITUDE * (1.0 - j / m.njnt) / m.njnt
                address = m.jnt_qposadr[j]
                d.qpos[address : address + 4] = [cos(half), 0.0, -sqrt(1.0 - cos(half) ** 2), 0.0]
        else:
            for body in self._moving:
                x = m.body_pos[body][0] / LENGTH
                third = m.jnt_qposadr[m.body_jntadr[body]] + 2
                d.qpos[third] = _AMPLITUDE * LENGTH * 0.5 * x * x * (3.0 - x)

    def advance(self, steps: int) -> None:
        self._mujoco.mj_step(self.model, self.data, steps)

    def sample(self, duration: float) -> tuple[FloatArray, FloatArray] | None:
        """Return time and tip deflection, or None if the run is unstable."""
        step = self.model.opt.timestep
        stride = max(1, round(5e-4 / step))
        count = int(duration / (stride * step))
        time, tips = np.empty(count), np.empty(count)
        for i in range(count):
            self.advance(stride)
            time[i], tips[i] = self.data.time, self.data.xpos[self._tip, 2]
            if self.data.warning.number.any() or abs(tips[i]) > 10.0 * _AMPLITUDE * LENGTH:
                return None
        return time, tips


def _cable_settings(mujoco: Any, *, plugin: bool) -> Iterator[tuple[float, Setting]]:
    """Yield the cost and the largest valid step of each discretization and integrator."""
    exact = _section()[-1]
    names = (
        ('Euler', 'implicitfast', 'implicit', 'RK4') if plugin else ('Euler', 'RK4', 'discrete')
    )
    for elements in range(3, 11):
        for how in names:
            make = partial(_Cable, mujoco, plugin=plugin, elements=elements, how=how)
            for step in geometric(1e-3, 2e-5, _STEP_RATIO):
                samples = make(step=step).sample(10.0 / exact)
                if samples is None:
                    continue
                found = measured_frequency(*samples, exact)
                if abs(found / exact - 1.0) > FREQUENCY_ERROR:
                    if how != 'discrete':
                        # Stable but inaccurate: the elements are too coarse for any step.
                        break
                    continue
                rod, steps = make(step=step), round(1.0 / step)
                setting = Setting(
                    f'MuJoCo {mujoco.__version__} {"cable" if plugin else "flex"}',
                    f'{elements} elements, {how}',
                    step,
                    found,
                    exact,
                    partial(rod.advance, steps),
                    steps * step,
                )
                cost = min(seconds(setting.job) for _ in range(3)) / setting.simulated
                if not rod.data.warning.number.any():
                    yield cost, setting
                    break


def mujoco_cable(tick: Tick) -> Setting | None:
    """Find the setting of least cost of MuJoCo; None if not installed."""
    mujoco = optional('mujoco')
    if mujoco is None:
        return None
    tick('step of MuJoCo')
    # Up to 3.x, the cable is a plugin of the wheel; later, one-dimensional flexes.
    libraries = sorted((Path(str(mujoco.__file__)).parent / 'plugin').glob('*elasticity*'))
    for library in libraries:
        mujoco.mj_loadPluginLibrary(str(library))
    # The search includes unstable steps, which are not reported.
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _text: None)
    try:
        settings = list(_cable_settings(mujoco, plugin=bool(libraries)))
    finally:
        mujoco.set_mju_user_warning(before)
    return min(settings, key=lambda item: item[0])[1]


class _Rod:
    """Cantilever in PyElastica."""

    def __init__(self, elastica: Any, stepper: str, elements: int, step: float) -> None:
        radius, density, modulus, _ = _section()
        size = LENGTH / (elements - 0.5)
        self.step = np.float64(step)
        # Typed as Any: PyElastica has no stubs, and its simulator is made of mix-ins.
        bases = (elastica.BaseSystemCollection, elastica.Constraints)
        self._simulator: Any = type('Cantilever', bases, {})()
        self.rod = elastica.CosseratRod.straight_rod(
            elements,
            np.array([-0.5 * size, 0.0, 0.0]),
            np.array([1.0, 0.0, 0.0]),
            np.array([0.0, 0.0, 1.0]),
            elements * size,
            radius,
            density,
            youngs_modulus=modulus,
            shear_modulus=modulus / 2.6,
        )
        self._simulator.append(self.rod)
        self._simulator.constrain(self.rod).using(
            elastica.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
        )
        x = np.maximum(self.rod.position_collection[0], 0.0) / LENGTH
        # Straight, with the velocity field of a static shape: other modes are negligible.
        speed = 2.0 * pi * _section()[-1] * _AMPLITUDE * LENGTH
        self.rod.velocity_collection[2] = speed * x * x * (6.0 - 4.0 * x + x * x) / 3.0
        self._simulator.finalize()
        self._stepper: Any = getattr(elastica, stepper)()
        self._time = np.float64(0.0)

    def advance(self, steps: int) -> None:
        for _ in range(steps):
            self._time = self._stepper.step(self._simulator, self._time, self.step)

    def holds(self, steps: int) -> bool:
        """Return whether the step is stable, with all modes excited."""
        random = np.random.default_rng(1)
        for rates in (self.rod.velocity_collection, self.rod.omega_collection):
            rates[:, 1:] += 1e-2 * random.standard_normal(rates[:, 1:].shape)
        with np.errstate(all='ignore'):
            self.advance(steps)
        tip = self.rod.position_collection[2, -1]
        return bool(np.isfinite(tip) and abs(tip) < 10.0 * _AMPLITUDE * LENGTH)

    def sample(self, duration: float) -> tuple[FloatArray, FloatArray]:
        """Return time and tip deflection."""
        stride = max(1, round(1e-4 / float(self.step)))
        count = int(duration / (stride * float(self.step)))
        time, tips = np.empty(count), np.empty(count)
        for i in range(count):
            self.advance(stride)
            time[i], tips[i] = self._time, self.rod.position_collection[2, -1]
        return time, tips


def pyelastica_rod(tick: Tick) -> Setting | None:
    """Find the setting of least cost of PyElastica; None if not installed."""
    elastica = optional('elastica')
    if elastica is None:
        return None
    exact = _section()[-1]
    longest = {'PositionVerlet': 5e-6, 'PEFRL': 5e-6}
    # The cost hardly depends on the elements: use the coarsest valid discretization.
    for elements in range(3, 21):
        choices = []
        for stepper, first in longest.items():
            tick(f'step of PyElastica, {elements} elements')
            step = next(
                h
                for h in geometric(first, 1e-9, _STEP_RATIO)
                if _Rod(elastica, stepper, elements, h).holds(3000)
            )
            # The stability limit is the shear of the section, for any elements: continue near it.
            longest[stepper] = 1.1 * step
            rod = _Rod(elastica, stepper, elements, step)
            rod.advance(100)
            job = partial(rod.advance, 2000)
            simulated = 2000 * step
            choices.append((min(seconds(job) for _ in range(5)) / simulated, stepper, step, job))
        _, stepper, step, job = min(choices, key=lambda item: item[0])
        tick(f'frequency of PyElastica, {elements} elements')
        samples = _Rod(elastica, stepper, elements, step).sample(2.0 / exact)
        found = measured_frequency(*samples, exact)
        if abs(found / exact - 1.0) <= FREQUENCY_ERROR:
            return Setting(
                f'PyElastica {metadata.version("pyelastica")}',
                f'{elements} elements, {stepper}',
                step,
                found,
                exact,
                job,
                2000 * step,
            )
    return None


def mode_error(modes: NeedleModel) -> float:
    """Return the relative error of the first frequency of a model at `LENGTH` (positive, Ritz)."""
    p = modes.parameters
    mass = p.linear_density * mode_shapes(p.length).integrals(LENGTH).gram
    square = np.linalg.eigvals(np.linalg.solve(mass, modes.stiffness_matrix(LENGTH))).real.min()
    return float(sqrt(square) / (2.0 * pi) / needle_exact() - 1.0)


def compare(tick: Tick) -> Answer:
    """Compare the cost of a simulated second of free vibration."""
    exact = needle_exact()
    ours = needle(1.0 / (STEPS_PER_PERIOD * exact))
    default = needle(DEFAULT_STEP)
    others = {'MuJoCo': mujoco_cable(tick), 'PyElastica': pyelastica_rod(tick)}
    tick('free vibration, side by side')
    settings = [ours, default, *(item for item in others.values() if item is not None)]
    spent = list(least_times({str(i): item.job for i, item in enumerate(settings)}, 10).values())
    own = spent[0] / ours.simulated
    rows = [item.row(time, own) for item, time in zip(settings, spent, strict=True)]
    rows += [(name, NOT_INSTALLED, *[''] * 5) for name, item in others.items() if item is None]
    per_second = {
        name: None if item is None else spent[settings.index(item)] / item.simulated
        for name, item in others.items()
    }

    def ratio(name: str) -> float | None:
        value = per_second[name]
        return None if value is None else value / own

    modal = mode_error(NeedleModel(NeedleParameters.preset('paper_si')))
    section = PageSection(
        'Free vibration',
        (
            'tool',
            'discretization',
            'step [s]',
            'exact [Hz]',
            'found',
            'wall per simulated s [ms]',
            'relative to ours',
        ),
        rows,
        f'{LENGTH * 100:g} cm, base held, first frequency within {FREQUENCY_ERROR:.0%} of the '
        f'exact one of the same equations. Ours has {STEPS_PER_PERIOD} steps in a period, or the '
        f'default step. The matrices of our two modes alone have an error of {modal:+.3%}.',
    )
    error = max(abs(ours.error), abs(default.error))
    bars = [
        Bar('free vibration, MuJoCo', ratio('MuJoCo'), 50.0, 'x ours', at_least=True),
        Bar('free vibration, PyElastica', ratio('PyElastica'), 1000.0, 'x ours', at_least=True),
        Bar('error of our first frequency at 15 cm', 100.0 * error, 100.0 * FREQUENCY_ERROR, '%'),
    ]
    return [section], bars
