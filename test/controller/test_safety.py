# SPDX-License-Identifier: Apache-2.0
"""Input monitor, limits and the latched stop."""

from math import inf, nan
from typing import Any

from needle_controller import ControllerSettings, Measurement, SafetyLimits
from needle_controller.safety.input_monitor import InputMonitor
from needle_controller.safety.safety import Guard, Safety
from needle_dynamics import NeedleParameters, ParameterError
from needle_ros.wire import Reading
import numpy as np
import pytest

SECOND = 1_000_000_000

#: No force or torque.
NONE = (0.0, 0.0, 0.0)
MILLISECOND = SECOND // 1000


def stream(**options: Any) -> InputMonitor:
    """Return the stream of a force sensor at 1 kHz."""
    return InputMonitor('base_wrench', 0.5, **options)


def safety(expected: tuple[str, ...] = (), **limits: Any) -> Safety:
    """Return the safety checks of a phantom needle, begun at 10 s."""
    whole = Safety(
        SafetyLimits(**limits), ControllerSettings(), NeedleParameters(), expected=expected
    )
    whole.begin(10 * SECOND)
    return whole


@pytest.mark.requirement('S-046', 'S-047')
@pytest.mark.parametrize(
    ('stamp', 'kind', 'words'),
    [
        (10 * SECOND, None, ''),
        (int(9.6 * SECOND), None, ''),
        (int(9.4 * SECOND), 'stale', 'base_wrench is stale: its stamp is 0.600 s old'),
        (11 * SECOND, 'stale', 'its stamp is 1.000 s ahead'),
        (0, 'not stamped', 'base_wrench is stale: it is not stamped'),
    ],
)
def test_stale_future_and_missing_stamps_are_rejected(
    stamp: int, kind: str | None, words: str
) -> None:
    """Each is counted by its kind."""
    wrench = stream()
    refusal = wrench.check(stamp, 10 * SECOND)
    assert (refusal.kind if refusal else None) == kind
    assert words in (refusal.line if refusal else '')
    assert wrench.counts[kind or 'accepted'] == 1


@pytest.mark.requirement('S-060')
def test_zero_stamps_are_valid_at_time_zero() -> None:
    """The first sample of a simulation has a stamp of zero, and is not unstamped."""
    wrench = stream()
    assert wrench.check(0, 0) is None
    assert wrench.check(0, 0).kind == 'repeated'
    assert wrench.check(MILLISECOND, MILLISECOND) is None


@pytest.mark.requirement('S-051', 'S-052')
def test_repeated_and_out_of_order_messages_are_discarded() -> None:
    """A repeated or late message is discarded, and is no fault."""
    wrench = stream()
    stamps = [1, 2, 2, 4, 3, 5]
    kinds = [wrench.check(10 * SECOND + s, 10 * SECOND) for s in stamps]
    assert [r.kind if r else '' for r in kinds] == ['', '', 'repeated', '', 'dropped', '']
    # A clock that was set back restarts the stream.
    wrench.forget()
    assert wrench.check(5 * SECOND, 5 * SECOND) is None
    status = wrench.status(5 * SECOND)
    assert (status.accepted, status.repeated, status.out_of_order) == (5, 1, 1)
    assert (status.rejected, status.age) == ({}, 0.0)


@pytest.mark.requirement('S-053', 'S-054')
def test_wrong_frames_and_non_finite_values_are_rejected() -> None:
    """With the received frame and values."""
    wrench = stream(frames=('needle_base',))
    now = 10 * SECOND
    refusal = wrench.check(now, now, 'world', [1.0])
    assert refusal.line == "base_wrench must be in frame 'needle_base', got 'world'"
    for i, value in enumerate((nan, inf, -inf)):
        assert wrench.check(now + i + 1, now, 'needle_base', [0.0, value]).kind == 'not finite'
    assert wrench.check(now + 9, now, 'needle_base', [0.0, 1.0]) is None
    assert wrench.status(now).rejected == {'frame': 1, 'not finite': 3}


def feed(watched: InputMonitor, readings: list[Any]) -> list[str]:
    """Return the verdicts on readings at 1 kHz from 10 s on, '' for valid readings."""
    kinds = []
    for i, value in enumerate(readings):
        now = 10 * SECOND + i * MILLISECOND
        refusal = watched.check(now, now, '', [value])
        kinds.append(refusal.kind if refusal else '')
    return kinds


@pytest.mark.requirement('S-055', 'S-061')
def test_first_reading_after_a_jump_is_rejected() -> None:
    """Both edges of a spike are rejected; a step is valid from its second reading on."""
    assert feed(stream(jumps=[1.0]), [0, 0, 9, 0, 0]) == ['', '', 'jump', 'jump', '']
    assert feed(stream(jumps=[1.0]), [0, 9, 9, 9]) == ['', 'jump', '', '']
    assert feed(stream(jumps=[1.0]), [0, 0.9, 1.8]) == [''] * 3


@pytest.mark.requirement('S-056')
def test_constant_readings_of_a_noisy_sensor_are_frozen() -> None:
    """After the timeout of 0.5 s they are rejected until a change."""
    rng = np.random.default_rng(1)
    noisy = [*rng.normal(0.0, 0.01, 100)]
    wrench = stream(noise=[0.01])
    kinds = feed(wrench, [*noisy, *[noisy[-1]] * 700])
    assert set(kinds[:600]) == {''}
    assert set(kinds[600:]) == {'frozen'}
    assert wrench.frozen
    last = 10 * SECOND + SECOND
    assert wrench.check(last, last, '', [0.02]) is None
    assert not wrench.frozen


@pytest.mark.requirement('S-056')
@pytest.mark.parametrize(
    'readings',
    [[0.0] * 2000, [0.1 * 0.9**i if i < 300 else 0.0 for i in range(2000)]],
    ids=['still from the start', 'stops'],
)
def test_constant_readings_of_a_noise_free_sensor_are_valid(readings: list[float]) -> None:
    """A perfect sensor at rest is not frozen."""
    assert set(feed(stream(noise=[0.01]), readings)) == {''}


def encoded(depth: float, speed: float, angle: float = 0.0, rate: float = 0.0) -> Measurement:
    """Return a sample of the encoders."""
    return Measurement(time=0.0, depth=depth, velocity=speed, angle=angle, angular_velocity=rate)


GUARD = [
    (
        'encoders',
        (encoded(0.05, 0.11),),
        'insertion speed 0.11 m/s is beyond the limit of 0.1 m/s',
    ),
    ('encoders', (encoded(0.05, -0.11),), 'insertion speed -0.11 m/s'),
    ('encoders', (encoded(0.0025, nan),), 'insertion speed nan m/s'),
    ('encoders', (encoded(0.103, 0.0),), 'insertion depth 0.103 m is outside [-0.001, 0.102] m'),
    ('encoders', (encoded(-0.002, 0.0),), 'insertion depth -0.002 m'),
    ('encoders', (encoded(0.05, 0.0, 1001.0),), 'angle 1001 rad'),
    ('encoders', (encoded(0.05, 0.0, 0.0, -101.0),), 'angular speed -101 rad/s'),
    ('tracking', (0.011,), 'tracking error 0.011 m is beyond the limit of 0.01 m'),
    ('wrench', ((0.0, -31.0, 0.0), NONE), 'axial force -31 N is beyond the limit of 30 N'),
    ('wrench', ((6.3, 0.0, -8.4), NONE), 'lateral force 10.5 N'),
    ('wrench', (NONE, (-0.66, 0.0, 0.88)), 'moment 1.1 N m'),
    ('wrench', (NONE, (0.0, -1.1, 0.0)), 'torque about the needle -1.1 N m'),
    ('tip', (-0.051,), 'tip deflection 0.051 m is beyond the limit of 0.05 m'),
]


@pytest.mark.requirement('S-025', 'S-026', 'S-027', 'S-028', 'S-036')
@pytest.mark.parametrize(('name', 'values', 'words'), GUARD)
def test_two_readings_beyond_a_limit_violate_it(
    name: str, values: tuple[Any, ...], words: str
) -> None:
    """Quantity, value, limit and unit in one line; a single reading does not violate it."""
    guard = Guard(SafetyLimits(), (0.001, 0.1))
    good = {'encoders': (encoded(0.05, 0.0),), 'wrench': (NONE, NONE)}.get(name, (0.0,))
    hold = getattr(guard, name)
    assert [hold(*v) for v in (good, values, good, values)] == [None] * 4
    line = hold(*values)
    assert words in line
    assert '\n' not in line
    assert guard.violated == line
    assert hold(*good) is None
    assert guard.violated is None


@pytest.mark.requirement('S-025')
def test_readings_at_a_limit_are_within_it() -> None:
    """Limits are the largest valid values."""
    guard, limits = Guard(SafetyLimits(), (0.001, 0.1)), SafetyLimits()
    for _ in range(3):
        edge = Measurement(
            time=0.0,
            depth=0.1 + limits.depth_tolerance,
            velocity=limits.speed,
            angle=limits.angle,
            angular_velocity=-limits.angular_speed,
        )
        assert guard.encoders(edge) is None
        assert (
            guard.wrench(
                (0.0, -limits.axial_load, limits.lateral_load),
                (limits.moment_load, limits.torsion_load, 0.0),
            )
            is None
        )
        assert guard.tip(limits.tip_deflection) is None
        assert guard.tracking(-limits.tracking_error) is None


@pytest.mark.requirement('S-041')
def test_stop_cannot_be_cleared_beyond_a_limit() -> None:
    """The first reason stays; clearing is rejected with the limit that is still exceeded."""
    whole = safety()
    now = 10 * SECOND
    for _ in range(2):
        whole.streams['base_wrench'].check(now, now, 'needle_base', [0.0, 0.0])
        reason = whole.guard.wrench((0.0, 40.0, 0.0), (0.0, 0.0, 0.0))
    assert reason is not None
    whole.latch(reason)
    whole.latch('emergency stop')
    assert whole.stop == reason
    assert 'axial force 40 N' in whole.clear(now)
    assert whole.stop is not None
    whole.guard.wrench((0.0, 1.0, 0.0), (0.0, 0.0, 0.0))
    assert whole.clear(now) is None
    assert (whole.stop, whole.stops) == (None, 1)


@pytest.mark.requirement('S-042')
def test_silent_sensor_does_not_block_clearing_the_stop() -> None:
    """Its last reading is outdated."""
    whole = safety()
    now = 10 * SECOND
    whole.streams['base_wrench'].check(now, now, 'needle_base', [0.0, 0.0])
    whole.guard.wrench((0.0, 40.0, 0.0), (0.0, 0.0, 0.0))
    whole.latch('emergency stop')
    assert whole.clear(now + SECOND // 2) is not None
    assert whole.clear(now + 2 * SECOND) is None


@pytest.mark.requirement('S-042')
def test_discarded_reference_does_not_block_clearing_the_stop() -> None:
    """The motion restarts from the measured depth."""
    whole = safety()
    whole.guard.tracking(0.02)
    reason = whole.guard.tracking(0.02)
    assert reason is not None
    whole.latch(reason)
    assert whole.clear(10 * SECOND) is None


@pytest.mark.requirement('S-073')
def test_silent_sensors_give_a_warning_while_encoders_are_received() -> None:
    """Logged once, shown until the sensor is back, and not before the plant starts."""
    whole = safety(expected=('base_wrench',), sensor_timeout=0.5)
    joints, wrench = (whole.streams[name] for name in ('joint_states', 'base_wrench'))
    now = 15 * SECOND
    assert whole.new_warnings(now) == {}
    assert whole.warning(now) is None
    said: list[str] = []
    for i in range(2000):
        now += MILLISECOND
        joints.check(now, now)
        if i < 1000:
            wrench.check(now, now, 'needle_base', [0.0, 0.0])
        said += whole.new_warnings(now).values()
    assert said == ['base_wrench is stale: no valid message for 0.501 s']
    assert whole.warning(now) == 'base_wrench is stale: no valid message for 1.000 s'
    now += MILLISECOND
    wrench.check(now, now, 'needle_base', [0.0, 0.0])
    assert whole.warning(now) is None
    # No warnings without a plant.
    assert whole.new_warnings(now + 9 * SECOND) == {}


@pytest.mark.requirement('S-330')
@pytest.mark.parametrize('name', ['base_wrench', 'tip_deflection'])
@pytest.mark.parametrize('required', [False, True])
def test_rejected_sensor_gives_a_warning_also_if_it_is_not_expected(
    name: str, required: bool
) -> None:
    """With the reason, as long as every reading is rejected; required: also without readings."""
    whole = safety(sensor_timeout=0.5, sensors_required=required)
    joints, sensor = whole.streams['joint_states'], whole.streams[name]
    frames = {'base_wrench': 'needle_base', 'tip_deflection': 'needle_entry'}
    wrench = whole.streams['base_wrench']
    now, said = 10 * SECOND, list[str]()

    def go_on(seconds: float, frame: str | None) -> str | None:
        nonlocal now
        for _ in range(round(100 * seconds)):
            now += 10 * MILLISECOND
            joints.check(now, now)
            if required and sensor is not wrench:
                wrench.check(now, now, 'needle_base', [0.0, 0.0])
            if frame is not None:
                sensor.check(now, now, frame, [0.0])
            said.extend(whole.new_warnings(now).values())
        return whole.warning(now)

    reason = f"{name} must be in frame '{frames[name]}', got 'other'"
    assert go_on(0.4, None) is None
    assert str(go_on(2.0, 'other')).endswith(reason)
    assert whole.missing(now) == (whole.warning(now) if required else None)
    assert len(said) == 1
    assert go_on(0.1, frames[name]) is None
    silent = go_on(3.0, None)
    assert silent == (
        f'{name} is stale: no valid message for 3.000 s'
        if required and name == 'base_wrench'
        else None
    )


@pytest.mark.requirement('S-073')
def test_silence_is_measured_from_the_first_clock_message() -> None:
    """A node with simulated time is at 0 before the first /clock."""
    whole = safety(expected=('base_wrench',), sensor_timeout=0.5)
    whole.begin(0)
    assert whole.new_warnings(0) == {}
    now = 1_795_193_306 * SECOND
    whole.streams['joint_states'].check(now, now)
    assert whole.new_warnings(now) == {}


@pytest.mark.requirement('S-073')
def test_stop_for_missing_sensors_stays_until_they_are_back() -> None:
    """With `sensors_required` clearing is rejected until then."""
    whole = safety(expected=('base_wrench',), sensor_timeout=0.5, sensors_required=True)
    joints, wrench = (whole.streams[name] for name in ('joint_states', 'base_wrench'))
    now = 11 * SECOND
    whole.begin(now)
    joints.check(now, now)
    wrench.check(now, now, 'needle_base', [0.0, 0.0])
    later = now + SECOND
    joints.check(later, later)
    reason = whole.warning(later)
    assert reason is not None
    whole.latch(reason)
    assert 'base_wrench is stale' in whole.clear(later)
    wrench.check(later, later, 'needle_base', [0.0, 0.0])
    assert whole.clear(later) is None


@pytest.mark.requirement('S-079', 'S-163')
def test_duplicate_publishers_of_commands_are_reported() -> None:
    """Each topic with more than one publisher, until there is one again."""
    whole = safety()
    whole.count_publishers({'wrench_command': 2})
    assert whole.duplicate_publishers == '2 nodes publish wrench_command'
    whole.count_publishers({'wrench_command': 1})
    assert whole.duplicate_publishers is None


@pytest.mark.requirement('S-049', 'S-081', 'S-163')
def test_sensor_with_two_publishers_is_rejected() -> None:
    """No force with duplicate encoders; after the duplicate ends, the sensor is valid again."""
    whole, now = safety(), 5 * SECOND
    whole.count_publishers({'joint_states': 2, 'base_wrench': 3})
    assert whole.duplicate_publishers == '2 nodes publish joint_states'
    for name, count in (('joint_states', 2), ('base_wrench', 3)):
        refusal = whole.streams[name].check(now, now, 'needle_base')
        assert refusal is not None
        assert (refusal.kind, refusal.line) == ('disputed', f'{count} nodes publish {name}')
    whole.count_publishers({'joint_states': 1, 'base_wrench': 2})
    assert whole.duplicate_publishers is None
    # Messages of the other publisher have no effect.
    assert whole.streams['joint_states'].check(now - SECOND // 100, now) is None


@pytest.mark.requirement('S-048')
@pytest.mark.parametrize('name', ['joint_states', 'ground_truth', 'base_wrench', 'tip_deflection'])
def test_stamp_may_be_one_period_in_the_future(name: str) -> None:
    """A larger lead is rejected: the stamps of the true source would be late."""
    whole, now = safety(), 5 * SECOND
    stream, frame = whole.streams[name], 'needle_entry' if name[0] == 't' else 'needle_base'
    period = round(SECOND / ControllerSettings().rate)
    refusal = stream.check(now + 2 * period, now, frame)
    assert refusal is not None
    assert refusal.line == f'{name} is stale: its stamp is 0.002 s ahead'
    assert stream.check(now + period, now, frame) is None
    assert stream.check(now + period + 1, now, frame) is None


@pytest.mark.requirement('S-050')
def test_out_of_order_encoders_stop_the_motion() -> None:
    """A stop above 90 % of out-of-order messages, a warning above 50 %; none at low rates."""
    for late, warned, stopped in ((4, False, False), (6, True, False), (19, True, True)):
        whole, now = safety(), 5 * SECOND
        stream = whole.streams['joint_states']
        for k in range(2000):
            now += SECOND // 1000
            stream.check(now if k % (late + 1) == 0 else now - SECOND // 50, now)
        share = late / (late + 1)
        assert (stream.window.share(now) > 0.5) == (share > 0.5)
        said = f'joint_states has {stream.window.share(now):.0%} of its messages out of order'
        assert whole.warning(now) == (said if warned or share > 0.5 else None)
        assert whole.mixed_sources(now) == (said if stopped else None)


@pytest.mark.requirement('S-019')
@pytest.mark.parametrize(
    ('change', 'reason'),
    [
        ({'speed': 0.0}, 'speed must be finite, > 0 m/s'),
        ({'axial_load': inf}, 'axial_load must be finite, > 0 N'),
        ({'tip_jump': nan}, 'tip_jump must be finite'),
        ({'sensors_required': 1}, 'sensors_required must be true or false, got 1'),
    ],
)
def test_limits_must_be_finite(change: dict[str, Any], reason: str) -> None:
    """No limit can be switched off."""
    with pytest.raises(ParameterError, match=reason):
        SafetyLimits(**change)


def joints(names: list[str], positions: list[float], speeds: list[float]) -> Reading:
    """Return a joint state of 1 s."""
    return Reading(SECOND, '', tuple(names), (tuple(positions), tuple(speeds), ()))


@pytest.mark.requirement('S-054')
def test_encoders_are_read_by_name() -> None:
    """In any order, with or without the rotation."""
    both = Measurement.from_reading(joints(['rotation', 'insertion'], [0.1, 0.02], [0.2, 0.01]))
    assert both == Measurement(
        time=1.0, depth=0.02, velocity=0.01, angle=0.1, angular_velocity=0.2
    )
    assert Measurement.from_reading(joints(['insertion'], [0.02], [0.01])).angle == 0.0


@pytest.mark.requirement('S-054', 'S-071')
@pytest.mark.parametrize(
    ('names', 'positions', 'speeds'),
    [
        ([], [], []),
        (['insertion'], [], [0.0]),
        (['insertion'], [0.02], []),
        (['insertion', 'rotation'], [0.02, 0.0], [0.0]),
        (['elbow'], [0.02], [0.0]),
    ],
)
def test_incomplete_joint_states_are_rejected(
    names: list[str], positions: list[float], speeds: list[float]
) -> None:
    """In one line with the received names."""
    with pytest.raises(ParameterError, match=r"needs position and velocity of 'insertion', got"):
        Measurement.from_reading(joints(names, positions, speeds))
