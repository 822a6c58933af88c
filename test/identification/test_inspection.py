# SPDX-License-Identifier: Apache-2.0
"""Inspection lists the content of a recording and prints a valid command."""

from __future__ import annotations

from collections.abc import Sequence
import json
from pathlib import Path
import re
import shlex
from typing import Any

from needle_identification import (
    BagWriter,
    inspect_recording,
    read_friction_recording,
    RecordingError,
)
from needle_identification.recordings.tables import column_roles
from needle_identification.steering.reading import read_steering_recording, STEERING_ROLES
from needle_insertion.cli import main
from needle_ros.errors import ParameterError
import numpy as np
from numpy.testing import assert_allclose
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import get_typestore, Stores
from support.samples import EPOCH, header, joint_states, STORE, TEXT, text, wrench
from support.steered_recording import recorded_plant
from support.strokes import strokes

ROS1 = get_typestore(Stores.ROS1_NOETIC)
WRENCH, JOINTS, POSE = (
    'geometry_msgs/msg/WrenchStamped',
    'sensor_msgs/msg/JointState',
    'geometry_msgs/msg/PoseStamped',
)


def test_table_with_a_moved_guide_is_for_steering(tmp_path: Path) -> None:
    """Also if it has a force; with a guide at rest it is for friction."""
    depth = np.linspace(0.0, 0.1, 21)
    columns = {
        'time': depth / 0.005, 'depth': depth, 'force': 1.0 + depth, 'guide_x': 0.01 * depth,
        'guide_z': 0.0 * depth, 'tip_x': 0.02 * depth, 'tip_z': 0.0 * depth,
    }  # fmt: skip
    for moves, kind in ((1.0, 'steering'), (0.0, 'friction')):
        columns['guide_x'] = moves * 0.01 * depth
        path = tmp_path / f'{kind}.csv'
        rows = np.column_stack(list(columns.values()))
        np.savetxt(path, rows, delimiter=',', header=','.join(columns), comments='')
        assert f'needle identify {kind} ' in inspect_recording(path).command


def ros1(path: Path, *, axis: int = 2, sign: float = -1.0) -> Path:
    """Write a ROS 1 recording with a robot of two joints, its pose, and two force sensors."""
    types = ROS1.types
    vector = types['geometry_msgs/msg/Vector3']
    made = strokes(seed=1)
    rng = np.random.default_rng(0)
    writer = Writer(path)
    writer.set_compression(Writer.CompressionFormat.BZ2)
    with writer:
        ft, other, joints, pose = (
            writer.add_connection(name, kind, typestore=ROS1)
            for name, kind in (
                ('/ft', WRENCH), ('/gripper_ft', WRENCH), ('/joints', JOINTS), ('/pose', POSE),
            )
        )  # fmt: skip
        for k, (t, depth, force) in enumerate(zip(made.time, made.depth, made.force, strict=True)):
            stamp = 1_700_000_000 * 10**9 + round(1e9 * t)
            header = types['std_msgs/msg/Header'](
                k, types['builtin_interfaces/msg/Time'](*divmod(stamp, 10**9)), 'base'
            )
            axes = [0.0, 0.0, 0.0]
            axes[axis] = sign * force
            moments = vector(0.0, 0.0, 0.0)
            pair = types['geometry_msgs/msg/Wrench']
            still = types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0)
            for connection, kind, message in (
                (ft, WRENCH, types[WRENCH](header, pair(vector(*axes), moments))),
                (other, WRENCH, types[WRENCH](header, pair(vector(*rng.normal(size=3)), moments))),
                (
                    joints, JOINTS,
                    types[JOINTS](
                        header, ['turn', 'slide'], np.array([0.1 * np.sin(t), depth]),
                        np.array([]), np.array([]),
                    ),
                ),
                (
                    pose, POSE,
                    types[POSE](
                        header,
                        types['geometry_msgs/msg/Pose'](
                            types['geometry_msgs/msg/Point'](0.3, 1e-6 * k, 0.2), still
                        ),
                    ),
                ),
            ):  # fmt: skip
                writer.write(connection, stamp, ROS1.serialize_ros1(message, kind))
    return path


#: Joints of each publisher; the rail moves.
ONE_ROBOT, TWO_ROBOTS = (('rail', 'roll', 'grip'),), (('rail',), ('arm_1', 'arm_2'))


def lab(
    path: Path,
    robots: tuple[tuple[str, ...], ...] = ONE_ROBOT,
    ahead: int = 0,
    resting: tuple[str, ...] = (),
) -> Path:
    """Write joints, a force at 1 kHz whose clock is ahead [ns], and sensors at rest by topic."""
    made = strokes(seed=1, push=0.0)
    with BagWriter(path) as bag:
        for topic, kind in (('/ft', WRENCH), ('/joints', JOINTS), *((t, WRENCH) for t in resting)):
            bag.add_topic(topic, kind)
        stamps = EPOCH + np.rint(1e9 * made.time).astype(np.int64)
        for stamp, depth, force in zip(stamps.tolist(), made.depth, made.force, strict=True):
            for k in range(4):
                at = stamp + k * 1_000_000
                bag.write('/ft', wrench(at + ahead, force), at)
            for names in robots:
                message = STORE.types[JOINTS](
                    header(stamp), list(names),
                    np.array([depth if name == 'rail' else 0.1 for name in names]),
                    np.array([]), np.array([]),
                )  # fmt: skip
                bag.write('/joints', bytes(STORE.serialize_cdr(message, JOINTS)), stamp)
            for topic in resting:
                bag.write(topic, wrench(stamp, 0.0), stamp)
    return path


@pytest.mark.parametrize(
    ('content', 'options'),
    [
        ({}, '--motion-axis rail'),
        ({'robots': (('rail',),), 'resting': ('/other',)}, '--wrench-topic /ft'),
        ({'robots': TWO_ROBOTS}, '--motion-axis rail'),
        ({'ahead': 3_000_000_000}, '--motion-axis rail'),
    ],
    ids=['joints at rest', 'sensor at rest', 'two publishers', 'clocks'],
)
def test_the_suggested_command_succeeds_with_others_at_rest(
    tmp_path: Path, content: dict[str, Any], options: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """And with two publishers on a topic, and with clocks 3 s apart."""
    found = inspect_recording(lab(tmp_path / 'bag', **content))
    assert found.command == f'needle identify friction {tmp_path / "bag"} {options}'
    assert found.losses == ()
    assert any('clocks differ' in one for one in found.words) == ('ahead' in content)
    rates = {one.name: one.rate for one in found.contents}
    # Messages, not the averages of 2.5 ms that are kept of a fast topic; these begin and end up to
    # 2.5 ms within the first and last message, of more than 10 s.
    assert rates['/ft'] == pytest.approx(1000.0, rel=1e-3)
    assert rates['/joints'] == pytest.approx(
        250.0 * len(content.get('robots', ONE_ROBOT)), rel=1e-3
    )
    assert run(found.command) == 0
    assert '0.56' in capsys.readouterr().out


def test_an_oblique_motion_of_a_bag_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The needle along x and -z; the third component is not known."""
    found = inspect_recording(posed(tmp_path / 'bag', motion=(0.6, 0.0, -0.8)))
    assert found.command.endswith('--force-axis -y --motion-axis z')
    said = 'x moves by -0.75 of z: the motion is oblique to the axis'
    assert any(said in one for one in found.words)
    assert run(found.command) == 0
    assert said in capsys.readouterr().err


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_sign_and_scale_of_a_recorded_robot_are_in_the_command(
    tmp_path: Path, sign: float
) -> None:
    """Of a spindle in rad; its commanded efforts are no motion, without a warning."""
    made, scale = strokes(seed=1, push=0.0), 0.0015
    path = tmp_path / 'bag'
    values = {'joint': 'spindle', 'sign': sign, 'scale': scale}
    lines = ''.join(f'    hardware.{name}: {value}\n' for name, value in values.items())
    with BagWriter(path) as bag:
        bag.add_topic('/controller/configuration', TEXT)
        bag.add_topic('/ft', WRENCH)
        for topic in ('/joints', '/commands'):
            bag.add_topic(topic, JOINTS)
        content = f'/**/controller:\n  ros__parameters:\n{lines}'
        bag.write('/controller/configuration', text(content), EPOCH)
        for time, depth, force in zip(made.time, made.depth, made.force, strict=True):
            stamp = EPOCH + round(1e9 * time)
            position = sign * depth / scale
            bag.write('/ft', wrench(stamp, force), stamp)
            bag.write('/joints', joint_states(stamp, position, None, ['spindle']), stamp)
            bare = STORE.types[JOINTS](
                header(stamp), ['spindle'], np.array([]), np.array([]), np.array([force])
            )
            bag.write('/commands', bytes(STORE.serialize_cdr(bare, JOINTS)), stamp)
    found = inspect_recording(path)
    assert not found.losses
    axis = f'{"-" * (sign < 0.0)}spindle*0.0015'
    assert shlex.split(found.command)[-1] == axis
    assert '--force-axis' not in found.command
    assert run(found.command) == 0
    topics: dict[str, Any] = {'wrench_topic': '/ft', 'motion_topic': '/joints'}
    same = read_friction_recording(path, **topics, motion_axis=axis)
    assert_allclose(np.ptp(same.depth), np.ptp(made.depth), rtol=1e-3)
    for wrong, said in (
        ('spindle[rad]', "microns, got 'rad'; or state a factor: NAME*FACTOR"),
        ('spindle*x', "must be a finite number, not zero, got 'x'"),
        ('spindle*0', "must be a finite number, not zero, got '0'"),
    ):
        with pytest.raises(ParameterError, match=re.escape(said)):
            read_friction_recording(path, **topics, motion_axis=wrong)


def test_a_motion_in_mm_of_a_bag_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The suggested command has the unit; the recording is that of the motion in m."""
    found = inspect_recording(posed(tmp_path / 'bag', motion=(0.0, 1e3, 0.0)))
    assert found.command.endswith("--motion-axis 'y[mm]'")
    assert run(found.command) == 0
    assert 'perhaps' not in capsys.readouterr().err
    in_mm = read_friction_recording(tmp_path / 'bag', motion_axis='y[mm]', force_axis='y[mN]')
    in_m = read_friction_recording(posed(tmp_path / 'other'))
    assert_allclose(in_mm.depth, in_m.depth, rtol=1e-12)
    assert_allclose(in_mm.force, 1e-3 * in_m.force, rtol=1e-12)
    assert main(['identify', 'friction', str(tmp_path / 'bag')]) == 0
    assert 'm along y: perhaps --motion-axis y[mm]' in capsys.readouterr().err


def test_a_force_in_mn_of_a_bag_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The suggested command has the unit, and gives the friction in N."""
    found = inspect_recording(posed(tmp_path / 'bag', force=(0.0, 1e3, 0.0)))
    assert found.command.endswith("--force-axis 'y[mN]'")
    assert run(found.command) == 0
    assert 'perhaps' not in capsys.readouterr().err
    in_mn = read_friction_recording(tmp_path / 'bag', force_axis='y[mN]')
    assert_allclose(in_mn.force, read_friction_recording(posed(tmp_path / 'other')).force)
    assert main(['identify', 'friction', str(tmp_path / 'bag')]) == 0
    assert 'N along y: perhaps --force-axis y[mN]' in capsys.readouterr().err


def test_a_tilted_force_sensor_is_named(tmp_path: Path) -> None:
    found = inspect_recording(posed(tmp_path / 'bag', force=(0.0, 0.8, 0.6)))
    said = 'z is 0.75 of y: a sensor that is tilted measures along y only a part of the force'
    assert any(said in one and 'which is 1.25 times as large' in one for one in found.words)
    straight = inspect_recording(posed(tmp_path / 'other'))
    assert not any('tilted' in one for one in straight.words)


def posed(
    path: Path, motion: Sequence[float] = (0.0, 1.0, 0.0), force: Sequence[float] = (0.0, 1.0, 0.0)
) -> Path:
    """Write strokes as force and pose along given directions."""
    made, kinds = strokes(seed=1, push=0.0), STORE.types
    still = kinds['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0)
    with BagWriter(path) as bag:
        for topic, kind in (('/ft', WRENCH), ('/pose', POSE)):
            bag.add_topic(topic, kind)
        for t, depth, size in zip(made.time.tolist(), made.depth, made.force, strict=True):
            stamp = EPOCH + round(1e9 * t)
            vectors = (
                kinds['geometry_msgs/msg/Vector3'](*parts)
                for parts in ([part * size for part in force], (0.0, 0.0, 0.0))
            )
            wrenches = kinds[WRENCH](header(stamp), kinds['geometry_msgs/msg/Wrench'](*vectors))
            bag.write('/ft', bytes(STORE.serialize_cdr(wrenches, WRENCH)), stamp)
            point = kinds['geometry_msgs/msg/Point'](*[part * depth for part in motion])
            pose = kinds['geometry_msgs/msg/Pose'](point, still)
            message = kinds[POSE](header(stamp), pose)
            bag.write('/pose', bytes(STORE.serialize_cdr(message, POSE)), stamp)
    return path


def run(command: str) -> int:
    program, *words = shlex.split(command)
    assert program == 'needle'
    return main(words)


@pytest.mark.parametrize(
    ('what', 'bag', 'rate'),
    [('friction', 'bags/friction_03', 100.0), ('stiffness', 'bags/stiffness_01', 40.0)],
)
def test_the_suggested_command_for_a_shipped_bag_succeeds(
    what: str, bag: str, rate: float, capsys: pytest.CaptureFixture[str]
) -> None:
    found = inspect_recording(bag)
    assert found.command == f'needle identify {what} {bag}'
    assert run(found.command) == 0
    rates = {one.name: one.rate for one in found.contents}
    # Samples of the simulated robot are equidistant.
    assert rates['/base_wrench'] == pytest.approx(rate, rel=1e-3)
    capsys.readouterr()


def test_commands_and_the_truth_are_not_measurements(tmp_path: Path) -> None:
    """Also if they explain each other better; without measurements they are used."""
    made, rng = strokes(seed=1, push=0.0), np.random.default_rng(2)
    noisy = made.force + rng.normal(scale=0.05, size=len(made.force))
    truth = ('/a/wrench_command', made.force), ('/a/ground_truth', made.depth)
    measured = ('/a/base_wrench', noisy), ('/a/joint_states', made.depth)
    for name, topics in (('own', (*truth, *measured)), ('truth', truth)):
        path = tmp_path / name
        with BagWriter(path) as bag:
            for topic, values in topics:
                is_force = 'wrench' in topic
                bag.add_topic(topic, WRENCH if is_force else JOINTS)
                for time, value in zip(made.time, values, strict=True):
                    stamp = EPOCH + round(1e9 * time)
                    one = wrench(stamp, value) if is_force else joint_states(stamp, value, None)
                    bag.write(topic, one, stamp)
        chosen = measured if name == 'own' else truth
        words = inspect_recording(path).words[0]
        assert all(topic in words for topic, _ in chosen), words


def test_force_and_motion_are_selected_among_signals(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """From two sensors, three axes, two joints and a pose; the sensor is reversed."""
    path = ros1(tmp_path / 'lab.bag')
    found = inspect_recording(path)
    assert found.command == (
        f'needle identify friction {path} --wrench-topic /ft --motion-topic /joints '
        '--force-axis -z --motion-axis slide'
    )
    assert found.losses == ()
    assert run(found.command) == 0
    out, _ = capsys.readouterr()
    assert '0.559' in out
    assert main(['inspect', str(path), '--json']) == 0
    [document] = json.loads(capsys.readouterr().out)
    assert document['command'] == found.command
    assert [one['name'] for one in document['contents']] == [
        '/ft', '/gripper_ft', '/joints', '/pose',
    ]  # fmt: skip


def test_a_truncated_ros_1_recording_gives_a_one_line_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = ros1(tmp_path / 'lab.bag')
    content = path.read_bytes()
    for size in (20, 5000, len(content) // 2, len(content) - 100):
        path.write_bytes(content[:size])
        assert main(['identify', 'friction', str(path)]) == 2
        _, err = capsys.readouterr()
        assert len(err.strip().splitlines()) == 1
        assert 'is damaged' in err


def test_table_columns_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = strokes(seed=3)
    path = tmp_path / 'run.csv'
    rows = np.column_stack([made.time, made.depth, made.force])
    np.savetxt(path, rows, delimiter=',', header='time,position,force', comments='')
    found = inspect_recording(path)
    assert [one.name for one in found.contents[0].columns] == ['time', 'position', 'force']
    assert run(found.command) == 0
    np.savetxt(path, rows, delimiter=',', header='a,b,c', comments='')
    assert 'no column looks like time' in inspect_recording(path).words[0]
    capsys.readouterr()


@pytest.mark.parametrize('speeds', [(0.005, 0.005), (0.01, 0.0025)])
def test_the_sign_of_a_motion_in_one_direction_is_kept(
    tmp_path: Path, speeds: tuple[float, float]
) -> None:
    """The first row has no speed: its force does not decide. Also with the sensor's zero."""
    time = np.arange(1000) / 100.0
    velocity = np.where(time < 5.0, *speeds)
    force = 1.0 + 0.5 + 200.0 * velocity + 0.02 * np.random.default_rng(0).normal(size=1000)
    force[0] = 2.0
    rows = np.column_stack([time, np.cumsum(velocity) / 100.0, force])
    path = tmp_path / 'run.csv'
    for name, known in (('in', False), ('in and out', True)):
        if known:
            rows = np.vstack([rows, rows * (1.0, 1.0, -1.0) + (10.0, 0.0, 0.0)])
            rows[1000:, 1] = rows[999::-1, 1]
        np.savetxt(path, rows, delimiter=',', header='time,depth,force', comments='')
        found = inspect_recording(path)
        assert found.command.endswith('time=time,depth=depth,force=force'), name
        assert ('the motion does not reverse' in found.words[-1]) != known


def test_a_table_of_a_steered_insertion_is_recognized(tmp_path: Path) -> None:
    path = tmp_path / 'gel 1.csv'
    rows = '\n'.join(f'{1 + k},{-5 * k},{2 + k},{0.1 * k},{-5 * k},{0.2 * k}' for k in range(9))
    path.write_text(f'Base x,Base y,Base z,Tip x,Tip y,Tip z\n{rows}\n', encoding='utf-8')
    found = inspect_recording(path)
    columns = (
        'depth=-Base y[mm],guide_x=Base x[mm],guide_z=Base z[mm],tip_x=Tip x[mm],tip_z=Tip z[mm]'
    )
    words = ['needle', 'identify', 'steering', str(path), '--columns', columns]
    assert shlex.split(found.command) == words
    read = read_steering_recording(path, columns=column_roles(columns, STEERING_ROLES))
    assert read.depth.max() == pytest.approx(0.04)
    assert 'depth by name and values: -Base y[mm]' in found.words


@pytest.mark.parametrize('sign', [1, -1])
def test_a_steered_insertion_with_a_depth_of_any_name_is_recognized(
    tmp_path: Path, sign: int
) -> None:
    """The depth is the only other column; else it must be named."""
    path = tmp_path / 'gel.csv'
    head = 't,robot_mm,base.x,base.z,tip.x,tip.y,tip.z'
    rows = [f'{k},{5 * sign * k},{1 + k},{2 + k},{0.1 * k},{5 * k},{0.2 * k}' for k in range(9)]
    path.write_text('\n'.join([head, *rows]) + '\n', encoding='utf-8')
    found = inspect_recording(path)
    columns = shlex.split(found.command)[-1]
    depth = f'depth={"-" * (sign < 0)}robot_mm'
    assert (
        columns == f'{depth},guide_x=base.x[mm],guide_z=base.z[mm],tip_x=tip.x[mm],tip_z=tip.z[mm]'
    )
    assert not found.lacking
    read = read_steering_recording(path, columns=column_roles(columns, STEERING_ROLES))
    assert read.depth.max() == pytest.approx(0.04)
    text = '\n'.join([f'{head},state', *(f'{row},1' for row in rows)])
    path.write_text(f'{text}\n', encoding='utf-8')
    found = inspect_recording(path)
    assert found.lacking == 'no column looks like depth: name it with --columns'
    assert found.command.startswith(f'needle identify steering {path} --columns depth=NAME,')


def test_a_missing_recording_gives_a_one_line_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RecordingError, match='does not exist'):
        inspect_recording('nowhere')
    assert main(['inspect', 'nowhere', 'bags/friction_01']) == 2
    out, err = capsys.readouterr()
    assert 'try: needle identify friction bags/friction_01' in out
    assert len(err.strip().splitlines()) == 1


def test_a_bag_with_a_moved_guide_is_proposed_for_steering(tmp_path: Path) -> None:
    own = recorded_plant(tmp_path, 1)
    assert inspect_recording(own).command == f'needle identify steering {own}'
    names = {'insertion': 'depth', 'guide_x': 'x_guide', 'guide_z': 'z_guide'}
    other = recorded_plant(tmp_path, 2, names)
    command = inspect_recording(other).command
    assert '--columns depth=-depth,guide_x=x_guide,guide_z=z_guide' in command
    columns = column_roles(shlex.split(command)[-1], STEERING_ROLES)
    assert read_steering_recording(other, columns=columns).depth.max() > 0.09


def test_units_of_a_friction_table_are_in_the_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In mm without a unit, the command gives the coefficients of the table in m."""
    made, path = strokes(seed=3), tmp_path / 'run.csv'
    found = []
    for factor in (1.0, 1e3):
        rows = np.column_stack([made.time, factor * made.depth, made.force])
        np.savetxt(path, rows, delimiter=',', header='time,position,force', comments='')
        assert main(['identify', str(path), '--json']) == 0
        out, err = capsys.readouterr()
        unit = '[mm]' if factor > 1.0 else ''
        assert f'time=time,depth=position{unit},force=force' in err
        found.append([one['mean'] for one in json.loads(out)['statistics'].values()])
    # 18 digits in the file.
    assert found[0] == pytest.approx(found[1], rel=1e-6)


@pytest.mark.parametrize(('kind', 'many'), [('friction', 3), ('stiffness', 1)])
def test_identify_chooses_the_kind_of_inspect(
    kind: str, many: int, capsys: pytest.CaptureFixture[str]
) -> None:
    bags = [f'bags/{kind}_0{k + 1}' for k in range(many)]
    assert main(['identify', kind, *bags, '--json']) == 0
    expected = capsys.readouterr().out
    assert main(['identify', *bags, '--json']) == 0
    out, err = capsys.readouterr()
    assert out == expected
    assert f'chosen: needle identify {kind} {" ".join(bags)}' in err


def test_recordings_without_a_kind_are_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / 'run.csv'
    path.write_text('a,b,c\n1,2,3\n2,3,4\n')
    for words, reason in (
        ([str(path)], 'no column looks like time or force or depth or speed: name them'),
        (['nowhere.csv'], 'nowhere.csv cannot be read'),
    ):
        assert main(['identify', *words]) == 2
        out, err = capsys.readouterr()
        assert not out
        assert reason in err
        assert len(err.strip().splitlines()) == 1
