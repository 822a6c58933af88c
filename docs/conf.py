"""The documentation site: `make docs` writes it to docs/_build/html, without the network."""

from pathlib import Path
import sys
import xml.etree.ElementTree as ET

ROOT = Path(__file__).resolve().parents[1]
MANIFEST = ET.parse(ROOT / 'package.xml').getroot()  # noqa: S314
sys.path[:0] = [str(ROOT), str(ROOT / 'docs' / '_ext')]

project = MANIFEST.findtext('name')
author = MANIFEST.findtext('maintainer')
release = version = MANIFEST.findtext('version')

extensions = [
    'sphinx.ext.autodoc',
    'sphinx.ext.viewcode',
    'numpydoc',
    'myst_parser',
    'api',
    'repository_pages',
    'mathml',
]
# The README is included in the home page.
exclude_patterns = ['_build', 'repository/readme.md']
html_math_renderer = 'mathml'
html_theme = 'furo'
html_title = f'{project} {release}'
html_static_path = ['_static']
html_css_files = ['site.css']
html_show_copyright = False

# Only references to our own names must resolve: nothing is downloaded to resolve the others.
nitpicky = True
nitpick_ignore_regex = [('py:.*', r'(?!(needle_|benchmarks)).*')]
default_role = 'py:obj'
suppress_warnings = ['config.cache']

# Every name is documented in the module that defines it.
viewcode_follow_imported_members = False
autodoc_member_order = 'bysource'
autodoc_typehints = 'none'
# Extras: the pages are made without them.
autodoc_mock_imports = ['distributed', 'gymnasium', 'pyarrow', 'pyigtl']
# numpydoc loads it; our own pages are those of docs/_ext/api.py.
autosummary_generate = False
numpydoc_class_members_toctree = False
numpydoc_show_class_members = False

myst_enable_extensions = ['dollarmath']
myst_heading_anchors = 3
