"""
Make the Python package `tf2_msgs`, which no wheel has, with the generators that wheels have.

Run as ``python -m support.tf2_messages FOLDER``; the package is then in the folder. It takes a C
and a C++ compiler and some seconds.
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

#: The definition of tf2_msgs/msg/TFMessage, without its comments.
DEFINITION = 'geometry_msgs/TransformStamped[] transforms\n'

PACKAGE, MESSAGE = 'tf2_msgs', 'TFMessage'
PREFIX = Path(sys.prefix)

#: Compiler by ending of the source.
COMPILERS = {'.c': ('gcc',), '.cpp': ('g++', '-std=c++17')}


def generate(folder: Path) -> Path:
    """Write the sources, as `rosidl generate` does; return the folder of the package."""
    # It finds the templates of the generators.
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
    # The only one: it needs no look-up of libraries by name.
    fast = 'rosidl_typesupport_fastrtps_c'
    of(f'{fast}.cli', 'GenerateFastRTPSCTypesupport')('fast').generate(*what)
    for module, name, supports in (
        ('rosidl_typesupport_c', 'GenerateCTypesupport', [fast]),
        ('rosidl_generator_py', 'GeneratePython', ['rosidl_typesupport_c']),
    ):
        kind = of(f'{module}.cli', name)
        kind('all', typesupport_implementations=supports).generate(*what)
    return made


def compile_all(folder: Path, made: Path) -> None:
    """Compile the sources into the extension that the package imports."""
    includes = [folder, sysconfig.get_paths()['include'], np.get_include()]
    includes += [PREFIX / 'include']
    includes += [path for path in (PREFIX / 'include').iterdir() if path.is_dir()]
    options = ['-O1', '-fPIC', '-w', *(f'-I{path}' for path in includes)]
    objects = []
    for source in sorted(made.rglob('*.c*')):
        if source.suffix in COMPILERS:
            target = folder / f'{source.name}.o'
            words = (*COMPILERS[source.suffix], *options, '-c', source, '-o', target)
            subprocess.run(words, check=True)
            objects.append(target)
    own = ('generator_c', 'generator_py', 'typesupport_c', 'typesupport_fastrtps_c')
    libraries = [f'-lgeometry_msgs__rosidl_{name}' for name in own]
    libraries += [f'-lrosidl_{name}' for name in ('runtime_c', *own[2:])]
    name = f'{PACKAGE}_s__rosidl_typesupport_c{sysconfig.get_config_var("EXT_SUFFIX")}'
    places = [f'-L{PREFIX / "lib"}', f'-Wl,-rpath,{PREFIX / "lib"}']
    words = (*COMPILERS['.cpp'], '-shared', '-o', made / name, *objects, *places, *libraries)
    subprocess.run(words, check=True)


if __name__ == '__main__':
    target = Path(sys.argv[1]).resolve()
    compile_all(target, generate(target))
