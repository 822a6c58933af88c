# SPDX-License-Identifier: Apache-2.0
"""What the tests of this folder share."""

from collections.abc import Iterator

import pytest
from reproduction import runs


@pytest.fixture(scope='session', autouse=True)
def brief_inverse_dynamics() -> Iterator[None]:
    """Run figures 6 and 7 up to what they show; after that d alone goes on as exp(-0.05 t)."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(runs.CLOSED_LOOP, 'inverse_dynamics', 40.0)
        yield
