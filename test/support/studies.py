# SPDX-License-Identifier: Apache-2.0
"""Checks of invalid studies."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from needle_insertion.cli import main
import pytest
import yaml


def check_refused(
    document: Mapping[str, Any], complaint: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Check that a study is rejected in one line with the file name, without output files."""
    file = folder / 'study.yaml'
    file.write_text(yaml.safe_dump(document))
    assert main(['study', str(file), '-o', str(folder / 'new')]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f'error: {file}: ')
    assert complaint in said
    assert said.count('\n') == 1
    assert not (folder / 'new').exists()
