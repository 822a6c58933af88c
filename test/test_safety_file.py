# SPDX-License-Identifier: Apache-2.0
"""Safety file: every sentence has an ID, every requirement a test and a cause."""

from __future__ import annotations

from pathlib import Path

import pytest
from tools.safety_file import PAGES, SafetyFile, sentences

SAFETY = """# Safety

No force acts during a stop (S-001). It is **shown (N-001).** These are the limits:

| quantity | limit |
|---|---|
| force (S-002) | 15 N, `a. B` |

```bash
Code. It has no ID.
```

- **A label.** A velocity of 0.2 m/s stops
  the needle (`test_one`) (S-003).
"""
HAZARDS = """
hazards:
  - hazard: Too much force
    causes:
      - cause: A command
        control: A limit
        requirements: [S-001, S-002, S-003]
files: [test/test_it.py]
"""
TESTS = """
@pytest.mark.requirement('S-001', 'S-003')
@pytest.mark.parametrize('a', [1])
def test_one(a): ...

@pytest.mark.requirement('S-002')
async def test_two(): ...
"""
FILES = {'docs/safety.md': SAFETY, 'docs/security.md': '', 'docs/hazards.yaml': HAZARDS,
         'test/test_it.py': TESTS}  # fmt: skip


def made(folder: Path, files: dict[str, str]) -> SafetyFile:
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(content, encoding='utf-8')
    return SafetyFile(folder)


def test_safety_file_is_complete() -> None:
    """For the pages, hazards and tests of this project."""
    file = SafetyFile()
    assert file.faults == []
    assert len(file.requirements) >= 184


def test_sentences_are_split_at_their_ends() -> None:
    """Not in code, and without labels, headings and heads of tables."""
    assert [(one.line, one.content) for one in sentences(PAGES[0], SAFETY)] == [
        (3, 'No force acts during a stop (S-001).'),
        (3, 'It is **shown (N-001).**'),
        (3, 'These are the limits:'),
        (7, '| force (S-002) | 15 N, `a. B` |'),
        (13, 'A velocity of 0.2 m/s stops the needle (`test_one`) (S-003).'),
    ]


@pytest.mark.parametrize(
    ('name', 'old', 'new', 'fault'),
    [
        ('docs/safety.md', ' (S-001)', '', "safety.md:3: one ID is required at the end of 'No fo"),
        ('docs/safety.md', ' (N-001)', '', "safety.md:3: one ID is required at the end of 'It is"),
        ('docs/safety.md', ' (S-002)', '', 'safety.md:7: one ID is required'),
        ('docs/safety.md', 'N-001', 'S-004', "S-004 has no test: 'It is"),
        ('docs/safety.md', 'N-001', 'S-001', 'S-001 is used 2 times'),
        ('docs/safety.md', '`test_one`', '`test_two`', 'S-003 names test_two, which does'),
        ('docs/hazards.yaml', ', S-003', '', 'S-003 must have one cause in docs/hazards'),
        ('docs/hazards.yaml', 'S-003', 'S-003, S-004', 'hazards.yaml names S-004, which is no'),
        ('test/test_it.py', "'S-002'", "'S-002', 'S-009'", 'test_two names S-009, which is no'),
        ('test/test_it.py', "'S-002'", "'N-001'", "S-002 has no test: '| force"),
        ('test/test_it.py', 'test_two', 'test_two(): ...\ndef test_three', 'test_three names no'),
    ],
)  # fmt: skip
def test_fault_of_the_safety_file_is_reported(
    name: str, old: str, new: str, fault: str, tmp_path: Path
) -> None:
    """A missing or wrong ID, test or cause; nothing without a fault."""
    assert made(tmp_path, FILES).faults == []
    assert old in FILES[name]
    found = made(tmp_path, {**FILES, name: FILES[name].replace(old, new)}).faults
    assert any(fault in line for line in found), found


def test_page_lists_requirements_with_tests_and_results(tmp_path: Path) -> None:
    """Each with its last result; the page is no certificate."""
    file = made(tmp_path, FILES)
    page = file.page({'test/test_it.py::test_one': {'outcome': 'passed', 'date': '2026-01-02'}})
    assert 'It is evidence of research software, not a certificate.' in page
    rows = [line for line in page.splitlines() if line.startswith('|') and 'S-00' in line]
    last = '`test_one` | passed 2026-01-02 |'
    assert rows == [
        f'| A command | A limit | S-001: No force acts during a stop. | {last}',
        '|  |  | S-002: force; limit: 15 N, `a. B` | `test_two` | not run |',
        f'|  |  | S-003: A velocity of 0.2 m/s stops the needle (`test_one`). | {last}',
    ]
