# SPDX-License-Identifier: Apache-2.0
"""
Build the Python package `tf2_msgs`, which is not available as a wheel, with rosidl generators.

Run as ``python -m support.tf2_messages FOLDER``; the package is written to the folder. It needs a
C and a C++ compiler and takes some seconds.
"""

from __future__ import annotations

import importlib
import os
from pathlib import Path
import subprocess
import sys
import sysconfig
from typing import Any

import numpy as np

#: Definition of tf2_msgs/msg/TFMessage, without comments.
DEFINITION = 'geometry_msgs/TransformStamped[] transforms\n'

PACKAGE, MESSAGE = 'tf2_msgs', 'TFMessage'
PREFIX = Path(sys.prefix)

#: Compiler by source suffix.
COMPILERS = {'.c': ('gcc',), '.cpp': ('g++', '-std=c++17')}


def generate(folder: Path) -> Path:
    """Write the sources like `rosidl generate`; return the folder of the package."""
    # Path of the generator templates.
    os.environ['AMENT_PREFIX_PATH'] = str(PREFIX)
    made = folder / PACKAGE
    (made / 'msg').mkdir(parents=True)
    (folder / 'msg').mkdir()
    (folder / f'msg/{MESSAGE}.msg').write_text(DEFINITION)
    (made / '__init__.py').touch()

    def of(module: str, name: str) -> Any:
        return getattr(importlib.import_module(module), name)

    source = Path(f'msg/{MESSAGE}.msg')
    of('rosidl_adapter.msg', 'convert_msg_to_idl')(folder, PACKAGE, source, made / 'msg')
    what = (PACKAGE, [f'{made}:msg/{MESSAGE}.idl'], [str(PREFIX / 'share')], made)
    described = of('rosidl_generator_type_description.cli', 'HashTypeDescription')('hash')
    described.generate_type_hashes(*what)
    json = [f'{made}/msg/{MESSAGE}.json']
    of('rosidl_generator_c.cli', 'GenerateC')('c').generate(*what, type_description_files=json)
    fast, looks = 'rosidl_typesupport_fastrtps_c', 'rosidl_typesupport_introspection_c'
    of(f'{fast}.cli', 'GenerateFastRTPSCTypesupport')('fast').generate(*what)
    of(f'{looks}.cli', 'GenerateIntrospectionCTypesupport')('looks').generate(*what)
    for module, name, supports in (
        ('rosidl_typesupport_c', 'GenerateCTypesupport', [fast, looks]),
        ('rosidl_generator_py', 'GeneratePython', ['rosidl_typesupport_c']),
    ):
        kind = of(f'{module}.cli', name)
        kind('all', typesupport_implementations=supports).generate(*what)
    return made


def compile_all(folder: Path, made: Path) -> None:
    """Compile the sources into the extension module and its libraries."""
    includes = [folder, sysconfig.get_paths()['include'], np.get_include(), PREFIX / 'include']
    includes += [path for path in (PREFIX / 'include').iterdir() if path.is_dir()]
    options = ['-O1', '-fPIC', '-w', *(f'-I{path}' for path in includes)]
    objects = {}
    for source in sorted(made.rglob('*.c*')):
        if source.suffix in COMPILERS:
            target = folder / f'{source.name}.o'
            words = [*COMPILERS[source.suffix], *options, '-c', source, '-o', target]
            subprocess.run(list(map(str, words)), check=True)
            objects[source.name] = target
    # The middleware finds type supports by library name; loaded libraries have priority.
    stem = 'tf_message__'
    parts = {
        'generator_c': [f'{stem}functions.c', f'{stem}description.c'],
        'typesupport_fastrtps_c': [f'{stem}type_support_c.cpp'],
        'typesupport_introspection_c': [f'{stem}type_support.c'],
    }
    names = ('generator_c', 'generator_py', 'typesupport_c', *list(parts)[1:])
    libraries = [f'-lgeometry_msgs__rosidl_{name}' for name in names]
    libraries += [f'-lrosidl_{name}' for name in ('runtime_c', *names[2:])]
    places = [f'-L{PREFIX / "lib"}', f'-L{made}', '-Wl,-rpath,$ORIGIN', '-Wl,--no-as-needed']
    places.append(f'-Wl,-rpath,{PREFIX / "lib"}')
    own: list[str] = []

    def link(name: str, files: list[str]) -> None:
        words = ['-shared', f'-Wl,-soname,{name}', '-o', made / name, *map(objects.pop, files)]
        words = [*COMPILERS['.cpp'], *words, *places, *own, *libraries]
        subprocess.run(list(map(str, words)), check=True)

    for part, files in parts.items():
        link(f'lib{PACKAGE}__rosidl_{part}.so', files)
        own.append(f'-l{PACKAGE}__rosidl_{part}')
    ending = sysconfig.get_config_var('EXT_SUFFIX')
    link(f'{PACKAGE}_s__rosidl_typesupport_c{ending}', [*objects])


if __name__ == '__main__':
    target = Path(sys.argv[1]).resolve()
    compile_all(target, generate(target))
