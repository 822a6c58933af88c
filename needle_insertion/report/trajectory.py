# SPDX-License-Identifier: Apache-2.0
"""Report a simulated trajectory as summary, CSV, figure and bag."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final, TYPE_CHECKING

from needle_dynamics import FloatArray, linearize, NeedleModel, Trajectory
from needle_insertion.report.content import csv_table, png
from needle_ros.contract import ground_truth, JOINT_STATES, TIP_DEFLECTION, Topic
from needle_ros.files import write_whole
from needle_ros.timing import NANOSECONDS
from needle_ros.wire import Template
import numpy as np

if TYPE_CHECKING:
    # Takes half a second to import; only the picture needs it.
    from matplotlib.figure import Figure

_LINEAR: Final = 0.1  #: largest deflection of a linear beam, as a fraction of the insertion depth

#: Modes that decay by exp(-_FADED) within this fraction of a run are negligible.
_FADED: Final = 7.0
_SOON: Final = 0.02


def summary(trajectory: Trajectory) -> dict[str, float]:
    model = NeedleModel(trajectory.parameters)
    states, tips = trajectory.states, trajectory.tip_deflection
    at_hub = trajectory.time[trajectory.depth >= trajectory.parameters.length]
    compared = np.isfinite(trajectory.error)
    return {
        'duration [s]': float(trajectory.time[-1]),
        **({'hub at the skin at the latest after [s]': float(at_hub[0])} if at_hub.size else {}),
        'insertion depth at the end [m]': float(trajectory.depth[-1]),
        'insertion velocity at the end [m/s]': float(-states[-1, model.coordinates]),
        'largest tip deflection [m]': float(np.abs(tips).max()),
        'tip deflection at the end [m]': float(tips[-1]),
        'energy at the start [J]': model.energy(states[0]),
        'energy at the end [J]': model.energy(states[-1], float(trajectory.time[-1])),
        **({'stated error [1]': trajectory.error} if compared else {}),
    }


def warnings(trajectory: Trajectory) -> Iterator[str]:
    """Yield warnings about the validity and resolution of a trajectory."""
    model = NeedleModel(trajectory.parameters)
    tips, depths = np.abs(trajectory.tip_deflection), trajectory.depth
    worst = int(np.argmax(tips - _LINEAR * depths))
    if tips[worst] > _LINEAR * depths[worst]:
        yield (
            f'the tip deflects {1e3 * tips[worst]:.3g} mm at {1e3 * depths[worst]:.3g} mm '
            'inserted: a linear beam is valid up to about a tenth of the insertion depth'
        )
    p, duration = trajectory.parameters, float(trajectory.time[-1])
    fade = p.tissue_damping / (2.0 * p.linear_density)
    if fade * _SOON * duration > _FADED:
        return
    # The frequencies depend on the insertion depth.
    ends = [
        linearize(model, trajectory.states[k], time=float(trajectory.time[k]), sliding='insertion')
        for k in (0, -1)
    ]
    fastest = float(max(system.frequencies[-1] for system in ends)) / (2.0 * np.pi)
    interval = float(trajectory.time[1] - trajectory.time[0])
    if fastest > 0.5 / interval:
        yield (
            f'the fastest mode, {1e-3 * fastest:.3g} kHz, is beyond half the sampling rate, '
            f'{0.5e-3 / interval:.3g} kHz: samples alias it; '
            f'an interval below {0.5 / fastest:.2g} s resolves it'
        )


def write(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory to a ``.csv`` or ``.png`` file, or as a bag to a new folder."""
    if path.suffix == '.csv':
        columns = _columns(trajectory)
        write_whole(path, csv_table([*columns], np.column_stack([*columns.values()])))
    elif path.suffix == '.png':
        write_whole(path, png(_figure(trajectory)))
    else:
        write_bag(path, _messages(trajectory))


def _columns(trajectory: Trajectory) -> dict[str, FloatArray]:
    """Return the columns of a trajectory, and the rest of its states."""
    d, theta, *modal = NeedleModel(trajectory.parameters).coordinate_names
    units = {d: 'm', theta: 'rad', **dict.fromkeys(modal, 'm^3/2')}
    heads = [f'{name} [{unit}]' for name, unit in units.items()]
    heads += [f'{name}_dot [{unit}/s]' for name, unit in units.items()]
    return trajectory.columns() | dict(zip(heads, trajectory.states.T, strict=True))


def write_bag(path: Path, messages: Iterable[tuple[Topic, int, Sequence[float]]]) -> None:
    """Write messages to a new bag: topic, stamp [ns], and numbers of `Topic.quantities`."""
    # Takes a tenth of a second to import.
    from needle_identification import BagWriter

    templates: dict[str, Template] = {}
    with BagWriter(path) as bag:
        for topic, stamp, values in messages:
            name = f'/{topic.name}'
            if name not in templates:
                templates[name] = topic.template()
                bag.add_topic(name, topic.type_name)
            bag.write(name, templates[name].serialize(stamp, *values), stamp)


def _figure(trajectory: Trajectory) -> Figure:
    from matplotlib.figure import Figure

    result = Figure(figsize=(9.0, 9.0), layout='constrained')
    at_hub = trajectory.time[trajectory.depth >= trajectory.parameters.length]
    for axes in trajectory.plot(result):
        if at_hub.size:
            axes.axvline(at_hub[0], color='0.5', linestyle='--', label='hub at the skin')
    return result


def _messages(trajectory: Trajectory) -> Iterator[tuple[Topic, int, list[float]]]:
    states, depths, tips = trajectory.states, trajectory.depth, trajectory.tip_deflection
    m = states.shape[1] // 2
    forces = np.append(trajectory.forces, trajectory.forces[-1])
    rows = {
        JOINT_STATES: np.column_stack(
            [depths, states[:, 1], -states[:, m], states[:, m + 1], forces, 0.0 * forces]
        ),
        ground_truth(m - 2, commanded=False): states,
        TIP_DEFLECTION: np.column_stack([0.0 * depths, depths, tips]),
    }
    for k, time in enumerate(trajectory.time):
        for topic, values in rows.items():
            yield topic, round(time * NANOSECONDS), values[k].tolist()
