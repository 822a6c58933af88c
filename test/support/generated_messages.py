# SPDX-License-Identifier: Apache-2.0
"""
Build Python packages of messages that are not available as wheels, with rosidl generators.

Run as ``python -m support.generated_messages PACKAGE FOLDER``; the package is written to the
folder. It needs a C and a C++ compiler and takes some seconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import importlib
from importlib.util import find_spec
import os
from pathlib import Path
import shutil
import subprocess
import sys
import sysconfig
from typing import Any, Final, NamedTuple

import numpy as np
import pytest

_TOLERANCE: Final = 'float64 position\nfloat64 velocity\nfloat64 acceleration\n'


class Definition(NamedTuple):
    """Definitions of a package by file, without comments, and the packages that they need."""

    files: dict[str, str]
    needs: tuple[str, ...]


#: Packages as in ROS 2 Jazzy.
PACKAGES: Final = {
    'tf2_msgs': Definition(
        {'msg/TFMessage.msg': 'geometry_msgs/TransformStamped[] transforms\n'}, ('geometry_msgs',)
    ),
    'control_msgs': Definition(
        {
            'msg/JointTolerance.msg': f'string name\n{_TOLERANCE}',
            'msg/JointComponentTolerance.msg': (
                'uint16 X_AXIS=1\nuint16 Y_AXIS=2\nuint16 Z_AXIS=3\nuint16 TRANSLATION=4\n'
                f'uint16 ROTATION=5\nstring joint_name\nuint16 component\n{_TOLERANCE}'
            ),
            'action/FollowJointTrajectory.action': """\
trajectory_msgs/JointTrajectory trajectory
trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory
JointTolerance[] path_tolerance
JointComponentTolerance[] component_path_tolerance
JointTolerance[] goal_tolerance
JointComponentTolerance[] component_goal_tolerance
builtin_interfaces/Duration goal_time_tolerance
---
int32 error_code
int32 SUCCESSFUL = 0
int32 INVALID_GOAL = -1
int32 INVALID_JOINTS = -2
int32 OLD_HEADER_TIMESTAMP = -3
int32 PATH_TOLERANCE_VIOLATED = -4
int32 GOAL_TOLERANCE_VIOLATED = -5
string error_string
---
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint desired
trajectory_msgs/JointTrajectoryPoint actual
trajectory_msgs/JointTrajectoryPoint error
string[] multi_dof_joint_names
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_desired
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_actual
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_error
""",
        },
        (
            'trajectory_msgs',
            'geometry_msgs',
            'std_msgs',
            'action_msgs',
            'unique_identifier_msgs',
            'service_msgs',
            'builtin_interfaces',
        ),
    ),
}
PREFIX = Path(sys.prefix)

#: Folder of the sources of the introspection.
_INTROSPECTION: Final = 'introspection'

#: Compiler by source suffix.
COMPILERS = {'.c': ('gcc',), '.cpp': ('g++', '-std=c++17')}


def generate(package: str, folder: Path) -> Path:
    """Write the sources like `rosidl generate`; return the folder of the package."""
    # Path of the generator templates.
    os.environ['AMENT_PREFIX_PATH'] = str(PREFIX)
    made = folder / package
    made.mkdir(parents=True)
    (made / '__init__.py').touch()

    def of(module: str, name: str) -> Any:
        return getattr(importlib.import_module(module), name)

    written = []
    for name, text in PACKAGES[package].files.items():
        source = Path(name)
        (folder / source).parent.mkdir(exist_ok=True)
        (made / source).parent.mkdir(exist_ok=True)
        (folder / source).write_text(text)
        kind = source.suffix[1:]
        convert = of(f'rosidl_adapter.{kind}', f'convert_{kind}_to_idl')
        convert(folder, package, source, (made / source).parent)
        written.append(f'{made}:{source.with_suffix(".idl")}')
    what = (package, written, [str(PREFIX / 'share')], made)
    described = of('rosidl_generator_type_description.cli', 'HashTypeDescription')('hash')
    described.generate_type_hashes(*what)
    json = [str(made / Path(name).with_suffix('.json')) for name in PACKAGES[package].files]
    of('rosidl_generator_c.cli', 'GenerateC')('c').generate(*what, type_description_files=json)
    fast, looks = 'rosidl_typesupport_fastrtps_c', 'rosidl_typesupport_introspection_c'
    of(f'{fast}.cli', 'GenerateFastRTPSCTypesupport')('fast').generate(*what)
    # Its sources have the names of the sources of rosidl_generator_c.
    apart = (*what[:3], folder / _INTROSPECTION / package)
    of(f'{looks}.cli', 'GenerateIntrospectionCTypesupport')('looks').generate(*apart)
    for module, name, supports in (
        ('rosidl_typesupport_c', 'GenerateCTypesupport', [fast, looks]),
        ('rosidl_generator_py', 'GeneratePython', ['rosidl_typesupport_c']),
    ):
        kind = of(f'{module}.cli', name)
        kind('all', typesupport_implementations=supports).generate(*what)
    return made


def compile_all(package: str, folder: Path, made: Path) -> None:
    """Compile the sources into the extension module and its libraries."""
    includes = [
        folder,
        folder / _INTROSPECTION,
        sysconfig.get_paths()['include'],
        np.get_include(),
        PREFIX / 'include',
    ]
    includes += [path for path in (PREFIX / 'include').iterdir() if path.is_dir()]
    options = ['-O1', '-fPIC', '-w', *(f'-I{path}' for path in includes)]
    objects: dict[Path, Path] = {}
    for source in sorted(folder.rglob('*.c*')):
        if source.suffix in COMPILERS:
            name = source.relative_to(folder)
            target = folder / f'{str(name).replace("/", "-")}.o'
            words = [*COMPILERS[source.suffix], *options, '-c', source, '-o', target]
            subprocess.run(list(map(str, words)), check=True)
            objects[name] = target
    # The middleware finds type supports by library name; loaded libraries have priority.
    patterns = {
        'generator_c': f'{package}/*/detail/*.c',
        'typesupport_c': f'{package}/*/*__type_support.cpp',
        'typesupport_fastrtps_c': f'{package}/*/detail/*__type_support_c.cpp',
        'typesupport_introspection_c': f'{_INTROSPECTION}/{package}/*/detail/*.c',
    }
    names = (*patterns, 'generator_py')
    libraries = [f'-l{need}__rosidl_{n}' for need in PACKAGES[package].needs for n in names]
    libraries += [f'-lrosidl_{name}' for name in ('runtime_c', *list(patterns)[1:])]
    places = [f'-L{PREFIX / "lib"}', f'-L{made}', '-Wl,-rpath,$ORIGIN', '-Wl,--no-as-needed']
    places.append(f'-Wl,-rpath,{PREFIX / "lib"}')
    own: list[str] = []

    def link(name: str, files: list[Path]) -> None:
        words = ['-shared', f'-Wl,-soname,{name}', '-o', made / name, *map(objects.pop, files)]
        words = [*COMPILERS['.cpp'], *words, *places, *own, *libraries]
        subprocess.run(list(map(str, words)), check=True)

    for part, pattern in patterns.items():
        sources = [path.relative_to(folder) for path in folder.glob(pattern)]
        link(f'lib{package}__rosidl_{part}.so', sources)
        own.append(f'-l{package}__rosidl_{part}')
    ending = sysconfig.get_config_var('EXT_SUFFIX')
    link(f'{package}_s__rosidl_typesupport_c{ending}', [*objects])


@contextmanager
def importable(package: str, folder: Path) -> Iterator[str]:
    """
    Put a package on the path, built in a folder if it is not installed; skip without a compiler.

    Yields the entry of the path for other processes, '' for an installed package.
    """
    if find_spec(package):
        yield ''
        return
    if not (shutil.which('gcc') and shutil.which('g++')):
        pytest.skip(f'neither {package} nor a compiler to make it')
    words = [sys.executable, '-m', __name__, package, str(folder)]
    subprocess.run(words, cwd=Path(__file__).parents[1], check=True, stdout=subprocess.DEVNULL)
    sys.path.insert(0, str(folder))
    yield str(folder)
    sys.path.remove(str(folder))
    # Nodes of other tests must not find it.
    for name in [name for name in sys.modules if name.partition('.')[0] == package]:
        del sys.modules[name]


if __name__ == '__main__':
    chosen, target = sys.argv[1], Path(sys.argv[2]).resolve()
    compile_all(chosen, target, generate(chosen, target))
