# SPDX-License-Identifier: Apache-2.0
"""Values of YAML documents."""

from pathlib import Path

from needle_ros.errors import ParameterError
from needle_ros.files import DocumentError, read_document, write_whole
import pytest


def test_links_are_followed_and_devices_are_not_replaced(tmp_path: Path) -> None:
    """A link stays and its target has the new content; a device is not replaced by a file."""
    target, link = tmp_path / 'target', tmp_path / 'link'
    target.write_text('old')
    link.symlink_to(target)
    write_whole(link, b'new')
    assert link.is_symlink()
    assert target.read_text() == 'new'
    for path in (tmp_path, Path('/dev/null')):
        with pytest.raises(ParameterError, match='cannot be written'):
            write_whole(path, b'new')
    assert sorted(one.name for one in tmp_path.iterdir()) == ['link', 'target']


@pytest.mark.parametrize(
    ('text', 'value'),
    [
        ('4e-5', 4e-5),
        ('-1E+3', -1e3),
        ('2.e4', 2e4),
        ('.5e1', 5.0),
        ('1.5e3', 1.5e3),
        ('"4e-5"', '4e-5'),
        ('1e', '1e'),
        ('e5', 'e5'),
        ('12e3x', '12e3x'),
        ('1e-3-1', '1e-3-1'),
    ],
)
def test_numbers_with_an_exponent_are_read(text: str, value: object) -> None:
    """As in YAML 1.2, also without a point or a sign, and within lists and mappings."""
    assert read_document(text) == value
    assert read_document(f'{{a: [{text}, 1]}}') == {'a': [value, 1]}


@pytest.mark.parametrize(
    ('text', 'line'),
    [('vein: {role: obstacle}\nvein: {role: tissue}', 1), ('a: 1\nb:\n  c: 1\n  c: 1', 3)],
)
def test_repeated_key_is_rejected(text: str, line: int) -> None:
    """The last value would silently replace the others."""
    with pytest.raises(
        DocumentError, match=f"the key '[a-z]+' twice in the mapping of line {line}$"
    ):
        read_document(text)
