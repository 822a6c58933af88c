# SPDX-License-Identifier: Apache-2.0
"""Generate one page in docs/api for each public module of the packages, before Sphinx reads."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from importlib import import_module
from itertools import chain
from math import inf
from pathlib import Path
from pkgutil import iter_modules
import re
import sys
from typing import Any

from docutils.nodes import Element, entry, literal, raw, Text
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.pycode import ModuleAnalyzer
from sphinx.transforms.post_transforms import SphinxPostTransform

PACKAGES = (
    'needle_ros',
    'needle_dynamics',
    'needle_controller',
    'needle_identification',
    'needle_study',
    'needle_planning',
    'needle_insertion',
    'reproduction',
)
SOURCE = Path(__file__).parents[2]


def _title(text: str, line: str = '=') -> str:
    return f'{text}\n{line * len(text)}\n\n'


def _children(name: str) -> list[str]:
    """List the public modules of a package; its name is also its path."""
    path = SOURCE / name.replace('.', '/')
    return [f'{name}.{found.name}' for found in iter_modules([str(path)]) if found.name[0] != '_']


def _home(package: str, name: str) -> str:
    """Return the module that defines a public name of the root of a package."""
    value = getattr(sys.modules[package], name)
    inside = [key for key in sys.modules if key.startswith(f'{package}.')]
    defining = (key for key in inside if name in vars(sys.modules[key]).get('__annotations__', ()))
    return getattr(value, '__module__', None) or next(defining, package)


def _public_names(name: str) -> str:
    """Write the table of the public names of a package with their modules."""
    rows = ''
    for public in getattr(import_module(name), '__all__', ()):
        home = _home(name, public)
        has_page = hasattr(getattr(sys.modules[name], public), '__module__') or (
            # A constant: with a comment `#:` it is on the page of its module.
            ('', public) in ModuleAnalyzer.for_module(home).find_attr_docs()
        )
        where = f':py:obj:`~{home}.{public}`' if has_page else f'``{public}``'
        rows += f'   * - {where}\n     - :py:mod:`{home}`\n'
    if not rows:
        return ''
    return _title('Public names', '-') + f'.. list-table::\n   :align: left\n\n{rows}\n'


def _page(name: str, folder: Path) -> None:
    """Write the page of a module and the pages of its submodules."""
    children = _children(name)
    # Zero-width spaces allow a line break at each dot of a long name.
    text = _title(name.replace('.', '.\u200b')) + f'.. automodule:: {name}\n'
    if children:
        text += '\n' + _public_names(name)
        text += '.. toctree::\n   :maxdepth: 1\n\n'
        text += ''.join(f'   {child.rpartition(".")[2]} <{child}>\n' for child in children)
    else:
        text += '   :members:\n'
    (folder / f'{name}.rst').write_text(text, encoding='utf-8')
    for child in children:
        _page(child, folder)


def write_pages(app: Sphinx) -> None:
    """Write all pages, and delete the pages of earlier modules."""
    folder = Path(app.srcdir) / 'api'
    folder.mkdir(exist_ok=True)
    for old in folder.glob('*.rst'):
        old.unlink()
    for package in PACKAGES:
        _page(package, folder)
    text = _title('Modules') + '.. toctree::\n   :maxdepth: 3\n\n'
    text += ''.join(f'   {package}\n' for package in PACKAGES)
    (folder / 'index.rst').write_text(text, encoding='utf-8')


def _range(meta: Mapping[str, Any]) -> str:
    low = '' if meta['low'] == -inf else f'{">" if meta["open_low"] else ">="} {meta["low"]:g}'
    high = '' if meta['high'] == inf else f'<= {meta["high"]:g}'
    return ', '.join(part for part in (low, high) if part)


def list_fields(
    _app: Sphinx, what: str, _name: str, value: object, _options: object, lines: list[str]
) -> None:
    """Add a table of the fields of settings, with their metadata, to a class docstring."""
    items = fields(value) if what == 'class' and is_dataclass(value) else ()
    described = [item for item in items if 'description' in item.metadata]
    if described:
        lines += ['', '.. list-table::', '   :header-rows: 1', '']
        heads = ('field', 'default', 'unit', 'range', 'meaning')
        rows = [
            (
                f'``{item.name}``',
                f'``{item.default!r}``',
                item.metadata.get('unit', ''),
                _range(item.metadata) if 'low' in item.metadata else '',
                item.metadata['description'],
            )
            for item in described
        ]
        for row in (heads, *rows):
            lines += [f'   {"  -" if k else "* -"} {cell}' for k, cell in enumerate(row)]
        lines.append('')


def resolve(app: Sphinx, env: BuildEnvironment, node: Element, content: Element) -> Element | None:
    """Resolve a reference to a public name of a package to its definition."""
    package, _, name = node.get('reftarget', '').rpartition('.')
    if package not in PACKAGES or name not in getattr(import_module(package), '__all__', ()):
        return None
    target = f'{_home(package, name)}.{name}'
    python = env.get_domain('py')
    return python.resolve_xref(env, node['refdoc'], app.builder, 'obj', target, node, content)


def skip_aliases(
    _app: Sphinx, _what: str, _name: str, value: object, _skip: object, _options: object
) -> bool | None:
    """Skip the fields of named tuples: the signature of their class has them."""
    return True if type(value).__name__ == '_tuplegetter' else None


class Names(SphinxPostTransform):
    """Link the dotted names of a page to their documentation."""

    default_priority = 5

    def run(self, **_arguments: object) -> None:
        """Add links, and allow line breaks at dots and underscores in table columns."""
        documented = self.env.get_domain('py').data['objects']
        for node in list(self.document.findall(literal)):
            name = node.astext()
            package, _, public = name.rpartition('.')
            if package in PACKAGES and public in getattr(import_module(package), '__all__', ()):
                name = f'{_home(package, public)}.{public}'
            if name in documented and 'py' not in node['classes']:
                link = pending_xref(
                    '', refdomain='py', reftype='obj', reftarget=name, refexplicit=False,
                    refdoc=self.env.docname,
                )  # fmt: skip
                node.replace_self(link)
                link += node
        cells = self.document.findall(entry)
        for text in [t for cell in cells for node in cell.findall(literal) for t in node.children]:
            first, *others = re.split(r'(?<=[._])', text.astext())
            parts = [[raw('', '<wbr>', format='html'), Text(part)] for part in others if part]
            text.parent.replace(text, [Text(first), *chain.from_iterable(parts)])


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect the generation of pages and the resolution of references to Sphinx."""
    app.connect('builder-inited', write_pages)
    app.connect('autodoc-process-docstring', list_fields)
    app.connect('autodoc-skip-member', skip_aliases)
    app.add_post_transform(Names)
    app.connect('missing-reference', resolve)
    return {'parallel_read_safe': True, 'parallel_write_safe': True}
