# SPDX-License-Identifier: Apache-2.0
"""Render equations as MathML, which browsers display without script and network."""

import re
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.util.math import get_node_equation_number
from sphinx.writers.html5 import HTML5Translator

#: A dotted letter with an index: docutils sets the index below the letter.
DOTTED = re.compile(
    r'<munderover>\s*(<mi>.*</mi>)\s*(<m[in]>.*</m[in]>)\s*(<mo[^>]*>[˙¨]</mo>)\s*</munderover>'
)


def _mathml(node: nodes.Element, *, block: bool) -> str:
    text = node.astext()
    try:
        # Fonts without mathematics draw a marked accent into the letter below it.
        equation = tex2mathml(text, as_block=block).replace(' accent="true"', '')
    except MathError as error:
        raise ExtensionError(f'no MathML for {text!r}: {error}') from None
    return DOTTED.sub(r'<msub><mover>\1\3</mover>\2</msub>', equation)


def visit_inline(translator: HTML5Translator, node: nodes.math) -> None:
    """Write an equation within a line."""
    translator.body.append(_mathml(node, block=False))
    raise nodes.SkipNode


def visit_block(translator: HTML5Translator, node: nodes.math_block) -> None:
    """Write an equation as a separate block."""
    translator.body.append(f'<div class="equation">{_mathml(node, block=True)}')
    if node['number']:
        number = get_node_equation_number(translator, node)
        translator.body.append(f'<span class="eqno">({number})</span>')
    translator.body.append('</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the renderer of HTML pages."""
    app.add_html_math_renderer('mathml', (visit_inline, None), (visit_block, None))
    return {'parallel_read_safe': True, 'parallel_write_safe': True}
