# SPDX-License-Identifier: Apache-2.0
"""Readings of `needle watch` from robots with joints, units, topics and frames of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from math import inf, nan
from pathlib import Path
from typing import Any

from hypothesis import assume, given
from hypothesis import strategies as st
from needle_controller.hardware import HardwareSettings, Robot, settings_in
from needle_identification import BagWriter
from needle_identification.bags.messages import encode
from needle_insertion.watch.recorded import ShownRecording
from needle_insertion.watch.view import View
from needle_ros import contract
from needle_ros.errors import ParameterError
from needle_ros.wire import Reading, Template
import numpy as np
import pytest
from support.samples import EPOCH
from support.watched import made

#: A stage in mm that is retracted at 80 mm, and a sensor in its own frame and topic.
STAGE: dict[str, Any] = {
    'joint': 'slide', 'sign': -1.0, 'scale': 1e-3, 'zero': 80.0, 'state_topic': 'stage/joints',
    'wrench_topic': '/ati/wrench', 'wrench_frame': 'ati', 'force_axis': '-z',
}  # fmt: skip

NUMBERS = st.floats(-1e3, 1e3)


def parameters(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters that a controller publishes for a robot."""
    known = HardwareSettings(**settings)
    found = {item.name: getattr(known, item.name) for item in fields(known)}
    return {
        f'hardware.{name}': [*value] if isinstance(value, tuple) else value
        for name, value in found.items()
    }


def state(names: Sequence[str], position: float, velocity: float, effort: float) -> Reading:
    """Return joint states in which all joints have the same numbers."""
    numbers = ((one,) * len(names) for one in (position, velocity, effort))
    return Reading(EPOCH, '', tuple(names), tuple(numbers))


@given(
    st.sampled_from([-1.0, 1.0]),
    st.floats(1e-4, 10.0),
    *[NUMBERS] * 4,
    st.permutations(['other', 'slide', 'insertion']),
    st.sampled_from(['x', '-y', 'z']),
)
def test_numbers_are_converted_as_in_the_controller(
    sign: float, scale: float, zero: float, position: float, velocity: float, effort: float,
    names: list[str], axis: str,
) -> None:  # fmt: skip
    """Depth, velocity and force of any joint, unit and axis, as the controller converts them."""
    settings: dict[str, Any]
    settings = {'joint': 'slide', 'sign': sign, 'scale': scale, 'zero': zero, 'force_axis': axis}
    view, robot = View(), Robot(HardwareSettings(**settings))
    view.configuration('controller', parameters(settings))
    reading = state(names, position, velocity, effort)
    view.reading('joint_states', reading, 0.0)
    expected = robot.measurement(reading)
    seen = view.frame(0.0)
    assert [seen[name] for name in ('depth', 'velocity', 'force')] == pytest.approx(
        [expected.depth, expected.velocity, expected.force], abs=1e-6
    )
    wrench = Reading(EPOCH, 'needle_base', (), ((1.0, 2.0, 3.0, 4.0, 5.0, 6.0),))
    view.reading('base_wrench', wrench, 0.0)
    row = view.row(0.0)
    assert view.frame(0.0)['force'] in row
    assert view.frame(0.0)['force'] == robot.wrench(wrench).values[0][1]
    assert view.frame(0.0)['faults'] == {}


@given(st.lists(st.text(max_size=5), max_size=4))
def test_missing_joint_is_named_with_those_found(names: list[str]) -> None:
    """The joint of the configuration, and all joints of the message; no number is shown."""
    assume('slide' not in names)
    view = View()
    view.configuration('controller', parameters({'joint': 'slide'}))
    view.reading('joint_states', state(names, 1.0, 0.0, 0.0), 0.0)
    seen = view.frame(0.0)
    assert seen['depth'] is None
    assert "joint_states has no joint 'slide'; joints found: " in seen['faults']['depth']
    for name in names:
        assert repr(name) in seen['faults']['depth']
    assert view.lacks_joint('joint_states')


@given(st.lists(st.booleans(), min_size=1, max_size=40))
def test_reading_of_another_publisher_does_not_replace_the_depth(order: list[bool]) -> None:
    """With two publishers in any order, the newest message with the joint is shown."""
    view, depth = View(), None
    for k, has in enumerate(order):
        view.reading('joint_states', state(['insertion' if has else 'arm'], k, 0, 0), 0.01 * k)
        depth = float(k) if has else depth
        seen = view.frame(0.01 * k)
        assert seen['depth'] == depth
        assert ('depth' in seen['faults']) == (depth is None)


@pytest.mark.parametrize(
    ('topic', 'frame', 'settings', 'valid'),
    [
        ('base_wrench', 'needle_base', {}, True),
        ('base_wrench', 'camera', {}, False),
        ('base_wrench', '', {}, False),
        ('base_wrench', 'ati', {'wrench_frame': 'ati'}, True),
        ('base_wrench', 'needle_base', {'wrench_frame': 'ati'}, False),
        ('tip_deflection', 'needle_entry', {}, True),
        ('tip_deflection', 'camera', {}, False),
        ('joint_states', 'anything', {}, True),
    ],
)
def test_frame_is_checked_as_in_the_controller(
    topic: str, frame: str, settings: dict[str, Any], valid: bool
) -> None:
    """The reason is that of the controller."""
    view = View()
    view.configuration('controller', parameters(settings))
    names = ('insertion',) if topic == 'joint_states' else ()
    reading = Reading(EPOCH, frame, names, ((1e-3,) * 6, (0.0,), (0.0,)))
    view.reading(topic, reading, 0.0)
    reasons = {*view.frame(0.0)['faults'].values()}
    if valid:
        assert reasons == set()
    else:
        (reason,) = reasons
        assert f'{topic} must be in frame' in reason
        assert f'got {frame!r}' in reason


@pytest.mark.parametrize('stamps', ['header', 'receive'])
def test_constant_stamp_is_reported(stamps: str) -> None:
    """Unless the driver does not stamp: then the time of receipt counts."""
    view = View()
    view.configuration('controller', parameters({'stamps': stamps}))
    for k in range(30):
        view.reading('joint_states', state(['insertion'], 0.05, 0.0, 0.0), 0.1 * k)
        reason = view.frame(0.1 * k)['faults'].get('depth', '')
        assert bool(reason) == (k > 10 and stamps == 'header')
    if stamps == 'header':
        for time in (3.0, 4.1):
            view.reading('joint_states', state(['insertion'], 0.05, 0, 0)._replace(stamp=0), time)
        assert view.frame(4.1)['faults']['depth'] == 'joint_states has no stamp'
    assert reason in ('', f'joint_states: the stamp {EPOCH / 1e9:.3f} s does not advance')
    view.reading('joint_states', state(['insertion'], 0.05, 0, 0)._replace(stamp=1), 5.0)
    assert view.frame(5.0)['faults'] == {}


@pytest.mark.parametrize(('value', 'words'), [(nan, 'NaN received'), (inf, 'inf received')])
def test_value_that_is_not_finite_is_reported(value: float, words: str) -> None:
    """Beside the value, while a number that is not reported has no reason."""
    view = View()
    view.reading('joint_states', Reading(1, '', ('insertion',), ((value,), (), ())), 0.0)
    view.reading('base_wrench', Reading(1, 'needle_base', (), ((0, value, 0, 0, 0, 0),)), 0.0)
    view.reading('tip_deflection', Reading(1, 'needle_entry', (), ((value, 0.05, 0.0),)), 0.0)
    assert view.frame(0.0)['faults'] == {'depth': words, 'force': words, 'tip_x': words}


@pytest.mark.parametrize(
    ('settings', 'words'),
    [
        ({}, ''),
        (STAGE, ''),
        ({'state_topic': 'auto'}, 'topics that the controller finds by their type'),
        ({'state_type': 'dynamic_joint_state'}, 'dynamic_joint_state is not read by this page'),
    ],
)
def test_robot_that_is_not_followed_is_reported(settings: dict[str, Any], words: str) -> None:
    view = View()
    view.configuration('controller', parameters(settings))
    said = view.frame(0.0)['robot']
    assert words in said
    assert bool(words) == bool(said)
    own = settings.get('state_topic') in (None, 'auto')
    assert view.robot.topic('joint_states') == ('joint_states' if own else 'stage/joints')


def test_invalid_robot_is_reported() -> None:
    """An unknown value of the configuration leaves the contract."""
    view = View()
    view.configuration('controller', {'hardware.sign': 3.0})
    assert view.frame(0.0)['robot'] == (
        'configuration of the controller: hardware.sign must be finite, >= -1 and <= 1, got 3.0'
    )
    view.reading('joint_states', state(['insertion'], 0.05, 0.0, 0.0), 0.0)
    assert view.frame(0.0)['depth'] == 0.05


def test_settings_follow_from_parameters() -> None:
    """Given values replace them; an invalid one is named with its prefix."""
    settings = HardwareSettings(**STAGE)
    assert settings_in(parameters(STAGE)) == settings
    assert settings_in({**parameters(STAGE), 'rate': 100.0}, joint='a').joint == 'a'
    with pytest.raises(ParameterError, match=r'hardware\.scale'):
        settings_in({'hardware.scale': -1.0})


# Recordings.


def configuration(settings: Mapping[str, Any]) -> bytes:
    """Return the message of a controller with a robot."""
    lines = [f'    {name}: {value!r}' for name, value in parameters(settings).items()]
    text = '\n'.join(['/controller:', '  ros__parameters:', *lines])
    return encode(made('std_msgs/msg/String', data=text))


def recorded(path: Path, topics: Mapping[str, tuple[Template, Sequence[tuple[float, ...]]]],
             robot: Mapping[str, Any] | None = None) -> ShownRecording:  # fmt: skip
    """Record rows of a stamp [s] and numbers, received at 100 Hz, by topic."""
    with BagWriter(path) as bag:
        if robot is not None:
            bag.add_topic('/controller/configuration', contract.CONFIGURATION.type_name)
            bag.write('/controller/configuration', configuration(robot), EPOCH)
        for topic, (template, rows) in topics.items():
            kind = (
                'sensor_msgs/msg/JointState' if template.names else contract.BASE_WRENCH.type_name
            )
            bag.add_topic(topic, kind)
            for k, (time, *numbers) in enumerate(rows):
                stamp = EPOCH + round(1e9 * time)
                bag.write(topic, template.serialize(stamp, *numbers), EPOCH + 10_000_000 * k)
    return ShownRecording(path)


def joint(*names: str) -> Template:
    """Return a template of positions."""
    return Template('sensor_msgs/msg/JointState', names=names, counts=(len(names), 0, 0))


TIMES = np.arange(0.0, 2.0, 0.01).tolist()


def test_recording_of_a_robot_is_in_the_contract(tmp_path: Path) -> None:
    """Topics, joint, unit and axes of the recorded configuration, for numbers and charts."""
    force = Template('geometry_msgs/msg/WrenchStamped', 'ati')
    bag = recorded(
        tmp_path / 'bag',
        {
            '/stage/joints': (joint('base', 'slide'), [(t, 7.0, 80.0 - 20.0 * t) for t in TIMES]),
            '/ati/wrench': (force, [(t, 0.0, 0.0, -3.0 * t, 0.0, 0.0, 0.0) for t in TIMES]),
        },
        STAGE,
    )
    assert bag.losses == ()
    seen = bag.view(1.0).frame(1.0)
    assert (seen['depth'], seen['force'], seen['faults']) == (0.02, 3.0, {})
    signals = bag.signals()
    for name, rate in (('depth', 0.02), ('force', 3.0)):
        times, values = map(np.array, signals[name])
        np.testing.assert_allclose(values, rate * times, atol=1e-6)


def test_samples_after_a_clock_set_back_are_reported(tmp_path: Path) -> None:
    """Exactly the number of messages that are not shown."""
    rows = [(t if t < 1.0 else t - 0.5, t) for t in TIMES]
    bag = recorded(tmp_path / 'bag', {'/joint_states': (joint('insertion'), rows)})
    newest, lost = -1.0, 0
    for time, _ in rows:
        lost += time < newest
        newest = max(time, newest)
    (loss,) = bag.losses
    assert loss == (
        f'{lost} messages of joint_states are not shown: a stamp before has a later time '
        '(--time receive shows them)'
    )
    times, _ = bag.signals()['depth']
    assert len(times) == len(rows) - lost
    assert ShownRecording(tmp_path / 'bag', 'receive').losses == ()


def test_topics_that_are_not_shown_are_reported(tmp_path: Path) -> None:
    """Of two robots one is shown."""
    rows = [(t, t) for t in TIMES]
    topics = {f'/{name}/joint_states': (joint('insertion'), rows) for name in ('left', 'right')}
    bag = recorded(tmp_path / 'bag', topics)
    assert bag.losses == ('/right/joint_states: not shown, only /left/joint_states',)


def test_recording_without_the_joint_names_it(tmp_path: Path) -> None:
    """As a loss, and beside the number."""
    bag = recorded(
        tmp_path / 'bag', {'/joint_states': (joint('a', 'b'), [(t, 1, 2) for t in TIMES])}
    )
    (loss,) = bag.losses
    reason = "joint_states has no joint 'insertion'; joints found: 'a', 'b'"
    assert loss.startswith(f'{len(TIMES)} messages of joint_states are without a depth: {reason}')
    assert bag.view(1.0).frame(1.0)['faults']['depth'].startswith(reason)
