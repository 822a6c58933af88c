# SPDX-License-Identifier: Apache-2.0
"""Robot description: valid URDF, existing files, and agreement with the plant."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import product
from math import cos, sin
from pathlib import Path
import runpy
import struct
from typing import Any
import xml.etree.ElementTree as ET

from needle_dynamics import FloatArray, NeedleParameters, NEEDLES
from needle_dynamics.simulated.assembly import PlantSettings
from needle_dynamics.simulated.base import BaseParameters
from needle_dynamics.simulated.run import PlantRun
from needle_dynamics.simulated.steered import GuideParameters
from needle_ros.contract import (
    BASE,
    ENTRY,
    INSERTION,
    JOINT_COMMANDS,
    JOINT_STATES,
    steered_states,
    TIP,
)
from needle_ros.wire import Reading
import numpy as np
import pytest
import xacro
import yaml

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / 'description'
CONTROLLERS = yaml.safe_load((ROOT / 'config/ros2_control.yaml').read_text(encoding='utf-8'))
MAKER = runpy.run_path(str(FOLDER / 'make_meshes.py'))
KINDS = [*product(('simulation', 'robot'), (False, True))]
Point = tuple[float, float, float]


def described(mode: str, steered: bool, **others: object) -> ET.Element:
    """Return the URDF generated like in the launch file."""
    given = {'mode': mode, 'steered': str(steered).lower(), **others}
    file = str(FOLDER / 'needle_insertion.urdf.xacro')
    made = xacro.process_file(file, mappings={name: str(value) for name, value in given.items()})
    return ET.fromstring(made.toxml())  # noqa: S314


def numbers(text: str) -> FloatArray:
    return np.array([float(word) for word in text.split()])


def movable(urdf: ET.Element) -> dict[str, ET.Element]:
    """Return the joints required in `joint_states`, by name."""
    joints = {joint.get('name'): joint for joint in urdf.iter('joint') if joint.get('type')}
    return {name: joint for name, joint in joints.items() if joint.find('mimic') is None}


def turn(axis: FloatArray, angle: float) -> FloatArray:
    """Return the rotation matrix about a unit axis."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + sin(angle) * cross + (1.0 - cos(angle)) * cross @ cross)


def pose(urdf: ET.Element, link: str, at: dict[str, float]) -> tuple[FloatArray, FloatArray]:
    """Return position and rotation of a link in `needle_entry`."""
    joints = {j.find('child').get('link'): j for j in urdf.iter('joint') if j.get('type')}
    if link not in joints:
        assert link == ENTRY
        return np.zeros(3), np.eye(3)
    joint = joints[link]
    place, turned = pose(urdf, joint.find('parent').get('link'), at)
    origin, axis = joint.find('origin'), numbers(joint.find('axis').get('xyz'))
    if origin is not None:
        place = place + turned @ numbers(origin.get('xyz'))
    mimic = joint.find('mimic')
    value = at[joint.get('name') if mimic is None else mimic.get('joint')]
    value *= 1.0 if mimic is None else float(mimic.get('multiplier'))
    if joint.get('type') == 'prismatic':
        return place + value * turned @ axis, turned
    return place, turned @ turn(axis, value)


@pytest.mark.parametrize(('mode', 'steered'), KINDS)
def test_urdf_joints_equal_joint_states(mode: str, steered: bool) -> None:
    """A missing joint would break the tree of robot_state_publisher."""
    urdf = described(mode, steered)
    states = steered_states() if steered else JOINT_STATES
    joints = movable(urdf)
    assert sorted(joints) == sorted(joint.name for joint in states.joints)
    units = {'prismatic': 'm', 'revolute': 'rad', 'continuous': 'rad'}
    assert {name: units[joint.get('type')] for name, joint in joints.items()} == {
        joint.name: joint.unit for joint in states.joints
    }
    links = Counter(link.get('name') for link in urdf.findall('link'))
    assert set(links.values()) == {1}
    assert {ENTRY, BASE} <= links.keys()
    # A frame has one parent: the plant publishes the tip frame.
    assert TIP not in links
    for link in links:
        pose(urdf, link, dict.fromkeys(joints, 0.0))


@pytest.mark.parametrize('preset', NEEDLES)
@pytest.mark.parametrize(('mode', 'steered'), KINDS)
def test_urdf_limits_equal_plant_limits(mode: str, steered: bool, preset: str) -> None:
    needle, steering, _ = NEEDLES[preset]
    free = steering.free_length
    lengths = {'length': needle.length, 'minimum_depth': needle.minimum_depth, 'free_length': free}
    joints = movable(described(mode, steered, **lengths))
    limits = {
        name: {key: float(value) for key, value in joint.find('limit').attrib.items()}
        for name, joint in joints.items()
    }
    own, base, guide = PlantSettings(), BaseParameters(), GuideParameters()
    low, high = needle.minimum_depth, needle.length
    if steered:
        high -= free + needle.minimum_depth
    insertion = limits.pop(INSERTION)
    assert insertion == {
        'lower': pytest.approx(low),
        'upper': pytest.approx(high),
        'velocity': base.speed_limit,
        'effort': own.force_limit,
    }
    if not steered:
        assert limits['rotation']['effort'] == own.torque_limit
        return
    # The plant accepts positions within the limits, and rejects positions beyond them.
    plant = PlantRun({'mode': mode, 'steered': True, 'needle': preset, 'depth': 0.05})
    plant.take(10**9)
    for name, limit in limits.items():
        assert limit['lower'] == -limit['upper']
        for share in (1.0, -1.0, 1.001, -1.001):
            reading = Reading(10**9, '', (name,), ((share * limit['upper'],), (), ()))
            _, complaint = plant.command_joints(reading, 10**9)
            assert bool(complaint) == (abs(share) > 1.0), complaint
    speeds = {name: limit['velocity'] for name, limit in limits.items()}
    assert speeds == {
        'guide_x': guide.speed_limit,
        'guide_z': guide.speed_limit,
        'guide_tilt_x': guide.tilt_speed_limit,
        'guide_tilt_z': guide.tilt_speed_limit,
        'roll': guide.roll_speed_limit,
    }


#: Mass of links that have none in the model [kg].
LIGHT = 1e-6


def inertia(link: ET.Element) -> tuple[float, FloatArray, FloatArray]:
    """Return mass, center of mass and inertia matrix of a link."""
    found = link.find('inertial')
    values = {key: float(value) for key, value in found.find('inertia').attrib.items()}
    matrix = np.array([[values[''.join(('i', *sorted(a + b)))] for b in 'xyz'] for a in 'xyz'])
    center = numbers(found.find('origin').get('xyz'))
    return float(found.find('mass').get('value')), center, matrix


@pytest.mark.parametrize('carriage', [0.0, 0.7])
@pytest.mark.parametrize('steered', [False, True])
def test_urdf_masses_equal_the_model(steered: bool, carriage: float) -> None:
    """Each moved link has a mass; those that the insertion moves have the mass of the model."""
    needle = replace(NeedleParameters(), carriage_mass=carriage, length=0.25)
    names = ('length', 'density', 'area', 'area_moment', 'rotary_inertia', 'carriage_mass')
    urdf = described('robot', steered, **{name: getattr(needle, name) for name in names})
    links = {link.get('name'): link for link in urdf.findall('link')}
    assert links.pop(ENTRY).find('inertial') is None
    bodies = {name: inertia(link) for name, link in links.items()}
    for mass, _, matrix in bodies.values():
        moments = np.sort(np.linalg.eigvalsh(matrix))
        assert mass > 0.0
        # Of a body with a positive mass everywhere.
        assert moments[0] > 0.0
        assert moments[2] <= moments[0] + moments[1]
    moved = [BASE, *(['needle_carriage', 'needle_hub'] if steered else ['needle_clamp'])]
    total = sum(bodies[name][0] for name in moved)
    assert total == pytest.approx(needle.moving_mass, abs=2.1 * LIGHT)
    if not steered:
        clamp = bodies['needle_clamp'][2]
        np.testing.assert_allclose(np.diag(clamp), needle.rotary_inertia)
    # About the base: slices of the needle, and a cube.
    rod = needle.moving_mass - carriage
    along = (np.arange(10_000) + 0.5) / 10_000 * needle.length
    second = {
        'rod': float(rod * np.mean(along**2)),
        # Edges of 3 cm, centered 3 cm behind the base.
        'block': carriage * (0.03**2 / 6.0 + 0.03**2),
    }
    held = {BASE: ('rod', 'block')} if not steered else {
        'needle_hub': ('rod',), 'needle_carriage': ('block',),
    }  # fmt: skip
    for name, parts in held.items():
        mass, center, matrix = bodies[name]
        expected = sum(second[part] for part in parts)
        if expected:
            about_base = matrix[0, 0] + mass * center[1] ** 2
            # The slices have an error of 1e-8.
            assert about_base == pytest.approx(expected, rel=1e-6)
            assert matrix[2, 2] == matrix[0, 0]


@pytest.mark.parametrize('steered', [False, True])
def test_collision_bodies_equal_the_drawn_bodies(steered: bool) -> None:
    """Within 0.1 mm: the needle has the area of the model."""
    for link in described('robot', steered).findall('link'):
        drawn, solid = (np.array([np.inf, -np.inf])[:, None] * np.ones(3) for _ in range(2))
        for kind, extent in (('visual', drawn), ('collision', solid)):
            for body in link.iter(kind):
                low, high = box_of(body)
                extent[0] = np.minimum(extent[0], low)
                extent[1] = np.maximum(extent[1], high)
        assert np.isfinite(drawn).all() == np.isfinite(solid).all()
        if np.isfinite(drawn).all():
            np.testing.assert_allclose(solid, drawn, atol=1e-4)


def box_of(body: ET.Element) -> tuple[FloatArray, FloatArray]:
    """Return the lowest and highest corner of a visual or a collision body in its link [m]."""
    origin, (geometry,) = body.find('origin'), body.find('geometry')
    at = np.zeros(3) if origin is None else numbers(origin.get('xyz'))
    if geometry.tag == 'mesh':
        data = (FOLDER / 'meshes' / Path(geometry.get('filename')).name).read_bytes()
        (count,) = struct.unpack_from('<I', data, 80)
        corners = np.array(
            [struct.unpack_from('<9f', data, 84 + 50 * k + 12) for k in range(count)]
        ).reshape(-1, 3) * numbers(geometry.get('scale', '1 1 1'))
        return at + corners.min(axis=0), at + corners.max(axis=0)
    if geometry.tag == 'box':
        half = numbers(geometry.get('size')) / 2.0
    else:
        # The axis of a cylinder is z, here rotated to y.
        assert numbers(origin.get('rpy')) == pytest.approx([-np.pi / 2.0, 0.0, 0.0])
        radius = float(geometry.get('radius'))
        half = np.array([radius, float(geometry.get('length')) / 2.0, radius])
    return at - half, at + half


def test_urdf_base_position_equals_the_model() -> None:
    """At y = s - l, parallel to the entry frame."""
    urdf = described('simulation', False, length=0.25)
    for depth in (0.001, 0.02, 0.2):
        place, turned = pose(urdf, BASE, {INSERTION: depth, 'rotation': 1.0})
        np.testing.assert_allclose(place, [0.0, depth - 0.25, 0.0], atol=1e-15)
        np.testing.assert_array_equal(turned, np.eye(3))
        plant = PlantRun({'needle': 'phantom', 'model.length': 0.25, 'depth': depth})
        np.testing.assert_allclose(place, plant.plant.outline().base, atol=1e-15)


def test_steered_urdf_base_position_equals_the_plant() -> None:
    """The plant linearizes the tilts, the URDF rotates."""
    preset, depth = 'bending_35mm', 0.06
    free = NEEDLES[preset].steering.free_length
    urdf = described('robot', True, free_length=free)
    plant = PlantRun({'mode': 'robot', 'steered': True, 'needle': preset, 'depth': depth})
    goals = {'guide_x': 2e-3, 'guide_z': -1e-3, 'guide_tilt_x': 0.02, 'guide_tilt_z': -0.03}
    plant.take(10**9)
    reading = Reading(10**9, '', tuple(goals), (tuple(goals.values()), (), ()))
    assert plant.command_joints(reading, 10**9) == (True, '')
    for k in range(1, 1500):
        (*_, (_, _, values)) = plant.take(10**9 + k * 10**6)
    states = steered_states().joints
    at = {joint.name: value for joint, value in zip(states, values, strict=False)}
    assert {name: at[name] for name in goals} == pytest.approx(goals, abs=1e-7)
    place, turned = pose(urdf, BASE, at)
    np.testing.assert_allclose(turned, np.eye(3), atol=1e-15)
    # 0.1 m behind the guide: an error of half the square of the tilt, and less laterally.
    np.testing.assert_allclose(place, plant.plant.outline().base, atol=0.1 * 0.5 * 0.05**2)
    guide, tilted = pose(urdf, 'needle_guide', at)
    points = plant.plant.outline()
    np.testing.assert_allclose(guide, points.points[0], atol=1e-8)
    # A tilt is a slope: positive toward positive x and z.
    slope = tilted[:, 1] / tilted[1, 1]
    np.testing.assert_allclose(slope[[0, 2]], points.slopes[0], rtol=1e-2)


def test_tip_frame_equals_the_last_needle_pose() -> None:
    """In the base frame; the rotation aligns y with the needle."""
    values = {'needle': 'phantom', 'depth': 0.12, 'tip_deflection': 5e-3}
    outline = PlantRun(values).plant.outline()
    place, (i, j, k, w) = outline.tip
    np.testing.assert_allclose(outline.base + place, outline.points[-1], atol=1e-15)
    np.testing.assert_allclose(place, [0.0, 0.2, 5e-3], atol=1e-12)
    assert i * i + j * j + k * k + w * w == pytest.approx(1.0)
    # Rotated y axis: direction of the needle at its tip.
    along = [2.0 * (i * j - w * k), 1.0 - 2.0 * (i * i + k * k), 2.0 * (j * k + w * i)]
    x, z = outline.slopes[-1]
    np.testing.assert_allclose(along, np.array([x, 1.0, z]) / np.sqrt(1.0 + x * x + z * z))
    assert z > 0.0


@pytest.mark.parametrize(('mode', 'steered'), KINDS)
def test_plant_accepts_messages_of_the_described_hardware(mode: str, steered: bool) -> None:
    """Topics are set, messages are always sent, and arrays have no gaps."""
    (system,) = described(mode, steered).findall('ros2_control')
    hardware = system.find('hardware')
    assert hardware.findtext('plugin') == (
        'joint_state_topic_hardware_interface/JointStateTopicSystem'
    )
    assert {param.get('name'): param.text for param in hardware.iter('param')} == {
        'joint_commands_topic': JOINT_COMMANDS.name,
        'joint_states_topic': JOINT_STATES.name,
        'trigger_joint_command_threshold': '-1',
    }
    commanded = {
        joint.get('name'): [item.get('name') for item in joint.iter('command_interface')]
        for joint in system.iter('joint')
    }
    (interfaces,) = {tuple(names) for names in commanded.values()}
    expected = {
        ('simulation', False): ('effort',),
        ('simulation', True): ('position', 'effort'),
        ('robot', False): ('position',),
        ('robot', True): ('position',),
    }
    assert interfaces == expected[mode, steered]
    for joint in system.iter('joint'):
        states = [item.get('name') for item in joint.iter('state_interface')]
        assert states == ['position', 'velocity', 'effort']
    # Message before a controller is active, at rest, without a force.
    plant = PlantRun({'mode': mode, 'steered': steered, 'needle': 'bending_35mm'})
    names = tuple(commanded)
    sent = [
        tuple([np.nan] * len(names)) if k in interfaces else () for k in ('position', 'effort')
    ]
    reading = Reading(10**9, '', names, (sent[0], (), sent[1]))
    assert plant.command_joints(reading, 10**9) == (True, '')


@pytest.mark.parametrize(('mode', 'steered'), KINDS)
def test_controllers_claim_existing_interfaces(mode: str, steered: bool) -> None:
    """For the controllers that the launch file starts in each mode."""
    launch = (ROOT / 'launch/ros2_control.launch.py').read_text(encoding='utf-8')
    space: dict[str, Any] = {}
    begin = launch.index('def spawned')
    exec(launch[begin : launch.index('\n\n\n', begin)], space)  # noqa: S102
    active, ready = space['spawned'](mode, steered=steered)
    manager = CONTROLLERS['/**/controller_manager']['ros__parameters']
    assert manager['update_rate'] >= 20
    (system,) = described(mode, steered).findall('ros2_control')
    offered = {
        f'{joint.get("name")}/{item.get("name")}'
        for joint in system.iter('joint')
        for item in joint.iter('command_interface')
    }
    claimed: list[str] = []
    for name in [*active, *ready]:
        own = CONTROLLERS[f'/**/{name}']['ros__parameters']
        assert manager[name]['type'].partition('/')[0] in (
            'joint_trajectory_controller', 'effort_controllers',
        )  # fmt: skip
        claims = [
            f'{joint}/{kind}'
            for joint in own['joints']
            for kind in own.get('command_interfaces', ['effort'])
        ]
        assert set(claims) <= offered
        claimed += claims if name in active else []
    # Two active controllers cannot claim the same interface.
    assert len(claimed) == len({*claimed})


def test_meshes_equal_the_script_output_and_are_used() -> None:
    """The script output is identical byte for byte."""
    files = {path.stem: path.read_bytes() for path in (FOLDER / 'meshes').iterdir()}
    assert files == {name: MAKER['stl'](make()) for name, make in MAKER['MESHES'].items()}
    used = {mesh.get('filename') for kind in KINDS for mesh in described(*kind).iter('mesh')}
    assert used == {f'package://needle_insertion/description/meshes/{name}.stl' for name in files}
    assert max(map(len, files.values())) < 10_000


@pytest.mark.parametrize('name', MAKER['MESHES'])
def test_mesh_is_closed_and_oriented_outwards(name: str) -> None:
    """Two triangles share each edge in opposite directions; the volume is positive."""
    data = (FOLDER / f'meshes/{name}.stl').read_bytes()
    (count,) = struct.unpack_from('<I', data, 80)
    assert len(data) == 84 + 50 * count
    edges: Counter[tuple[Point, Point]] = Counter()
    volume = 0.0
    for k in range(count):
        found = np.array(struct.unpack_from('<9f', data, 84 + 50 * k + 12)).reshape(3, 3)
        a, b, c = (tuple(row.tolist()) for row in found)
        edges.update([(a, b), (b, c), (c, a)])
        volume += np.linalg.det(found) / 6.0
    assert edges == Counter({(b, a): number for (a, b), number in edges.items()})
    assert volume > 0.0
