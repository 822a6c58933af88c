# SPDX-License-Identifier: Apache-2.0
"""Show the navigation of a page's own section only: the whole tree has 400 entries."""

from typing import Any

from sphinx.application import Sphinx


def collapse(
    _app: Sphinx, _page: str, _template: str, context: dict[str, Any], _tree: object
) -> None:
    """Collapse the other sections; the theme requests the whole tree for each page."""
    if (toctree := context.get('toctree')) is not None:
        context['toctree'] = lambda **options: toctree(**{**options, 'collapse': True})


def setup(app: Sphinx) -> dict[str, bool]:
    """Replace the function of a page before the theme calls it (priority 500)."""
    app.connect('html-page-context', collapse, priority=400)
    return {'parallel_read_safe': True, 'parallel_write_safe': True}
