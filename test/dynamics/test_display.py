# SPDX-License-Identifier: Apache-2.0
"""Results display themselves: one line, a short table, a figure with units, a DataFrame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
import re
import sys
from typing import Any

from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from needle_controller import LoopRun
from needle_dynamics import (
    find_needle,
    Insertion,
    NeedleModel,
    NeedleParameters,
    ParameterError,
    simulate,
    simulate_batch,
    SteeredNeedle,
)
from needle_identification import (
    identify_friction,
    identify_stiffness,
    read_bag,
    read_friction_recording,
    read_indentation_recording,
    SteeringRecording,
    summarize,
    summarize_stiffness,
)
import numpy as np
import pytest

BAGS = Path(__file__).parents[2] / 'bags'
PHANTOM = NeedleParameters.preset('phantom')
START = NeedleModel(PHANTOM).state_at(0.05, 5e-4)


@cache
def steered() -> SteeredNeedle:
    needle, steering, _ = find_needle('bending_35mm')
    one = SteeredNeedle(needle, steering)
    one.move(depth=0.03)
    one.move(guide=(1e-3, 0.0))
    one.move(depth=0.06)
    return one


@cache
def friction() -> Any:
    return identify_friction(read_friction_recording(BAGS / 'friction_01'))


@cache
def stiffness() -> Any:
    return identify_stiffness(read_indentation_recording(BAGS / 'stiffness_01'))


def loop_run() -> LoopRun:
    time = 1e-3 * np.arange(50.0)
    forces = np.column_stack([np.full(50, 3.0), np.full(50, 0.5), np.zeros((50, 2))])
    states = np.tile(START, (50, 1))
    return LoopRun(NeedleModel(PHANTOM), time, states, np.asarray(forces, dtype=np.float64))


def steering_recording() -> SteeringRecording:
    depth = np.linspace(0.0, 0.08, 40)
    lateral = np.column_stack([depth, 0.1 * depth])
    return SteeringRecording(depth=depth, guide=lateral, roll=depth, tip=lateral)


MADE: dict[str, Callable[[], Any]] = {
    'Trajectory': lambda: simulate(PHANTOM, START, 3.0, duration=0.1, interval=1e-3),
    'LoopRun': loop_run,
    'SteeredNeedle': steered,
    'Insertion': lambda: Insertion(*find_needle('bending_35mm')[:2], depth=0.03),
    'Recording': lambda: read_friction_recording(BAGS / 'friction_01'),
    'IndentationRecording': lambda: read_indentation_recording(BAGS / 'stiffness_01'),
    'SteeringRecording': steering_recording,
    'TopicTable': lambda: read_bag(BAGS / 'friction_01', 'joint_states'),
    'Fit': lambda: friction().fit,
    'FrictionEstimate': friction,
    'FrictionSummary': lambda: summarize([friction(), friction()]),
    'StiffnessEstimate': stiffness,
    'LevelEstimate': lambda: stiffness().levels[0],
    'StiffnessSummary': lambda: summarize_stiffness([stiffness(), stiffness()]),
}


@pytest.mark.parametrize('name', MADE)
def test_result_is_shown_in_a_line_a_table_and_a_figure(name: str) -> None:
    """For each class: no array in the line, at most 20 rows, a label for every axis."""
    one = MADE[name]()
    line = repr(one)
    assert name in line
    # Two lines of a terminal.
    assert len(line) < 240
    assert '\n' not in line
    assert 'array' not in line
    page = one._repr_html_()
    assert 2 <= page.count('<tr>') <= 21
    columns = one.columns()
    assert len({len(values) for values in columns.values()}) == 1
    figure = Figure()
    axes = one.plot(figure)
    assert axes == figure.axes
    assert axes
    assert all(panel.lines for panel in axes)
    assert all(panel.get_ylabel() or panel.get_xlabel() for panel in axes)


def test_components_of_a_vector_share_axes_and_lengths_are_in_mm() -> None:
    """Guide and tip in x and z; depth in mm."""
    recording = steering_recording()
    axes = recording.plot(Figure())
    assert [one.get_ylabel() for one in axes] == ['guide [mm]', 'roll [deg]', 'tip [mm]']
    assert axes[-1].get_xlabel() == 'depth [mm]'
    assert [line.get_label() for line in axes[0].lines] == ['guide x', 'guide z']
    np.testing.assert_allclose(np.array(axes[0].lines[0].get_xydata())[-1], [80.0, 80.0])


def test_columns_of_a_closed_loop_are_named() -> None:
    """The insertion force is the first column of the forces, the torque the second."""
    columns = loop_run().columns()
    assert (columns['force [N]'] == 3.0).all()
    assert (columns['torque [N m]'] == 0.5).all()
    np.testing.assert_allclose(columns['depth [m]'], 0.05)
    np.testing.assert_allclose(columns['tip_deflection [m]'], 5e-4)


def test_plot_uses_a_figure_of_pyplot_by_default() -> None:
    plt.switch_backend('Agg')
    axes = loop_run().plot()
    assert axes[0].figure is plt.gcf()
    plt.close('all')


@pytest.mark.parametrize('name', ['LoopRun', 'FrictionEstimate', 'TopicTable'])
def test_dataframe_has_the_columns(name: str) -> None:
    pytest.importorskip('pandas')
    one = MADE[name]()
    frame = one.to_dataframe()
    assert list(frame.columns) == list(one.columns())
    for column, values in one.columns().items():
        np.testing.assert_array_equal(frame[column].to_numpy(), values)


def test_dataframe_without_pandas_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, 'pandas', None)
    with pytest.raises(ParameterError, match=re.escape("needle_insertion[pandas]'")):
        loop_run().to_dataframe()


def test_table_of_estimates_has_every_parameter_with_its_interval() -> None:
    estimate = friction()
    columns = estimate.columns()
    assert columns['parameter'].tolist() == [one.name for one in estimate.parameters]
    assert columns['unit'][0] == 'N'
    assert columns['low'][0] < columns['value'][0] < columns['high'][0]
    assert 'mu_s = 0.56' in repr(estimate)


def test_names_are_escaped_in_the_table() -> None:
    recording = replace(steering_recording(), name='<b>')
    assert '<b>' in repr(recording)
    assert '<b>' not in recording._repr_html_()


def test_progress_bar_counts_the_runs(capsys: pytest.CaptureFixture[str]) -> None:
    """On stderr; nothing without it."""
    options: dict[str, Any] = {'duration': 1e-3, 'interval': 1e-3}
    # The first call may compile, and reports that.
    simulate_batch(PHANTOM, START, [1.0], **options)
    capsys.readouterr()
    simulate_batch(PHANTOM, START, [1.0, 2.0, 3.0], **options)
    assert capsys.readouterr().err == ''
    simulate_batch(PHANTOM, START, [1.0, 2.0, 3.0], progress=True, **options)
    assert re.search(r'\b0/3 ', capsys.readouterr().err)
