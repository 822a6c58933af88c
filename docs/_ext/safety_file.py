# SPDX-License-Identifier: Apache-2.0
"""Generate the safety file, and show the IDs of requirements in its source pages."""

from pathlib import Path
import re
from typing import Any

from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from tools.safety_file import last_results, PAGES, SafetyFile

DOCS = Path(__file__).parents[1]


def write_page(_app: Sphinx) -> None:
    """Write the page; a fault of the safety file fails the build."""
    file = SafetyFile()
    if file.faults:
        raise ExtensionError('the safety file is incomplete:\n' + '\n'.join(file.faults))
    page = DOCS / 'repository' / 'safety-file.md'
    page.parent.mkdir(exist_ok=True)
    page.write_text(file.page(last_results()), encoding='utf-8')


def show_identifiers(_app: Sphinx, name: str, content: list[str]) -> None:
    """Show the IDs of requirements as superscripts, and hide those of notes."""
    if f'docs/{name}.md' in PAGES:
        text = re.sub(r' \((N-\d{3})\)', '', content[0])
        content[0] = re.sub(r' \((S-\d{3})\)', r' {sup}`\1`', text)


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect both to Sphinx."""
    app.connect('builder-inited', write_page)
    app.connect('source-read', show_identifiers)
    return {'parallel_read_safe': True, 'parallel_write_safe': True}
