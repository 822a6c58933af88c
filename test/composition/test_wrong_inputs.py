# SPDX-License-Identifier: Apache-2.0
"""Wrong command lines of `needle` are answered in one line that names the correction."""

from __future__ import annotations

from pathlib import Path
import shlex
import shutil
import sys

from needle_insertion.cli import main
import needle_study
import pytest
from reproduction.protocol import SHIPPED_BAGS

BAGS = sorted(SHIPPED_BAGS.glob('friction_*'))

#: Words of each answer, by command line in the folder of `wrong`.
ANSWERS = {
    'steer --target 4,100,-2': 'in (0, 160] mm with the needle bending_35mm, got 100000 mm; '
    'lengths without a unit are in m',
    'steer --target 4mm,100mm': 'x,y,z, where y is the depth, such as 4mm,100mm,-2mm',
    'steer --step 1e-6': 'it would take 100000 steps of 0.001 mm, at most 200 are possible',
    'steer --target 4mm,300mm,0mm': 'the depth must be in (0, 160] mm',
    'steer --target 4in,100mm,0mm': "'4in' is not a length, such as 0.05 or 50mm",
    'steer --target 40mm,100mm,0mm': 'out of reach: reachable on average are x = 0.00 ± ',
    'steer --needle bending_35': 'did you mean bending_35mm?',
    'steer --needle missing.yaml': 'missing.yaml cannot be read: No such file',
    'steer --needle folder': 'or a file of your own (.yaml), got',
    'steer --needle typo.yaml': "did you mean 'length'?",
    'steer --law multi_hypotheses': 'law must be one of multi_hypothesis, springs',
    'steer --law nowhere:Law': "cannot be imported: No module named 'nowhere'",
    'steer --step 0.5mm2': 'is not a length, such as 0.05 or 50mm',
    'steer --step 200mm': '--step must be in (0, 0.1] m',
    'steer --seed -1': '--seed must be an integer from 0',
    'steer --seed one': "argument --seed: must be a whole number, got 'one'",
    'steer --set lenght=1m': "did you mean 'length'?",
    'steer --set length': '--set takes NAME=VALUE',
    'steer --set tissue_stiffness=0': 'tissue_stiffness must be > 0 N/m^2',
    'identify steering table.csv --report page': (
        '--report is an option of needle identify friction and needle identify stiffness'
    ),
    'steer --prior noise=-1': 'noise must be finite, > 0 and <= 0.1 m',
    'steer -o picture.pdf': 'the picture must be .png',
    'steer -o nowhere/picture.png': 'its folder does not exist',
    'simulate --depth 5': '--depth must be <= length = 0.2 m, got 5 m: lengths without a unit',
    'simulate --force 3kg': 'is not a force, such as 3 or 3N',
    'simulate --duration 1s': 'try --model modes',
    'simulate --needle phantom --set length=150N': "with a unit of m, cm, mm, um, got '150N'",
    'simulate --needle phantom --depth 500mm': 'outside [0.001, 0.2] m',
    'simulate --frce 3N': 'did you mean --force?',
    'analyze --depth -10mm': 'outside [0.001, 0.2] m',
    'analyze --needle fantom': 'did you mean phantom?',
    'identify frction BAG': 'did you mean friction?',
    'identify friction': 'required: RECORDING; --help lists all arguments',
    'identify friction nowhere': 'nowhere does not exist; valid: a rosbag2 folder',
    'identify friction folder': 'folder holds no recording; valid: a rosbag2 folder',
    'identify friction empty.csv': 'empty.csv is empty; valid: a table with named columns',
    'identify friction empty.mcap': 'empty.mcap is not an MCAP file: begins with nothing',
    'identify friction cut.mcap': 'cut.mcap is cut off',
    'identify friction notes.pdf': 'sensor also a table (.csv, .tsv, .txt, .dat, .mat)',
    'identify stiffness notes.pdf': 'notes.pdf is not a recording; valid: ',
    'identify friction table.csv': 'must last > 0.048 s',
    'identify friction table.csv --columns force=g': "no column 'g' for force; it has t, q, f",
    'identify friction table.csv --columns time=t,time=q': '--columns names time twice: t and q',
    'identify friction table.csv --columns force=f*nan': 'must be finite and not zero, got nan',
    'identify friction table.csv --columns time=t[N]': 'must be one of s, sec, ms, us, µs, μs, ns',
    'identify friction BAG --wrench-topic wrench': 'it has /base_wrench (geometry_msgs',
    'identify friction BAG --force-axis w': 'force axis must be x, y, z, -x, -y or -z',
    'identify friction BAG --motion-axis slide': 'must name one of insertion, rotation',
    'identify friction BAG --cutoff 30mm': 'is not a quantity, such as 1.5 or 1.5Hz',
    'identify friction BAG --decay-time 3s': '--decay-time is for the term decay',
    'identify friction BAG --time now': "(choose from 'header', 'receive')",
    'identify steering table.csv': 'use --columns depth=NAME',
    'inspect nowhere.csv': 'nowhere.csv cannot be read: No such file',
    'inspect notes.pdf': 'valid: a rosbag2 folder',
    'watch nowhere': 'nowhere does not exist; valid: a rosbag2 folder',
    'watch --port 99999': '--port must be 0 to 65535',
    'watch --host robot': '--host must be an address such as 127.0.0.1',
    'watch BAG --control': 'omit --control or the BAG',
    'watch BAG --time stamp': "(choose from 'header', 'receive')",
    'study nowhere.yaml': 'nowhere.yaml cannot be read: No such file',
    'study typo.yaml': 'valid: correlations, design, population',
    'study study.yaml --workers 0': '--workers must be >= 1',
    'study study.yaml --replay 99': '--replay must be from 0 to 9',
    'verify nowhere': 'nowhere does not exist; valid: a rosbag2 folder',
    'verify BAG --steps': 'unrecognized arguments: --steps; --help lists all arguments',
    'experiment friction --rate -5 out': '--rate must be in [40, 5000] Hz',
    'experiment stiffness --needle phantom out': '--needle is for friction',
    'experiment friction --needle fantom out': 'did you mean phantom?',
    'experiment friktion out': 'did you mean friction?',
    'experiment exp2 friction': "argument WHAT: invalid choice: 'exp2' (choose from 'friction'",
    'reproduce tables': "argument WHAT: invalid choice: 'tables' (choose from 'figure-4'",
    'reproduce figure-9': 'did you mean figure-8?',
    'run --needle bending_35mmm': 'did you mean bending_35mm?',
    'run --hardwre': 'did you mean --hardware?',
    'compile now': 'unrecognized arguments: now; --help lists all arguments',
    'wach BAG': 'did you mean watch?',
}


@pytest.fixture(scope='module')
def wrong(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of wrong files, and a shipped recording."""
    folder = tmp_path_factory.mktemp('wrong')
    (folder / 'folder').mkdir()
    shutil.copytree(BAGS[0], folder / 'BAG')
    (file,) = BAGS[0].glob('*.mcap')
    rows = ''.join(f'{k / 100},{k / 1000},1\n' for k in range(5))
    for name, content in {
        'empty.csv': b'',
        'empty.mcap': b'',
        'cut.mcap': file.read_bytes()[:3000],
        'notes.pdf': b'%PDF',
        'table.csv': f't,q,f\n{rows}'.encode(),
        'typo.yaml': b'lenght: 150mm\n',
        'study.yaml': b'scenario: steering\nsamples: 10\n',
    }.items():
        (folder / name).write_bytes(content)
    return folder


def answer(line: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Return the only line of the answer to a wrong command line, without results."""
    try:
        status = main(shlex.split(line))
    except SystemExit as error:
        status = int(error.code or 0)
    said = capsys.readouterr()
    assert status in (1, 2)
    assert said.out == ''
    (only,) = said.err.splitlines()
    assert 'error: ' in only
    return only


@pytest.mark.parametrize('line', ANSWERS)
def test_wrong_input_is_answered_in_one_line(
    line: str, wrong: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The line has the invalid value and its correction; nothing is written."""
    monkeypatch.chdir(wrong)
    before = sorted(wrong.rglob('*'))
    assert ANSWERS[line] in answer(line, capsys)
    assert sorted(wrong.rglob('*')) == before


@pytest.mark.parametrize('command', ['verify', 'watch', 'identify stiffness'])
def test_command_that_reads_no_tables_lists_none(
    command: str, wrong: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(wrong)
    only = answer(f'{command} table.csv', capsys)
    assert only.endswith('table.csv is not a recording; valid: a rosbag2 folder, an .mcap or a '
                         '.db3 file, or a .bag file of ROS 1')  # fmt: skip


def test_missing_extra_is_named(
    wrong: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without pyarrow a study names the extra to install."""
    monkeypatch.chdir(wrong)
    monkeypatch.delattr(needle_study, 'engine', raising=False)
    monkeypatch.delitem(sys.modules, 'needle_study.engine', raising=False)
    monkeypatch.setitem(sys.modules, 'pyarrow', None)
    assert "pip install 'needle_insertion[study]'" in answer('study study.yaml', capsys)
