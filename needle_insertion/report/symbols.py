# SPDX-License-Identifier: Apache-2.0
"""Typeset symbols in plain text, such as mu_s or q1_dot, for HTML."""

import re
from typing import Final

from markupsafe import escape, Markup

_GREEK: Final = {'mu': 'μ', 'phi': 'φ', 'tau': 'τ', 'theta': 'θ', 'rho': 'ρ', 'omega': 'ω'}
_SYMBOL: Final = re.compile(
    rf'\b({"|".join(_GREEK)}|q(?=\d)|[kfIqcde](?=_))(\d?)(?:_(d?dot))?(?:_(\w{{1,3}}))?\b'
)
#: Combining dots, which follow their letter.
_DOTS: Final = {None: '', 'dot': '\u0307', 'ddot': '\u0308'}
_POWER: Final = re.compile(r'\^(?:([2-4])(?![\d/])|(-?\d+(?:/\d+)?|T\b))')
_MICROMETERS: Final = re.compile(r'(?<=\d )um\b')


def symbols(words: str) -> Markup:
    """Escape a text and typeset its symbols, powers and micrometers."""
    # `escape` makes the text safe: the substitutions insert only tags, letters and digits.
    text = _POWER.sub(_power, _SYMBOL.sub(_symbol, str(escape(words))))
    return Markup(_MICROMETERS.sub('μm', text))  # noqa: S704


def _symbol(found: re.Match[str]) -> str:
    letter, number, dots, index = found.groups()
    below = f'{number}{"," if number and index else ""}{index or ""}'
    subscript = f'<sub>{below}</sub>' if below else ''
    return f'<i>{_GREEK.get(letter, letter)}{_DOTS[dots]}</i>{subscript}'


def _power(found: re.Match[str]) -> str:
    return '⁰¹²³⁴'[int(found[1])] if found[1] else f'<sup>{found[2]}</sup>'
