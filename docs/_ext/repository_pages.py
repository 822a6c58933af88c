# SPDX-License-Identifier: Apache-2.0
"""Include pages from outside docs/ in the site, and rewrite their links."""

from os.path import relpath
from pathlib import Path
import re
from typing import Any

from sphinx.application import Sphinx

DOCS = Path(__file__).parents[1]
REPOSITORY = DOCS.parent
#: Files outside docs/, and their paths in the site.
PAGES = {
    REPOSITORY / 'README.md': DOCS / 'repository' / 'readme.md',
    REPOSITORY / 'CHANGELOG.md': DOCS / 'repository' / 'changelog.md',
    REPOSITORY / 'CONTRIBUTING.md': DOCS / 'repository' / 'contributing.md',
    REPOSITORY / 'QUALITY_DECLARATION.md': DOCS / 'repository' / 'quality.md',
    REPOSITORY / 'SECURITY.md': DOCS / 'repository' / 'security-policy.md',
    REPOSITORY / 'examples' / 'README.md': DOCS / 'repository' / 'examples.md',
    REPOSITORY / 'bags' / 'README.md': DOCS / 'repository' / 'recordings.md',
    REPOSITORY / 'config' / 'README.md': DOCS / 'repository' / 'layouts.md',
}
LINK = re.compile(r'\]\((?!\w+:|#)([^)#\s]+)')


def rewrite(text: str, source: Path, page: Path) -> str:
    """Rewrite links relative to a source file as links relative to a page of the site."""

    def link(match: re.Match[str]) -> str:
        target = (source.parent / match[1]).resolve()
        return f']({relpath(PAGES.get(target, target), page.parent)}'

    return LINK.sub(link, text)


def copy_pages(_app: Sphinx) -> None:
    """Copy the pages before Sphinx searches for sources."""
    for source, page in PAGES.items():
        page.parent.mkdir(exist_ok=True)
        # The home page includes the README: links are relative to the home page.
        seen = (
            DOCS / 'index.md'
            if source.name == 'README.md' and source.parent == REPOSITORY
            else page
        )
        page.write_text(
            rewrite(source.read_text(encoding='utf-8'), source, seen), encoding='utf-8'
        )


def correct_links(app: Sphinx, name: str, content: list[str]) -> None:
    """Correct the links of a page of docs/ that point out of it."""
    page = Path(app.env.doc2path(name))
    if page.suffix == '.md' and page not in PAGES.values():
        content[0] = rewrite(content[0], page, page)


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect the copying of pages and the correction of links to Sphinx."""
    app.connect('builder-inited', copy_pages)
    app.connect('source-read', correct_links)
    return {'parallel_read_safe': True, 'parallel_write_safe': True}
