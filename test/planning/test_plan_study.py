# SPDX-License-Identifier: Apache-2.0
"""Studies of insertions along the plan of a file, in the anatomy of its segmentation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
import re
from typing import Any

from needle_insertion.cli import main
from needle_planning import chance_of, find_plan, read_anatomy, read_plan, write_plan
from needle_planning.chance import POPULATION
from needle_study import build_study, read_study
import nrrd
import numpy as np
import pytest
from support.segmentations import write_labels, write_nrrd
from support.studies import check_refused
import yaml

EXAMPLE = Path(__file__).parents[2] / 'examples/studies/plan.yaml'
LABELS = {1: {'role': 'entry'}, 2: {'role': 'obstacle', 'margin': '1mm'}}
#: From voxels of 1 mm to the patient, LPS [mm].
LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Any]:
    """Return the settings with a plan between two walls and its segmentation."""
    labels = np.zeros((60, 60, 80), np.uint8)
    labels[28:32, 28:32, 78] = 1
    labels[10:25, :, 40] = labels[35:60, :, 60] = 2
    image = write_nrrd(tmp_path / 'walls.nrrd', labels, LPS)
    roles = write_labels(tmp_path / 'labels.yaml', LABELS)
    write_plan(
        find_plan(read_anatomy(image, roles), (0.03, 0.03, 0.005), bow=False),
        tmp_path / 'plan.yaml',
    )
    return {
        'plan': str(tmp_path / 'plan.yaml'), 'segmentation': str(image), 'labels': str(roles)
    }  # fmt: skip


def study_of(files: dict[str, Any], **settings: Any) -> dict[str, Any]:
    return {
        'scenario': 'plan', 'samples': 8, 'settings': {**files, **settings},
        'population': {'registration_x': {'normal': [0, '0.5mm']}, 'slow_noise': '0.2mm'},
    }  # fmt: skip


def test_study_of_a_plan_is_its_simulation(files: dict[str, Any], tmp_path: Path) -> None:
    """The same insertions as by `chance_of`, in the files of the command."""
    document = study_of(files, radius='2mm')
    (tmp_path / 'study.yaml').write_text(yaml.safe_dump(document))
    found = read_study(tmp_path / 'study.yaml').simulate().values
    expected = chance_of(
        read_plan(files['plan']),
        read_anatomy(files['segmentation'], files['labels']),
        insertions=8,
        radius=2e-3,
        workers=1,
        population={'registration_x': {'normal': [0, 5e-4]}, 'slow_noise': 2e-4},
    )
    for name, values in expected.values.items():
        np.testing.assert_array_equal(found[name], values)


def test_command_keeps_the_results_of_a_plan(
    files: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A second call reads them; with another plan in the file it is another study."""
    (tmp_path / 'study.yaml').write_text(yaml.safe_dump(study_of(files)))
    words = ['study', str(tmp_path / 'study.yaml'), '-o', str(tmp_path / 'out'), '--workers', '1']
    for _ in range(2):
        assert main(words) == 0
        assert re.search(r'^Success +[\d.]+% .*\nHit ', capsys.readouterr().out, re.MULTILINE)
    plan = Path(files['plan'])
    plan.write_text(plan.read_text() + '# changed\n')
    assert main(words) == 2
    assert 'belongs to another study' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('settings', 'reason'),
    [
        ({'plan': None}, 'settings must have the files plan, segmentation, labels'),
        ({'folder': '.'}, 'settings must have the files plan, segmentation, labels'),
        ({'segmentation': 3}, 'must be names of files'),
        ({'plan': 'none.yaml'}, 'none.yaml'),
        ({'labels': 'none.yaml'}, 'none.yaml cannot be read'),
        ({'segmentation': 'none.nrrd'}, 'none.nrrd: No such file'),
        ({'radius': 0.0}, 'radius'),
        ({'turns': 1}, 'settings.turns must be 0'),
        ({'step_length': 3e-3}, 'settings: step_length must be omitted'),
        ({'size': 1}, "'size'"),
    ],
)
def test_invalid_settings_are_one_line(
    files: dict[str, Any],
    settings: dict[str, Any],
    reason: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Before the start of the simulation."""
    given = {name: one for name, one in {**files, **settings}.items() if one is not None}
    check_refused(study_of(given), reason, tmp_path, capsys)


def test_file_that_a_worker_does_not_have_is_one_line(
    files: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its checksum is in the study that the workers receive."""
    document = study_of(files) | {'files': {files['plan']: '00000000'}}
    check_refused(document, 'is not the file with which the study was begun', tmp_path, capsys)


def test_a_changed_needle_file_is_another_study(
    files: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The needle of a plan is a file of the study; its radius is that of the plan."""
    needle, plan = tmp_path / 'mine.yaml', Path(files['plan'])
    needle.write_text('length: 150mm\n')
    plan.write_text(plan.read_text().replace('needle: bending_35mm', f'needle: {needle}'))
    before = build_study(study_of(files)).document['files']
    needle.write_text('length: 151mm\n')
    after = build_study(study_of(files)).document['files']
    assert {name for name in before if before[name] != after[name]} == {str(needle)}
    needle.write_text('outer_diameter: 2.5mm\ninner_diameter: 1mm\n')
    check_refused(study_of(files), 'has a radius of 1.25 mm, and in the plan', tmp_path, capsys)


def test_data_file_of_a_detached_header_is_a_file_of_the_study(
    files: dict[str, Any], tmp_path: Path
) -> None:
    labels, _ = nrrd.read(files['segmentation'])
    image = write_nrrd(tmp_path / 'walls.nhdr', labels, LPS)
    (data,) = tmp_path.glob('walls.raw*')
    settings = {**files, 'segmentation': str(image)}
    document = study_of(settings)
    before = build_study(document).document['files'][str(image)]
    data.write_bytes(data.read_bytes() + b'\0')
    assert build_study(document).document['files'][str(image)] != before


@pytest.mark.parametrize(
    ('shift', 'reason'), [(3, 'the plan is of another segmentation'), (90, 'is not in ')]
)
def test_plan_of_another_segmentation_is_refused(
    files: dict[str, Any],
    shift: int,
    reason: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Also after a failed start, the folder is free."""
    labels, _ = nrrd.read(files['segmentation'])
    moved = LPS.copy()
    moved[0, 3] = -shift
    write_nrrd(Path(files['segmentation']), labels, moved)
    check_refused(study_of(files), reason, tmp_path, capsys)


def test_plan_beyond_the_limits_is_refused(
    files: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As by the node `steering`; a guide at rest is for an open loop."""
    check_refused(study_of(files, guide_limit=0.0), ': settings: guide_limit', tmp_path, capsys)
    plan = Path(files['plan'])
    guide = read_plan(plan).guide.copy()
    guide[1:, 0] = 1.5e-3
    write_plan(replace(read_plan(plan), guide=guide), plan)
    given = study_of(files, guide_limit='1mm')
    check_refused(given, 'settings: the plan needs guide_limit >= 1.500 mm', tmp_path, capsys)
    given = study_of(files, guide_step='1mm')
    check_refused(given, 'settings: the plan needs guide_step >= 1.500 mm', tmp_path, capsys)


def test_layers_without_a_plan_are_refused(
    files: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = study_of(files) | {'population': {'layer_3': 1.0}}
    reason = 'population: layer_3 is not in the plan, which has 0 layers'
    check_refused(document, reason, tmp_path, capsys)


def test_example_has_the_documented_uncertainty() -> None:
    """That of `needle plan --insertions`, with the layers of the plan."""
    given = yaml.safe_load(EXAMPLE.read_text())['population']
    assert {one for one in given if not one.startswith('layer_')} == set(POPULATION)
    spreads = {name: one['lognormal'][1] for name, one in given.items() if 'layer' in name}
    assert spreads == {'layer_2': 0.3, 'layer_3': 0.3, 'layer_4': 0.5}
    # Units of the file, in millimeters and without a unit.
    factors = {'mm': 1e-3}
    for name, one in POPULATION.items():
        if 'normal' not in (one if isinstance(one, dict) else {}):
            continue
        for key in ('normal', 'within'):
            values = [
                float(str(number).removesuffix('mm')) * factors.get(str(number)[-2:], 1.0)
                for number in given[name][key]
            ]
            np.testing.assert_allclose(values, one[key], rtol=1e-12)
