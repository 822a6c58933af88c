# SPDX-License-Identifier: Apache-2.0
"""Restart of the steering executive: an insertion is resumed, or the user is told what to do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import json
import os
from pathlib import Path
import time
from typing import Any

from needle_controller import ExecutiveSettings, SteeringExecutive, SteeringPrior
from needle_controller.steering.insertion_record import RecordFile, SteeringRecord
from needle_controller.steering.motion import JointMotion
from needle_ros.errors import MessageError, ParameterError
from needle_ros.status import SteeringPhase
from needle_ros.system_state import CLEAR_STOP, PAUSE, RESUME, RETRACT, STOP
import numpy as np
import pytest
from support.steered_robot import CONTINUOUS, NEEDLE, PERIOD, Robot, SETTINGS, STEERING, TARGET


class Rig(Robot):
    """A robot whose executive can be killed; its record is kept as JSON before each motion."""

    def __init__(self, own: ExecutiveSettings = SETTINGS, **options: Any) -> None:
        self.text = ''
        self.sent: list[JointMotion] = []
        #: Periods of a whole insertion.
        self.length = 0
        super().__init__(own, **options)

    def follow(self, move: JointMotion | None) -> None:
        """Keep the record, then send the motion."""
        self.keep()
        if move is not None:
            self.sent.append(move)
        super().follow(move)

    def keep(self) -> None:
        """Write the record as the node does."""
        record = self.loop.keeper.changed(self.loop.fault)
        if record is not None:
            self.text = json.dumps(record.to_values())

    def restart(self, own: ExecutiveSettings | None = None, **options: Any) -> None:
        """Replace the executive by a new one, which has the record and the system state."""
        state = self.loop.authority.state
        given: dict[str, Any] = {'prior': SteeringPrior(), 'settings': own or SETTINGS, **options}
        self.loop = SteeringExecutive(NEEDLE, STEERING, steady=lambda: self.seconds, **given)
        self.loop.authority.receive(state)
        if self.text:
            self.loop.planner.recalled = SteeringRecord.from_values(json.loads(self.text))
        self.sent.clear()

    def begin(self, ticks: int) -> None:
        """Send a target, and run for a number of periods."""
        self.tick(20)
        assert self.aim() == ''
        self.tick(ticks)

    def finish(self) -> None:
        """Run until the end of the insertion."""
        for _ in range(8000):
            if not self.loop.steers:
                return
            self.tick()
        pytest.fail(f'steering does not end: {self.loop.phase}')

    @property
    def said(self) -> str:
        return self.loop.diagnose(self.now)[1]


@pytest.fixture(scope='module')
def whole() -> Rig:
    """Return an insertion without a restart."""
    rig = Rig()
    rig.begin(0)
    begin = rig.now
    rig.finish()
    assert rig.loop.phase is SteeringPhase.DONE
    rig.length = (rig.now - begin) // PERIOD
    return rig


@pytest.mark.requirement('S-226', 'S-227')
@pytest.mark.parametrize('seed', range(8))
def test_killed_insertion_is_resumed_by_its_target(whole: Rig, seed: int) -> None:
    """At a random time; nothing moves before the request, and it ends at the target."""
    rng = np.random.default_rng(seed)
    rig = Rig()
    rig.begin(int(rng.integers(1, whole.length)))
    # The last motion is followed to its end, or the restart is immediate.
    steers = rig.loop.steers
    rig.restart()
    rig.tick(int(rng.integers(1, 300)))
    assert rig.sent == []
    phase = rig.loop.phase
    assert phase is SteeringPhase.IDLE
    assert steers
    # A needle at its start is not resumed, but begins again.
    assert ('was interrupted in step' in rig.said) == (rig.at[0] > 1e-3)
    assert rig.aim() == ''
    rig.finish()
    assert rig.loop.phase is SteeringPhase.DONE, rig.said
    # Both within the accuracy of the law for this needle.
    assert rig.miss < max(1.5 * whole.miss, 5e-4)


def test_estimate_is_restored_exactly() -> None:
    """The replayed law has the same expected tip, and the record continues."""
    rig = Rig()
    rig.begin(1300)
    before, expected = json.loads(rig.text), rig.loop.expected
    assert expected is not None
    assert np.allclose(before['expected'], expected.mean, rtol=0.0, atol=0.0)
    rig.restart()
    rig.tick(300)
    assert rig.aim() == ''
    restored = rig.loop.expected
    assert restored is not None
    assert restored.mean.tolist() == expected.mean.tolist()
    assert restored.covariance.tolist() == expected.covariance.tolist()
    rig.keep()
    assert json.loads(rig.text)['history'] == before['history']
    # A second restart, too.
    rig.tick(400)
    rig.restart()
    rig.tick(100)
    assert rig.aim() == ''
    rig.finish()
    assert rig.loop.phase is SteeringPhase.DONE


def test_target_may_change_with_the_restart() -> None:
    rig = Rig()
    rig.begin(900)
    rig.restart()
    rig.tick(200)
    x, y, z = TARGET
    assert rig.aim((x + 3e-4, y, z)) == ''
    assert rig.loop.law is not None
    assert rig.loop.law.target.tolist() == [x + 3e-4, z]
    rig.keep()
    rig.restart()
    rig.tick(200)
    assert rig.aim() == ''
    assert rig.loop.law.target.tolist() == [x, z]


@pytest.mark.parametrize('restarts', [1, 2])
def test_newest_target_is_the_one_to_send_again(restarts: int) -> None:
    """The state names it, and the insertion is resumed to it without another change."""
    rig = Rig()
    rig.begin(900)
    newest = x, _, z = -TARGET[0], TARGET[1], -TARGET[2]
    assert rig.aim(newest) == ''
    for _ in range(restarts):
        rig.restart()
        rig.tick(200)
        assert f'to x = {1e3 * x:.2f} mm, z = {1e3 * z:.2f} mm at a depth of' in rig.said
        assert rig.aim(newest) == ''
    assert rig.loop.law.target.tolist() == [x, z]
    rig.keep()
    record = SteeringRecord.from_values(json.loads(rig.text))
    assert [entry['aim'] for entry in record.history if 'aim' in entry] == [[x, z]]
    assert record.target == newest


MOVED = 'outside its last motion'
#: A retraction would end too deep with the settings of the tests.
DEEPER = 'set retract_depth to 0.00 mm (it is 10.00 mm), and '


@pytest.mark.requirement('S-226', 'S-228', 'S-229')
@pytest.mark.parametrize(
    ('event', 'reason'),
    [
        ('deeper', MOVED),
        ('withdrawn', MOVED),
        ('guide', MOVED),
        ('tip', 'the tip has moved by'),
        ('slip', 'the tip has moved by'),
        ('stop', 'the system was stopped, paused or retracted'),
        ('pause', 'the system was stopped, paused or retracted'),
        ('constants', 'its law or constants have changed'),
        ('law', 'its law or constants have changed'),
        ('continuous', 'the needle is inserted without rests'),
    ],
)
def test_contradicted_record_names_the_action(event: str, reason: str) -> None:
    """Retract the needle to where it began: then a target is accepted again."""
    rig = Rig()
    rig.begin(1300)
    options: dict[str, Any] = {}
    if event == 'constants':
        options['prior'] = replace(SteeringPrior(), noise=3e-4)
    elif event == 'law':
        options['law'] = 'springs'
    rig.restart(CONTINUOUS if event == 'continuous' else None, **options)
    rig.tick(300)
    shift = {'deeper': [8e-3, 0, 0], 'withdrawn': [-8e-3, 0, 0], 'guide': [0, 0, 5e-3]}
    for k, change in enumerate(shift.get(event, [0.0, 0.0, 0.0])):
        times, positions = rig.ways[k]
        rig.ways[k] = times, positions + change
    if event in ('tip', 'slip'):
        off = np.array([8e-3, 0.0, 0.0] if event == 'tip' else [0.0, -5e-3, 0.0])
        rig.sees = lambda tip: tip + off
    rig.tick(20)
    for word in {'stop': (STOP, CLEAR_STOP), 'pause': (PAUSE, RESUME)}.get(event, ()):
        rig.loop.authority.request(word)
        rig.loop.obey(rig.now)
    rig.tick(20)
    said = rig.aim()
    assert 'the insertion cannot be resumed: ' in said
    assert reason in said
    assert said.endswith(f'; {DEEPER}retract the needle to 0.00 mm first')
    if event in ('stop', 'pause'):
        assert f'paused or retracted): {DEEPER}retract the needle to 0.00 mm' in rig.said
    rig.tick(50)
    assert rig.sent == []
    assert rig.loop.phase is SteeringPhase.IDLE


@pytest.mark.requirement('S-228')
def test_needle_without_a_record_is_retracted() -> None:
    rig = Rig()
    rig.begin(1300)
    rig.text = ''
    rig.restart()
    rig.tick(300)
    assert rig.aim().endswith('a needle has to be straight at the start: retract it first')
    assert rig.sent == []


@pytest.mark.requirement('S-229')
def test_ended_insertion_is_not_resumed(whole: Rig) -> None:
    """Done, or stopped: the needle is retracted before the next target."""
    rig = Rig()
    rig.begin(1300)
    assert rig.request(STOP)
    rig.tick(100)
    assert rig.request(CLEAR_STOP)
    rig.keep()
    rig.restart()
    rig.tick(50)
    assert f'has ended (requested by a user): {DEEPER}retract the needle' in rig.said
    assert 'cannot be resumed: requested by a user' in rig.aim()
    assert rig.request(RETRACT)
    rig.tick(3000)
    assert json.loads(whole.text)['ended'] == 'it is done'


@pytest.mark.requirement('S-228', 'S-229')
@pytest.mark.parametrize('own', [0.0, 5e-4, 2e-3, SETTINGS.retract_depth])
def test_retraction_after_a_restart_permits_the_next_insertion(own: float) -> None:
    """Or the state and the rejection name `retract_depth` as the setting to reduce."""
    settings = replace(SETTINGS, retract_depth=own)
    rig = Rig(settings)
    rig.begin(1300)
    rig.restart(settings)
    rig.tick(300)
    assert 'send its target again to resume it' in rig.said
    assert rig.request(RETRACT)
    rig.tick(3000)
    assert rig.loop.phase is SteeringPhase.IDLE
    assert 'resume' not in rig.said
    rejection = rig.aim()
    if own <= 1e-3:
        assert rejection == ''
        return
    action = f'set retract_depth to 0.00 mm (it is {1e3 * own:.2f} mm), and retract the needle'
    assert f'has ended (the system was stopped, paused or retracted): {action}' in rig.said
    assert rejection.endswith(f'; {action} to 0.00 mm first')


def test_invalid_record_is_an_error() -> None:
    for values in ({}, {'point': [0.0, 0.0, 0.0]}, {'other': 1}):
        with pytest.raises(MessageError, match='not a record of an insertion'):
            SteeringRecord.from_values(values)


@pytest.fixture
def written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the path of the file of node `steering` on domain 47."""
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    path = tmp_path / 'needle_insertion' / 'steering.47.json'
    path.parent.mkdir()
    return path


def until(condition: Callable[[], object]) -> None:
    """Wait for a thread; fail after a minute."""
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.mark.requirement('S-280')
def test_newest_record_is_written_when_a_blocked_disk_responds(written: Path) -> None:
    """A writer of a FIFO without a reader waits, as for a disk without a response."""
    file = RecordFile('/steering', 47)
    draft = written.with_name(f'{written.name}.{os.getpid()}.tmp')
    os.mkfifo(draft)
    for record in 'abc':
        with pytest.raises(ParameterError, match=r'is not written within 0\.05 s'):
            file.write(record, 'robot')
    disk = os.open(draft, os.O_RDONLY | os.O_NONBLOCK)
    until(written.is_file)
    os.close(disk)
    assert json.loads(written.read_text()) == {'source': 'robot', 'record': 'c'}
    # The disk responds: an error or a record is known at the end of the call.
    file.write('d', 'robot')
    assert json.loads(written.read_text())['record'] == 'd'
    written.unlink()
    written.mkdir()
    with pytest.raises(ParameterError, match='it is not the name of a file'):
        file.write('e', 'robot')


@pytest.mark.requirement('S-280')
def test_record_of_a_blocked_disk_is_an_error(written: Path) -> None:
    os.mkfifo(written)
    with pytest.raises(MessageError, match=r'is not read within 0\.05 s'):
        RecordFile('/steering', 47).read()
    # The thread ends.
    with written.open('w'):
        pass
