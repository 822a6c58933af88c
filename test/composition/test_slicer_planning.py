# SPDX-License-Identifier: Apache-2.0
"""Plans for a segmentation and a target of 3D Slicer: results, faults, and the newest input."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

from needle_controller.steering.planning import Job, ThreadJob
from needle_dynamics import FloatArray
from needle_insertion.slicer.link import Frame
from needle_insertion.slicer.messages import read_segmentation, SEGMENTATION
from needle_insertion.slicer.planning import SlicerPlanner, SlicerPlanSettings
from needle_planning import Anatomy, find_plan, read_plan, Structure
from needle_planning.voxels import Layer
from needle_ros.errors import ParameterError
from needle_ros.event_log import EventLog, Severity
import numpy as np
import pytest
from support.slicer_anatomy import image_message, LABELS, MATRIX, TARGET, VALUES


@pytest.fixture
def labels(tmp_path: Path) -> Path:
    file = tmp_path / 'labels.yaml'
    file.write_text(LABELS)
    return file


def settings_of(labels: Path, **values: Any) -> SlicerPlanSettings:
    return SlicerPlanSettings(labels=str(labels), **{'straight': True, **values})


def segmentation(values: Any = VALUES) -> Frame:
    return Frame('IMAGE', SEGMENTATION, image_message(values, MATRIX))


def beside(distance: float) -> FloatArray:
    """Return a target that is moved along x [mm]."""
    return TARGET + np.array([distance, 0.0, 0.0])


class Table:
    """Planner with its log."""

    def __init__(self, settings: SlicerPlanSettings, **options: Any) -> None:
        self.events = EventLog()
        options = {'read': read_segmentation, 'start': Job, **options}
        self.planner = SlicerPlanner(settings, events=self.events, **options)
        self.lines: list[tuple[Severity, str]] = []

    def poll(self) -> None:
        self.planner.poll()
        self.lines += self.events.take()

    def finish(self) -> str:
        """Poll until all synchronous jobs are done; return the state."""
        for _ in range(4):
            self.poll()
        return self.planner.state


def table_of_waiting_jobs(labels: Path) -> tuple[Table, list[Any]]:
    """Return a planner whose jobs start by their method `run`, and the list of its jobs."""
    jobs: list[Any] = []

    class Waiting(Job[Any]):
        def _start(self) -> None:
            jobs.append(self)

        def run(self) -> None:
            Job._start(self)

    return Table(settings_of(labels), start=Waiting), jobs


def test_plan_is_that_of_the_anatomy(labels: Path, tmp_path: Path) -> None:
    """Of both inputs in any order, with needle, clearance and file."""
    structures = {
        1: Structure(name='skin', role='entry'),
        2: Structure(name='bone', role='obstacle', margin=2e-3),
        3: Structure(name='tumor', role='target'),
    }
    anatomy = Anatomy(
        labels=VALUES, to_patient=np.diag([1e-3, 1e-3, 1e-3, 1.0]) @ MATRIX, structures=structures
    )
    expected = find_plan(anatomy, 1e-3 * TARGET, bow=False)
    output = tmp_path / 'plan.yaml'
    for order in (0, 1):
        table = Table(settings_of(labels, output=str(output)))
        inputs: list[Callable[[], None]] = [
            partial(table.planner.take_target, TARGET),
            partial(table.planner.take_segmentation, segmentation()),
        ]
        inputs[order]()
        assert 'waits for' in table.finish()
        assert table.planner.shape is None
        inputs[1 - order]()
        state = table.finish()
        assert f'plan for the target ({", ".join(f"{x:.1f}" for x in TARGET)}) mm' in state
        assert f'wrote {output}' in state
        found = read_plan(output)
        # The matrix of the message has 24 bits: 6e-8 of 0.1 m.
        np.testing.assert_allclose(found.entry, expected.entry, atol=1e-7)
        # It changes by at most the change of the positions.
        assert found.clearance == pytest.approx(expected.clearance, abs=1e-7)
        assert table.planner.shape is not None
        np.testing.assert_allclose(table.planner.shape.curve[-1], TARGET, atol=1e-3)
        assert table.lines[-1] == (Severity.INFO, state)
        output.unlink()


def test_new_target_needs_no_new_segmentation(labels: Path) -> None:
    """And nothing is written without an output."""
    table = Table(settings_of(labels))
    table.planner.take_segmentation(segmentation())
    table.planner.take_target(TARGET)
    assert 'wrote' not in table.finish()
    first = table.planner.shape
    table.planner.take_target(beside(1.0))
    assert 'wrote' not in table.finish()
    assert table.planner.shape is not None
    assert table.planner.shape is not first
    assert sorted(one.name for one in labels.parent.iterdir()) == ['labels.yaml']


def without(*values: int) -> Any:
    changed = VALUES.copy()
    changed[np.isin(changed, values)] = 0
    return changed


@pytest.mark.requirement('S-315')
@pytest.mark.parametrize(
    ('values', 'reason'),
    [
        (np.where(VALUES == 2, 9, VALUES), 'labels without a role: SEGMENTATION:9'),
        (without(2), 'structures: 2 is in no segmentation; there are SEGMENTATION:1'),
        (-VALUES, 'has the value -'),
    ],
)
def test_refused_segmentation_is_one_line(labels: Path, values: Any, reason: str) -> None:
    """It replaces the one before, which is another anatomy."""
    table = Table(settings_of(labels))
    table.planner.take_segmentation(segmentation())
    table.finish()
    table.planner.take_segmentation(segmentation(values))
    state = table.finish()
    assert state.startswith('segmentation refused: ')
    assert reason in state
    assert table.lines[-1] == (Severity.ERROR, state)
    assert table.events.rejected == 1
    table.planner.take_target(TARGET)
    assert table.finish().endswith('waits for the label map SEGMENTATION')


def test_corrected_labels_are_read_for_the_next_segmentation(labels: Path) -> None:
    """And labels that became invalid are refused with the segmentation, which is discarded."""
    table = Table(settings_of(labels))
    table.planner.take_target(TARGET)
    invalid = LABELS.replace('role: entry', 'role: skin')
    for text, reason in (
        (LABELS.replace('2: {', '9: {'), 'labels without a role: SEGMENTATION:2'),
        (LABELS, ''),
        (invalid, f'{labels}: structures: 1.role must be one of'),
        (LABELS, ''),
    ):
        labels.write_text(text)
        table.planner.take_segmentation(segmentation())
        state = table.finish()
        assert state.startswith('segmentation refused: ' if reason else 'plan for the target')
        assert reason in state
        assert (table.planner.shape is None) == bool(reason)


@pytest.mark.requirement('S-315')
def test_segmentation_without_its_end_is_refused(labels: Path) -> None:
    """As a damaged one: the anatomy before is another one."""
    table = Table(settings_of(labels))
    table.planner.take_segmentation(segmentation())
    table.planner.take_target(TARGET)
    assert table.finish().startswith('plan for the target')
    table.planner.take_segmentation(Frame('IMAGE', SEGMENTATION, b'', 'connection lost'))
    state = table.finish()
    assert state.startswith('segmentation refused: SEGMENTATION: connection lost')
    assert state.endswith('the needle shown is of an earlier plan')
    table.planner.take_target(beside(1.0))
    assert table.finish().endswith('waits for the label map SEGMENTATION')


def test_refused_target_is_stated_until_one_is_accepted(labels: Path) -> None:
    """At any stage; the target before is discarded, and its needle is of an earlier plan."""
    table = Table(settings_of(labels))
    refused = 'target refused: it is invalid'
    table.planner.take_target(TARGET)
    table.finish()
    table.planner.refuse_target('it is invalid')
    assert table.finish() == f'{refused}; waits for the label map SEGMENTATION and a target'
    table.planner.take_segmentation(segmentation())
    state = table.finish()
    assert state == f'{refused}; segmentation with 3 structures; waits for a target'
    table.planner.take_target(TARGET)
    assert table.finish().startswith('plan for the target')
    table.planner.refuse_target('it is invalid')
    shown = '; the needle shown is of an earlier plan'
    assert table.finish() == f'{refused}{shown}; waits for a target'
    assert table.planner.shape is None
    assert table.events.last_rejection == f'{refused}{shown}'
    # No plan for the target before.
    table.planner.take_segmentation(segmentation())
    assert table.finish().startswith(refused)
    table.planner.take_target(TARGET)
    assert table.finish().startswith('plan for the target')
    assert table.events.rejected == 2


def test_target_that_is_refused_while_planning_ends_the_plan(labels: Path) -> None:
    table, jobs = table_of_waiting_jobs(labels)
    table.planner.take_segmentation(segmentation())
    table.planner.take_target(TARGET)
    table.poll()
    jobs[0].run()
    table.poll()
    table.planner.refuse_target('it is invalid')
    jobs[1].run()
    for _ in range(3):
        table.poll()
    assert table.planner.state == 'target refused: it is invalid; waits for a target'
    assert table.planner.shape is None


def test_refused_segmentation_names_the_needle_shown(labels: Path) -> None:
    """As a failed plan does; nothing is said of a needle that was never shown."""
    table = Table(settings_of(labels))
    for shown in (False, True):
        table.planner.take_segmentation(segmentation(-VALUES))
        state = table.finish()
        assert state.startswith('segmentation refused: ')
        assert ('the needle shown is of an earlier plan' in state) == shown
        assert table.planner.shape is None
        table.planner.take_segmentation(segmentation())
        table.planner.take_target(TARGET)
        table.finish()
        assert table.planner.shape is not None


@pytest.mark.parametrize(
    ('target', 'reason'),
    [
        ((500.0, 0.0, 0.0), 'is outside the image'),
        (MATRIX[:3, 3] + (22.0, 40.0, 50.0), 'the target is in bone'),
    ],
)
def test_failed_plan_is_one_line(labels: Path, tmp_path: Path, target: Any, reason: str) -> None:
    """The needle of an earlier plan is named, and not sent to another peer; its file remains."""
    output = tmp_path / 'plan.yaml'
    table = Table(settings_of(labels, output=str(output)))
    table.planner.take_segmentation(segmentation())
    table.planner.take_target(TARGET)
    table.finish()
    before = output.read_bytes()
    # Also after a second failure.
    for _ in range(2):
        table.planner.take_target(np.array(target))
        state = table.finish()
        assert state.startswith('no plan for the target (')
        assert reason in state
        assert 'the needle shown is of an earlier plan' in state
        assert len(state.splitlines()) == 1
        assert table.lines[-1] == (Severity.ERROR, state)
        assert table.planner.shape is None
        assert output.read_bytes() == before


def test_segmentation_without_entry_is_one_line(tmp_path: Path) -> None:
    file = tmp_path / 'labels.yaml'
    file.write_text(LABELS.replace('role: entry', 'role: tissue'))
    table = Table(settings_of(file))
    table.planner.take_segmentation(segmentation())
    table.planner.take_target(TARGET)
    assert 'no voxel belongs to the entry region' in table.finish()


def test_target_beside_its_structure_is_a_warning(labels: Path) -> None:
    """The plan is to the target."""
    table = Table(settings_of(labels))
    table.planner.take_segmentation(segmentation())
    table.planner.take_target(beside(8.0))
    assert table.finish().endswith('the target is not in tumor (it is in no structure)')
    assert table.lines[-1][0] is Severity.WARNING
    assert table.planner.shape is not None


def test_file_that_cannot_be_written_is_an_error(labels: Path, tmp_path: Path) -> None:
    """The plan is shown nevertheless."""
    (tmp_path / 'folder').mkdir()
    table = Table(settings_of(labels, output=str(tmp_path / 'folder')))
    table.planner.take_segmentation(segmentation())
    table.planner.take_target(TARGET)
    assert 'not written: ' in table.finish()
    assert table.lines[-1][0] is Severity.ERROR
    assert table.planner.shape is not None


def test_memory_error_is_one_line(labels: Path) -> None:
    def read(_: Frame) -> Layer:
        raise MemoryError

    table = Table(settings_of(labels), read=read)
    table.planner.take_segmentation(segmentation())
    assert table.finish() == 'segmentation refused: it exceeds the memory'


def test_newest_inputs_are_planned(labels: Path) -> None:
    """While a segmentation is read: neither an older one nor an older target is planned."""
    begun, released = Event(), Event()
    read_frames = []

    def read(frame: Frame) -> Layer:
        begun.set()
        assert released.wait(60.0)
        read_frames.append(frame)
        return read_segmentation(frame)

    jobs: list[ThreadJob[Any]] = []

    def start(work: Any) -> ThreadJob[Any]:
        jobs.append(ThreadJob(work))
        return jobs[-1]

    table = Table(settings_of(labels), read=read, start=start)
    frames = [segmentation() for _ in range(3)]
    table.planner.take_segmentation(frames[0])
    table.poll()
    assert begun.wait(60.0)
    for k, frame in enumerate(frames[1:]):
        table.planner.take_segmentation(frame)
        table.planner.take_target(beside(float(k)))
        table.poll()
    # One at a time.
    assert len(jobs) == 1
    released.set()
    for k in range(3):
        assert jobs[k].wait(60.0)
        table.poll()
    table.poll()
    assert [one is frames[k] for one, k in zip(read_frames, (0, 2), strict=True)] == [True, True]
    plans = [line for _, line in table.lines if line.startswith('plan for')]
    assert len(plans) == 1
    assert f'({TARGET[0] + 1.0:.1f}, ' in plans[0]


def test_target_while_planning_replaces_the_plan(labels: Path) -> None:
    """The cancelled plan is not shown, although it may be complete."""
    table, jobs = table_of_waiting_jobs(labels)
    table.planner.take_segmentation(segmentation())
    table.poll()
    jobs[0].run()
    table.planner.take_target(TARGET)
    table.poll()
    table.planner.take_target(beside(1.0))
    jobs[1].run()
    table.poll()
    assert table.planner.shape is None
    jobs[2].run()
    table.poll()
    assert table.planner.shape is not None
    np.testing.assert_allclose(table.planner.shape.curve[-1], beside(1.0), atol=1e-3)
    assert not [line for severity, line in table.lines if severity is Severity.ERROR]


@pytest.mark.parametrize(
    ('values', 'reason'),
    [
        ({'labels': 'none.yaml'}, 'none.yaml cannot be read: No such file'),
        ({'output': 'no/folder/plan.yaml'}, 'output: no/folder is not a folder'),
        ({'turns': 1}, 'turns must be 0'),
        ({'needle': 'straw'}, 'straw'),
        ({'guide_limit': -1.0}, 'guide_limit'),
    ],
)
def test_invalid_settings_are_one_line(labels: Path, values: Any, reason: str) -> None:
    with pytest.raises(ParameterError) as caught:
        Table(SlicerPlanSettings(**{'labels': str(labels), **values}))
    assert reason in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
