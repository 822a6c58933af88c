# SPDX-License-Identifier: Apache-2.0
"""`needle steer`: accuracy, expected tip, and errors of invalid input."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from matplotlib.image import imread
from needle_controller import SteeringPrior
from needle_controller.steering.simulation import GroundTruth, SteppedTipErrors, SteppedTipSensor
from needle_dynamics import DEFAULT_NEEDLE, find_needle, NEEDLES
from needle_insertion.cli import main
from needle_insertion.commands import steer
import numpy as np
import pytest

IMAGES = Path(__file__).parents[2] / 'docs' / 'images'


def steered(capsys: pytest.CaptureFixture[str], *words: str, status: int = 0) -> tuple[Any, str]:
    """Run the command; return its JSON, if it succeeds, and stderr."""
    assert main(['steer', '--json', *words]) == status
    said = capsys.readouterr()
    return (json.loads(said.out) if status == 0 else None), said.err


def test_steering_hits_where_open_loop_misses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Open loop misses by millimeters; the 95 % interval is valid, and runs are reproducible."""
    picture = tmp_path / 'steer.png'
    found, said = steered(capsys, '-o', str(picture))
    assert found['miss [m]'] < 4e-4 < 2e-3 < found['miss open loop [m]']
    assert said == ''
    off = np.array(found['tip [m]']) - found['expected tip [m]']
    # Single seed: three half-widths of the interval.
    assert (np.abs(off) < 3.0 * np.array(found['expected tip half width [m]'])).all()
    assert picture.read_bytes().startswith(b'\x89PNG')
    assert steered(capsys)[0] == found
    other, _ = steered(capsys, '--seed', '1', '--target=-0.003,0.08,0.001', '--step', '0.004')
    assert other['target [m]'] == [-0.003, 0.001]
    assert other['miss [m]'] < 4e-4
    assert main(['steer']) == 0
    assert 'open loop' in capsys.readouterr().out


def test_miss_is_smaller_without_noise(capsys: pytest.CaptureFixture[str]) -> None:
    """Without path noise and sensor noise the miss is below 0.06 mm."""
    exact = ['--prior', 'path_noise=1e-9', '--prior', 'noise=1e-7']
    found, _ = steered(capsys, *exact)
    assert found['miss [m]'] < 6e-5


def test_stepped_sensor_has_errors_in_time_and_space() -> None:
    """Without errors it reports the tip; losses are None; the field depends on the depth."""
    needle, steering, _ = find_needle(DEFAULT_NEEDLE)
    still = np.zeros(2)
    truth = GroundTruth(
        needle=needle, steering=steering, tilt=(0.0, 0.0), bevel=still, frame=still, seed=0
    )
    plant, tip = truth.plant(np.array([0.0, 0.02])), np.array([1e-3, -2e-3])

    def sensor(noise: float = 0.0, **constants: float) -> SteppedTipSensor:
        random, losses = np.random.default_rng(1), np.random.default_rng(2)
        return SteppedTipSensor(plant, noise, SteppedTipErrors(**constants), 3, random, losses)

    np.testing.assert_array_equal(sensor()(tip), tip)
    white = tip + 1e-4 * np.random.default_rng(1).standard_normal(2)
    np.testing.assert_array_equal(sensor(1e-4)(tip), white)
    assert sensor(dropout=1.0)(tip) is None
    slow = sensor(slow_noise=1e-3, slow_time=10.0, interval=1e-9)
    first, second = np.array([slow(tip), slow(tip)])
    # Within 1e-9 s the noise of 1 mm and 10 s changes by 14 nm; ten times that.
    np.testing.assert_allclose(first, second, rtol=0.0, atol=1.4e-7)
    assert (first != tip).all()
    field = sensor(distortion=1e-3, distortion_length=0.01)
    shallow = field(tip)
    np.testing.assert_array_equal(field(tip), shallow)
    plant.insert()
    assert (np.array(field(tip)) != shallow).all()


def test_errors_of_the_sensor_increase_the_miss(capsys: pytest.CaptureFixture[str]) -> None:
    """A field of 2 mm misleads the law; a sensor without errors is the default."""
    exact, _ = steered(capsys)
    same, _ = steered(capsys, '--sensor', 'slow_noise=0', '--sensor', 'interval=3')
    assert same == exact
    wrong, _ = steered(capsys, '--sensor', 'distortion=2mm', '--sensor', 'distortion_length=0.1')
    assert wrong['miss [m]'] > 2.0 * exact['miss [m]']
    _, said = steered(capsys, '--sensor', 'slow_nose=1mm', status=2)
    assert 'slow_nose' in said
    assert 'slow_noise' in said
    _, said = steered(capsys, '--sensor', 'slow_time=0', status=2)
    assert 'slow_time must be finite, > 0 s, got 0' in said


def test_roll_and_load_limits_take_effect(capsys: pytest.CaptureFixture[str]) -> None:
    """Roll alone compensates a bevel; the guide respects its load limit."""
    bevel = ['--set', 'bevel_load=0.8', '--prior', 'tilt=0.01', '--prior', 'frame=0.01']
    near = '--target=0.001,0.1,0.003'
    rolled, _ = steered(capsys, near, *bevel, '--turns', '6', '--limit', '0')
    assert rolled['miss [m]'] < 1.5e-3 < 5e-3 < rolled['miss open loop [m]']
    assert 1 <= rolled['turns'] <= 6
    assert rolled['guide travel [m]'] == 0.0
    free, _ = steered(capsys)
    bound, _ = steered(capsys, '--load-limit', '1')
    # The limit is for the mean of the hypotheses, before needle and tissue are identified.
    assert bound['largest load on the guide [N]'] < 1.5 < free['largest load on the guide [N]']
    assert bound['miss [m]'] < 5e-4


def test_unreachable_targets_are_rejected_or_warned_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / 'reach.png'
    _, said = steered(capsys, '--target=0.05,0.1,0', '-o', str(picture), status=1)
    # The picture shows the reachable set.
    assert picture.read_bytes().startswith(b'\x89PNG')
    assert (
        'the target x = 50.00 mm, z = 0.00 mm is out of reach: reachable on average are x ='
        in said
    )
    found, said = steered(capsys, '--target=-0.026,0.1,0')
    assert found['miss [m]'] > 1e-3
    assert found['warnings']
    assert 'warning: at a depth of' in said


@pytest.mark.parametrize(
    ('words', 'complaint'),
    [
        (['--target', '1mm,2mm'], "'1mm,2mm' is not a target: x,y,z, where y is the depth"),
        (['--target', 'a,b,c'], "'a' is not a length, such as 0.05 or 50mm"),
        (['--target=0,nan,0'], "'0,nan,0' is not a target"),
        (['--target=0,300mm,0'], 'the depth must be in (0, 160] mm'),
        (['--set', 'free_length=30'], 'free_length must be < length = 0.2 m, got 30 m'),
        (['--set', 'length=40mm'], 'free_length must be < length = 0.04 m, got 0.04 m'),
        (['--set', 'free_length=0.12'], 'the depth must be in (0, 80] mm'),
        (['--needle', 'bendin'], "got 'bendin'; did you mean bending_"),
        (['--step', '0'], '--step must be in (0, 0.1] m'),
        (['--limit', '-1'], 'guide_limit must be finite, >= 0 and <= 0.1 m'),
        (['--limit', '6'], 'guide_limit must be finite, >= 0 and <= 0.1 m, got 6'),
        (['--prior', 'spread=2'], 'spread must be finite'),
        (['--prior', 'sprad=0.1'], 'sprad'),
        (['--set', 'colour=1'], 'colour'),
        (['--set', 'cutting_force=1'], 'cutting_force'),
        (['--turns', '-1'], 'turns must be finite, >= 0, got -1'),
        (['--limit', '0'], 'guide_limit and turns cannot both be 0: nothing would move'),
        (['--load-limit', '0'], 'load_limit must be > 0 N, got 0.0'),
        (['--seed', '-1'], '--seed must be an integer from 0 to 4611686018427387904, got -1'),
        (['--target=0,-0.1,0'], 'the depth must be in (0, 160] mm'),
        (['-o', 'needle.csv'], 'the picture must be .png'),
        (['-o', '/no/such/folder/x.png'], 'its folder does not exist'),
    ],
)
def test_invalid_input_is_a_one_line_error(
    capsys: pytest.CaptureFixture[str], words: list[str], complaint: str
) -> None:
    _, said = steered(capsys, *words, status=2)
    assert complaint in said
    assert len(said.strip().splitlines()) == 1


def test_needle_is_drawn_in_the_frame_of_target_and_sensor() -> None:
    """The drawn tip is where the sensor, whose frame is rotated, sees it."""
    needle, steering, _ = NEEDLES[DEFAULT_NEEDLE]
    truth = steer.sample_needle(needle, steering, SteeringPrior(frame=0.05), 0)
    plant = truth.plant(np.array([0.0, 0.1]))
    plant.insert()
    assert np.abs(truth.frame).max() > 5e-3
    drawn = steer._line(plant.needle.shape, truth.frame)
    # The shape ends at the depth of the tip up to the rounding of its elements.
    assert drawn[-1] == pytest.approx([plant.tip[0], 0.1, plant.tip[1]], abs=1e-9)


def test_sampled_needle_has_the_nominal_bevel_of_each_layer() -> None:
    """Its deviation scales all layers, also where it is 0."""
    needle, steering, _ = find_needle(DEFAULT_NEEDLE).changed(
        {'bevel_load': [0.3, 0.1], 'layer_depths': [0.03], 'layer_stiffnesses': [3e4]}
    )
    exact = steer.sample_needle(needle, steering, SteeringPrior(bevel=0.0), 1)
    assert exact.steering.bevel_load == (0.3, 0.1)
    truth = steer.sample_needle(needle, steering, SteeringPrior(), 1)
    size = float(np.hypot(*truth.bevel))
    assert size != 0.3
    assert truth.steering.bevel_load == pytest.approx((size, size / 3.0))


def test_shipped_picture_is_the_picture_of_the_default_command(tmp_path: Path) -> None:
    """Of the command in the README."""
    assert main(['steer', '--target', '4mm,100mm,-2mm', '-o', str(tmp_path / 'now.png')]) == 0
    now, kept = imread(tmp_path / 'now.png'), imread(IMAGES / 'steered.png')
    assert now.shape == kept.shape
    # Tolerance for the rounding of colors.
    assert np.abs(now - kept).mean() < 3e-4
