# SPDX-License-Identifier: Apache-2.0
"""File of a plan: it is the plan, and a file that no plan was written to is refused by a line."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

from needle_planning import find_plan, Plan, read_plan, write_plan
from needle_ros.errors import NeedleError, ParameterError
import numpy as np
import pytest
from support.anatomies import plan_of, window, WINDOW_TARGET
import yaml


def test_plan_file_is_the_plan(tmp_path: Path) -> None:
    """A plan that is written and read is the same, to the last bit."""
    plan = find_plan(window(1.3e-3, 2), WINDOW_TARGET, entry=(0.028, 0.038, 0.117))
    file = tmp_path / 'plan.yaml'
    write_plan(plan, file)
    again = read_plan(file)
    for item in fields(Plan):
        assert np.array_equal(getattr(plan, item.name), getattr(again, item.name)), item.name
    assert again.length == plan.length
    assert again.axes == pytest.approx(plan.axes)
    assert list(plan.to_dataframe()) == list(plan.columns())


def edited(file: Path, **changes: Any) -> Path:
    """Write a plan with other values of some keys; None removes a key."""
    write_plan(plan_of(np.array([0.02, -0.01, 0.1]), np.array([0.6, 0.0, -0.8])), file)
    document = yaml.safe_load(file.read_text()) | changes
    left = {key: value for key, value in document.items() if value is not None}
    file.write_text(yaml.safe_dump(left, sort_keys=False))
    return file


@pytest.mark.parametrize(
    ('key', 'value', 'message'),
    [
        ('plan', 2, 'is not a plan of format 1'),
        ('needle', 3, 'needle must be text, got 3'),
        ('roll', 'right', "roll must be a number, got 'right'"),
        ('entry', [1.0, 0.02, -0.01, 0.1], r'entry must have shape \(3,\), got \(4,\)'),
        ('target', [float('nan'), 0, 0], 'target must be finite, got nan'),
        ('depths', [0.0, 0.06], 'depths must have shape'),
        ('depths', [0.01 * k + 0.01 for k in range(7)], 'depths must increase from 0 m'),
        ('guide', 'left', "guide must be a list of setpoints x, z, got 'left'"),
        ('free', [[0.1, 1.0]], r'free must have shape \(n, 17\), got \(1, 2\)'),
        ('free', [[0.1] + [-1.0] * 16], 'free must be at increasing depths'),
        ('frame', 'LPS, mm', "frame must be RAS, SI units, got 'LPS, mm'"),
        ('roll', True, 'roll must be a number, got True'),
        ('target', [True, 0.0, 0.0], 'target must be numbers, got True'),
        ('depths', ['0.0', *[0.01 * k for k in range(1, 7)]], "depths must be numbers, got '0.0'"),
        ('guide', [[False, 0.0] for _ in range(6)], 'guide must be numbers, got False'),
        ('direction', [0.0, 0.0, 0.0], 'direction must have the length 1, got 0'),
        ('direction', [0.6, 0.0, -0.81], r'direction must have the length 1, got 1\.008'),
        (
            'direction',
            [-0.6, 0.0, 0.8],
            r'target must be entry .* 0\.06 m as length; it is 120 mm',
        ),
        ('target', [0.0565, -0.01, 0.052], r'target must be entry .*; it is 0\.5 mm from there'),
        ('speed', 0.01, "unknown parameter 'speed'"),
    ],
)
def test_damaged_plan_is_rejected_by_a_line(
    key: str, value: Any, message: str, tmp_path: Path
) -> None:
    """With file and key."""
    file = edited(tmp_path / 'plan.yaml', **{key: value})
    with pytest.raises(NeedleError, match=message) as error:
        read_plan(file)
    assert str(error.value).startswith(str(file))
    assert len(str(error.value).splitlines()) == 1


def test_each_key_is_needed(tmp_path: Path) -> None:
    for key in ('frame', *(item.name for item in fields(Plan))):
        file = edited(tmp_path / 'plan.yaml', **{key: None})
        with pytest.raises(ParameterError, match=rf'plan\.yaml: {key} is missing$'):
            read_plan(file)


def test_rounded_plan_is_read(tmp_path: Path) -> None:
    """The digits of the printed result, 0.01 mm and 0.0001, are enough."""
    file = edited(
        tmp_path / 'plan.yaml', direction=[0.6001, 0.0, -0.7999], target=[0.05601, -0.01, 0.052]
    )
    assert read_plan(file).length == 0.06


def test_file_that_is_no_plan_is_rejected_by_a_line(tmp_path: Path) -> None:
    file = edited(tmp_path / 'plan.yaml')
    assert read_plan(file).needle == 'bending_35mm'
    file.write_text(file.read_text().replace('frame:', '\tframe:'))
    with pytest.raises(NeedleError, match=r'plan\.yaml is not YAML'):
        read_plan(file)
    with pytest.raises(ParameterError, match='cannot be read: No such file'):
        read_plan(tmp_path / 'none.yaml')
