# SPDX-License-Identifier: Apache-2.0
"""Lazy import of the public names of the packages."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
import subprocess
import sys

import pytest

PACKAGES = ['needle_controller', 'needle_dynamics', 'needle_identification']


@pytest.mark.parametrize('package', PACKAGES)
def test_package_import_loads_no_slow_library(package: str) -> None:
    code = f'import sys, {package}; print(*sys.modules)'
    found = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=True
    )
    assert not {'numpy', 'scipy', 'numba', 'rclpy'} & set(found.stdout.split())


def test_identification_from_a_bag_loads_no_slow_library() -> None:
    bag = Path(__file__).parents[2] / 'bags' / 'friction_01'
    code = (
        'import sys; from needle_identification import identify_friction as identify; '
        'from needle_identification import read_friction_recording as read; '
        f'identify(read({str(bag)!r})); print(*sys.modules)'
    )
    found = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=True
    )
    slow = {'matplotlib', 'numba', 'rclpy', 'rosbags', 'scipy.signal', 'scipy.stats'}
    assert not slow & set(found.stdout.split())


@pytest.mark.parametrize('package', PACKAGES)
def test_every_exported_name_can_be_imported(package: str) -> None:
    module = import_module(package)
    assert set(module.__all__) <= set(dir(module))
    for name in module.__all__:
        assert getattr(module, name) is not None
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'nothing'"):
        _ = module.nothing
