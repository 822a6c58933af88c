# SPDX-License-Identifier: Apache-2.0
"""Steering law with a fixed guide, for comparison."""

from needle_controller.steering.law import GuideLaw
from needle_dynamics.arrays import FloatArray


class OpenLoopLaw(GuideLaw):
    """A fixed guide."""

    def choose(self, _tip: FloatArray, _at: int) -> FloatArray:
        return self.guides[-1]
