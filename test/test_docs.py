# SPDX-License-Identifier: Apache-2.0
"""README and docs/: names, paths and commands exist, and the tutorial runs as printed."""

from __future__ import annotations

import ast
import doctest
from functools import cache
from importlib import import_module
from importlib.util import find_spec
import inspect
import os
from pathlib import Path
import re
import shlex
import subprocess
import sys
import xml.etree.ElementTree as ET

from needle_insertion import cli
import pytest
import yaml

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    [
        path
        for folder in ('.', 'docs', 'docs/howto', 'docs/results')
        for path in (ROOT / folder).glob('*.md')
    ]
    + [ROOT / folder / 'README.md' for folder in ('bags', 'config', 'examples')]
)
#: The changelog may name removed items.
CURRENT = [page for page in PAGES if page.name != 'CHANGELOG.md']
#: Pages whose `bash` lines are executed, one folder per page, and the beginnings of these lines.
RUN: dict[str, str | tuple[str, ...]] = {
    'README.md': ('needle identify friction ', 'needle steer '),
    'docs/tutorial.md': 'needle ',
    'docs/howto/own-needle.md': 'needle ',
    'docs/howto/own-friction.md': 'needle ',
}


#: Packages with exported names.
PACKAGES = (
    'needle_dynamics',
    'needle_controller',
    'needle_identification',
    'needle_study',
    'needle_planning',
)

#: Python files of all installed packages.
SOURCES = sorted([*ROOT.glob('needle_*/**/*.py'), *ROOT.glob('reproduction/**/*.py')])

#: Modules with examples in their docstrings.
WITH_EXAMPLES = [
    '.'.join(path.relative_to(ROOT).with_suffix('').parts)
    for path in SOURCES
    if '>>> ' in path.read_text(encoding='utf-8')
]


def blocks(text: str, *languages: str) -> list[str]:
    """Return the code blocks of a page in some languages."""
    found = re.findall(r'^```(\w+)\n(.*?)^```', text, flags=re.DOTALL | re.MULTILINE)
    return [body for language, body in found if language in languages]


def command_lines(page: Path, program: str) -> list[str]:
    """Return the command lines of a program on a page."""
    text = page.read_text(encoding='utf-8')
    lines = '\n'.join(blocks(text, 'bash', 'console')).splitlines()
    lines += re.findall(r'^    (\S.*)$', text, flags=re.MULTILINE)
    plain = (line.removeprefix('$ ') for line in lines)
    return [line for line in plain if line.startswith(f'{program} ')]


def is_module(name: str) -> bool:
    """Return whether a dotted name is a module."""
    try:
        return find_spec(name) is not None
    except ModuleNotFoundError:
        # The parent is not a package.
        return False


def exists(name: str) -> bool:
    """Return whether a dotted name is a module or an attribute of a module."""
    parts = name.split('.')
    modules = ['.'.join(parts[:k]) for k in range(len(parts), 0, -1)]
    module = next((one for one in modules if is_module(one)), '')
    found = import_module(module) if module else None
    for part in parts[module.count('.') + 1 :]:
        if not hasattr(found, part):
            return part in getattr(found, '__annotations__', {})
        found = getattr(found, part)
    return found is not None


@cache
def functions_in(file: str) -> set[str]:
    """Return the function names of all test files with a name."""
    return {
        node.name
        for path in (ROOT / 'test').rglob(f'{file}.py')
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8')))
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
    }


def is_test(name: str) -> bool:
    """Return whether a test such as `test_model.test_power_balance` exists."""
    file, _, test = name.partition('.')
    return test in functions_in(file)


def unproved(rows: list[str]) -> list[str]:
    """Return the rows that neither name a test nor contain: not in the package."""
    proof = re.compile(r'`test_\w+\.test_\w+`|not in the package')
    return [row for row in rows if not proof.search(row) or row.count(' | ') < 2]


@pytest.mark.parametrize('module', WITH_EXAMPLES)
def test_docstring_examples_print_the_shown_output(module: str) -> None:
    """Each `>>>` example of a module."""
    found = doctest.testmod(import_module(module), optionflags=doctest.ELLIPSIS)
    assert found.attempted > 0
    assert found.failed == 0


def test_names_in_the_documentation_exist() -> None:
    """Every dotted name of the packages and every test in backticks."""
    files = ('.py', '.yaml', '.md')
    named = [
        (page.name, name)
        for page in CURRENT
        for name in re.findall(r'`((?:needle|test)_\w+(?:\.\w+)+)`', page.read_text('utf-8'))
        if not name.endswith(files)
    ]
    assert len(named) > 150
    assert [
        found for found in named if not (is_test if found[1][0] == 't' else exists)(found[1])
    ] == []


def test_every_equation_and_every_table_has_one_row() -> None:
    """Equations (1) to (19) name a function each, Tables 1 to 3 have a row, every row a test."""
    page = (ROOT / 'docs/equations.md').read_text(encoding='utf-8')
    section = page.partition('## Numbered equations')[2].partition('## ')[0]
    for number in range(1, 20):
        (row,) = [line for line in section.splitlines() if line.startswith(f'| ({number}) |')]
        assert re.search(r'`needle_\w+(\.\w+)+`', row), row
    rows = re.findall(r'^\| (?!no\.|where|table|place|what ).*', page, flags=re.MULTILINE)
    for number in (1, 2, 3):
        assert sum(row.startswith(f'| {number} |') for row in rows) == 1
    assert len(rows) > 80
    assert unproved(rows) == []


def test_wrong_name_is_reported() -> None:
    """The checks above can fail."""
    wrong = ('needle_dynamics.nothing', 'needle_dynamics.model.NeedleModel.nothing', 'none.such')
    assert not any(exists(name) for name in wrong)
    assert not is_test('test_model.test_nothing')
    assert unproved(['| (1) | a law | `needle_dynamics.model` | |']) != []


def test_paths_in_the_documentation_exist() -> None:
    """Every path in backticks below a folder of the repository."""
    folders = {path.name for path in ROOT.iterdir() if path.is_dir() and path.name[0] != '.'}
    made = {'build', 'demo_output', 'install', 'log'}
    missing = []
    for page in CURRENT:
        for path in re.findall(r'`((?:\w+/)+[\w.*]*)`', page.read_text(encoding='utf-8')):
            top = path.partition('/')[0]
            if top in folders - made and '_build' not in path and not list(ROOT.glob(path)):
                missing.append((page.name, path))
    assert missing == []


def test_architecture_names_every_folder_once() -> None:
    """The table of folders lists exactly the folders of the packages."""
    page = (ROOT / 'docs/architecture.md').read_text(encoding='utf-8')
    named = re.findall(r'^\| `((?:\w+/)+)` \|', page, flags=re.MULTILINE)
    assert len(named) == len(set(named))
    assert all((ROOT / name).is_dir() for name in named)
    assert {f'{path.parent.relative_to(ROOT)}/' for path in SOURCES} <= set(named)


def test_links_in_the_documentation_exist() -> None:
    """Every link to a file has an existing target."""
    missing = [
        (page.name, link)
        for page in PAGES
        for link in re.findall(r'\]\((?!\w+:|#)([^)#\s]+)', page.read_text(encoding='utf-8'))
        if not (page.parent / link).exists()
    ]
    assert missing == []


def test_lines_of_the_readme_are_short() -> None:
    """Lines fit into a terminal, and the page is short."""
    lines = (ROOT / 'README.md').read_text(encoding='utf-8').splitlines()
    assert [line for line in lines if len(line) > 120] == []
    assert len(lines) <= 200


def test_commands_in_the_documentation_are_valid(monkeypatch: pytest.MonkeyPatch) -> None:
    """The options of every `needle` command are valid, even if its files do not exist."""
    monkeypatch.chdir(ROOT)
    lines = [line for page in CURRENT for line in command_lines(page, 'needle')]
    assert len(lines) > 20
    for line in lines:
        name, *words = shlex.split(line, comments=True)[1:]
        command = cli._load(name)
        # The shell lists the shipped recordings, by which a command may choose its kind.
        listed = [
            sorted(map(str, Path().glob(word))) if word.startswith('bags/') else [word]
            for word in words
        ]
        completed = getattr(command, 'completed', list)
        words = [name, *completed([one for several in listed for one in several])]
        signed = getattr(command, 'SIGNED', ())
        cli._parser(name, command).parse_args(cli._joined(words, signed))


def test_make_targets_in_the_documentation_exist() -> None:
    """Every `make` command names a target of the Makefile."""
    targets = set(re.findall(r'^([a-z]+):', (ROOT / 'Makefile').read_text(), flags=re.MULTILINE))
    named = {line.split()[1] for page in CURRENT for line in command_lines(page, 'make')}
    assert named <= targets
    assert {'demo', 'test', 'check', 'docs'} <= named


def test_citation_names_the_version() -> None:
    """CITATION.cff has the version of package.xml, and cites the paper."""
    citation = yaml.safe_load((ROOT / 'CITATION.cff').read_text(encoding='utf-8'))
    assert citation['version'] == ET.parse(ROOT / 'package.xml').getroot().findtext('version')  # noqa: S314
    assert citation['references'][0]['doi'] == '10.1142/S1793962313500311'


def test_python_in_the_documentation_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every `python` block runs independently in the root of a clone."""
    monkeypatch.chdir(ROOT)
    found = [body for page in CURRENT for body in blocks(page.read_text('utf-8'), 'python')]
    assert len(found) > 2
    for body in found:
        exec(compile(body, '<block>', 'exec'), {})  # noqa: S102


@pytest.mark.parametrize('name', RUN)
def test_page_runs_as_printed(name: str, tmp_path: Path) -> None:
    """The commands of a page print the shown output in sequence."""
    (tmp_path / 'bags').symlink_to(ROOT / 'bags')
    text = (ROOT / name).read_text(encoding='utf-8')
    lines = '\n'.join(blocks(text, 'bash')).splitlines()
    script = '\n'.join(line for line in lines if line.startswith(RUN[name]))
    needle = f'needle() {{ {sys.executable} -m needle_insertion.cli "$@"; }}'
    done = subprocess.run(
        ['/bin/bash', '-eu', '-c', f'{needle}\n{script}'],
        cwd=tmp_path,
        env={**os.environ, 'PYTHONPATH': str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300.0,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    for shown in blocks(text, 'text'):
        assert shown in done.stdout
    for made in re.findall(r'^- `(\w+[\w/]*\.\w+)`,', text, flags=re.MULTILINE):
        assert (tmp_path / made).is_file(), made


def undocumented(exported: object) -> list[str]:
    """Return an exported function without parameter section, or methods without docstring."""
    if inspect.isfunction(exported):
        functions, section = [exported], 'Parameters\n'
    elif inspect.isclass(exported):
        own = [value for name, value in vars(exported).items() if name[0] != '_']
        functions, section = list(filter(inspect.isfunction, own)), ''
    else:
        return []
    return [
        function.__qualname__
        for function in functions
        if set(inspect.signature(function).parameters) - {'self'}
        and not ((text := inspect.getdoc(function)) and section in text)
    ]


@pytest.mark.parametrize('package', PACKAGES)
def test_exported_functions_describe_their_parameters(package: str) -> None:
    """Sections for functions in `__all__`, and a sentence for methods with parameters."""
    module = import_module(package)
    exported = [getattr(module, name) for name in getattr(module, '__all__', ())]
    assert [name for value in exported for name in undocumented(value)] == []


def test_function_without_parameter_section_is_reported() -> None:
    def function(x: float) -> float:
        """Return x."""
        return x

    class Example:
        def method(self, x: float) -> float:
            return x

        def plain(self) -> None:
            pass

    assert [name.rpartition('.')[2] for name in undocumented(function)] == ['function']
    assert [name.rpartition('.')[2] for name in undocumented(Example)] == ['method']
