# SPDX-License-Identifier: Apache-2.0
"""Identification of the stiffness of each layer of tissue from steered insertions."""

from __future__ import annotations

from dataclasses import asdict, replace
import json
from math import isfinite, log
from pathlib import Path
from typing import Any

from benchmarks.steering_fit import fit_layers, FitTruth, insertion
from needle_controller.steering.insertion_plan import write_plan
from needle_controller.steering.laws.multi_hypothesis import MultiHypothesisLaw
from needle_controller.steering.responses import SteeringModel
from needle_controller.steering.settings import SteeringLimits, SteeringPrior
from needle_dynamics import find_needle, NeedleParameters
from needle_identification import (
    IdentificationError,
    identify_steering,
    SteeringRecording,
    SteeringSettings,
)
from needle_identification.result import steering_yaml
from needle_insertion.cli import main
from needle_ros.errors import ParameterError
import numpy as np
import pytest
from support.plans import bowed_plan
import yaml

#: Three layers, the last one deeper than the insertions.
TWO = FitTruth(length=0.033, borders=(0.04, 0.12), ratios=(1.6, 1.0), noise=2e-5)
THREE = FitTruth(borders=(0.03, 0.06), ratios=(0.6, 1.4), noise=0.0)

#: Known free length: the fits take a third of the time.
KNOWN = SteeringSettings(terms=('tilt',), order='together', free_length=TWO.free)


def nominal(truth: FitTruth, length: float = 0.035) -> NeedleParameters:
    """Return the needle with the same stiffness in all layers."""
    return replace(truth, length=length, ratios=(1.0,) * len(truth.ratios)).tissue


def layers(truth: FitTruth, length: float = 0.035) -> list[float]:
    """Return the true stiffness of each layer over its nominal one."""
    pairs = zip(
        truth.tissue.tissue.stiffnesses, nominal(truth, length).tissue.stiffnesses, strict=True
    )
    return [true / of for true, of in pairs]


def write_table(path: Path, one: SteeringRecording) -> None:
    table = np.column_stack([one.depth, one.guide, one.tip])
    heads = 'depth [m],guide_x [m],guide_z [m],tip_x [m],tip_z [m]'
    np.savetxt(path, table, delimiter=',', header=heads, comments='', fmt='%.9g')


@pytest.mark.parametrize('truth', [replace(THREE, borders=(0.05,), ratios=(1.5,)), THREE])
def test_layers_are_exact_without_noise(truth: FitTruth) -> None:
    """From one insertion; the error is from elements of different lengths."""
    found = identify_steering([insertion(1, truth)], replace(KNOWN, tissue=nominal(truth)))
    [gel] = found.media
    assert all(one.determined for one in gel.layers)
    # Elements of 1 and 1.25 mm: 1e-4 of the bending length of uniform tissue, four times as much
    # of a stiffness, and more of a layer of a third of the depth.
    np.testing.assert_allclose([one.value for one in gel.layers], layers(truth), rtol=5e-3)
    # From the elements, as above: 3e-4 and 2e-4 were found.
    assert gel['bending_length'].value == pytest.approx(truth.length, rel=1e-3)
    assert found.rms < 3e-7


def test_equal_layers_agree_with_uniform_tissue() -> None:
    """Without noise the values agree, with noise the intervals contain the uniform stiffness."""
    alike = FitTruth(length=0.03)
    tissue = nominal(replace(THREE, length=0.03))
    for noise, tolerance in ((0.0, 5e-3), (alike.noise, None)):
        made = [insertion(k, replace(alike, noise=noise)) for k in range(2 if noise else 1)]
        [uniform], [layered] = (
            identify_steering(made, settings).media
            for settings in (KNOWN, replace(KNOWN, tissue=tissue))
        )
        same = (0.035 / uniform['bending_length'].value) ** 4
        for one in layered.layers:
            if tolerance is not None:
                # The error of elements of different lengths, as above.
                assert one.value == pytest.approx(same, rel=tolerance)
            else:
                low, high = one.interval
                assert low < same < high


def test_a_single_layer_is_identical_to_uniform_tissue() -> None:
    made, single = [insertion(1)], nominal(FitTruth(), 0.05)
    uniform, layered = (
        identify_steering(made, settings) for settings in (KNOWN, replace(KNOWN, tissue=single))
    )
    assert asdict(uniform.media[0]) == asdict(layered.media[0])
    assert uniform.free_length == layered.free_length
    assert uniform.warnings == layered.warnings


def test_layers_of_a_resting_guide_are_not_determined() -> None:
    """The shape of the drift alone determines no layer, with noise and without."""
    for noise in (1.8e-4, 0.0):
        still = insertion(1, replace(THREE, noise=noise), steer=0.0)
        found = identify_steering([still], replace(KNOWN, tissue=nominal(THREE)))
        [gel] = found.media
        assert not any(one.determined for one in gel.layers)
        assert all(isfinite(one.value) for one in gel.layers)
        with pytest.raises(IdentificationError, match='the stiffness of any layer'):
            steering_yaml(found)


def test_one_insertion_with_a_tracker_determines_no_layer() -> None:
    """Noise of 0.18 mm: no layer to a factor of 2, although the residuals are as small as it."""
    truth = replace(THREE, noise=1.8e-4, path_noise=1e-4)
    found = identify_steering([insertion(0, truth)], replace(KNOWN, tissue=nominal(THREE)))
    assert not any(one.determined for one in found.media[0].layers)
    assert found.rms < 2.2e-4


def model_of(parameters: dict[str, Any]) -> SteeringModel:
    """Return the model of a law with the parameters of the node."""
    given = {name.partition('.')[2]: value for name, value in parameters.items() if '.' in name}
    spreads = given.pop('layer_spread')
    prior = SteeringPrior(path_noise=given.pop('path_noise'), layer_spread=tuple(spreads))
    preset = find_needle('phantom').changed(given)
    return SteeringModel(preset.needle, preset.steering, 5e-3 * np.arange(27.0), prior)


def test_the_law_uses_the_layers_of_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A layer that is not reached has the mean stiffness of the others, and a spread of 2."""
    table = tmp_path / 'run.csv'
    write_table(table, insertion(1, TWO))
    tissue, result = nominal(TWO).tissue.stiffnesses[0], tmp_path / 'result.yaml'
    needle = tmp_path / 'needle.yaml'
    needle.write_text(
        'needle: phantom\n'
        f'tissue_stiffness: {tissue}\n'
        'layer_depths: [0.04, 0.12]\n'
        f'layer_stiffnesses: [{tissue}, {tissue}]\n'
    )
    words = [str(table), '--terms', 'tilt', '--order', 'together', '--free-length', '40mm']
    options = ['--needle', str(needle), '-o', str(result)]
    assert main(['identify', 'steering', *words, *options, '--json']) == 0
    document = json.loads(capsys.readouterr().out)
    assert [one['depth'] for one in document['nominal_layers']] == [0.0, 0.04, 0.12]
    [medium] = document['media'].values()
    first, second, third = (medium['parameters'][f'layer_{k}'] for k in (1, 2, 3))
    for one, true in zip((first, second), layers(TWO)[:2], strict=True):
        low, high = one['interval']
        assert low < true < high
    assert not third['determined']
    # The prior of layers: the mean of their logarithms, to rounding.
    assert third['used'] == pytest.approx((first['value'] * second['value']) ** 0.5, rel=1e-9)
    # The file: median and spread of the law. ROS 2 reads no aliases of YAML.
    text = result.read_text()
    assert '&' not in text
    sections = yaml.safe_load(text)
    assert f'needle {needle}' in text
    model = model_of(sections['/**/steering']['ros__parameters'])
    stiffnesses = model.needle.tissue.stiffnesses
    values = [first['value'], second['value'], third['used']]
    # Seven digits in the file.
    np.testing.assert_allclose(stiffnesses, np.multiply(values, tissue), rtol=1e-6)
    deviations = [log(high / low) / 3.92 for low, high in (first['interval'], second['interval'])]
    spreads = [*deviations, log(2.0)]
    np.testing.assert_allclose(model.prior.layer_spread, spreads, rtol=1e-6)
    # In addition to the uncertainty of the bending length of all layers.
    law = MultiHypothesisLaw(model, np.zeros(2), SteeringLimits())
    np.testing.assert_allclose(np.ptp(law.layers[:, 1] ** 2 - np.square(spreads)), 0.0, atol=1e-6)
    # And from a plan with these layers, in a table.
    plan = replace(bowed_plan(), layers=np.array([[0.0, tissue, 0.3], [0.04, tissue, 0.3]]))
    write_plan(plan, tmp_path / 'plan.yaml')
    assert main(['identify', 'steering', *words, '--plan', str(tmp_path / 'plan.yaml')]) == 0
    text = capsys.readouterr().out
    assert 'Layer 2 k_2/k_nominal' in text
    assert 'Layer 3' not in text
    assert 'not determined' not in text
    assert f'k_nominal: {tissue:.4g} N/m^2 from 0 mm, {tissue:.4g} N/m^2 from 40 mm' in text


def test_intervals_of_layers_contain_the_true_stiffness() -> None:
    """Two layers that deviate by 30 % each, with path noise and a tracker; see `needle bench`."""
    found = [fit_layers(2, 4, seed) for seed in (300, 301)]
    held = np.concatenate([one.held for one in found])
    known = np.isfinite(held)
    assert known.sum() >= 3
    # Of four intervals of 95 %, three or more contain the true value with a probability of 98.6 %.
    assert held[known].sum() >= known.sum() - 1
    errors = np.concatenate([one.errors for one in found])[known]
    # Four insertions determine a layer to about 20 %.
    assert np.sqrt(np.mean(errors**2)) < 0.4


def test_a_layer_without_tissue_is_rejected() -> None:
    with pytest.raises(ParameterError, match=r'a nominal stiffness > 0 N/m\^2, got 0, '):
        SteeringSettings(tissue=replace(nominal(THREE), tissue_stiffness=0.0))
