# SPDX-License-Identifier: Apache-2.0
"""Force sensor samples: offset, noise, saturation, filters, quantization."""

from needle_dynamics.arrays import Array3, Matrix, Vector
from needle_dynamics.compiled.cache import kernel
import numpy as np


@kernel
def straight(before: Vector, now: Vector, wrenches: Matrix) -> None:
    """Fill ``wrenches``, shape (k, 6), with a linear interpolation that ends at ``now``."""
    samples = wrenches.shape[0]
    for j in range(samples):
        # The last sample equals ``now`` to the bit.
        back = (samples - 1.0 - j) / samples
        for i in range(6):
            wrenches[j, i] = now[i] + back * (before[i] - now[i])


@kernel
def sense(
    wrenches: Matrix,
    drawn: Matrix,
    constants: Matrix,
    sections: Matrix,
    memory: Array3,
    offset: Vector,
    zero: Vector,
    reading: Vector,
) -> None:
    """Simulate the k samples of a force sensor since its last reading; write the last sample."""
    # ``wrenches``, shape (k, 6), true means [N, N m]; ``drawn``, shape (k + 1, 6), standard normal
    # numbers: noise of each sample, then the step of the offset; ``constants``, shape (4, 6),
    # deviations of noise and step, range, and resolution (0 for none); ``sections``, shape
    # (filters, 6), in the format of SciPy; ``zero``, shape (6,), the tare. Updated: ``memory`` of
    # the sections, shape (filters, 2, 6), transposed direct form II, and ``offset``, shape (6,).
    samples = wrenches.shape[0]
    for i in range(6):
        noise, limit, count = constants[0, i], constants[2, i], constants[3, i]
        offset[i] += constants[1, i] * drawn[samples, i]
        value = 0.0
        for j in range(samples):
            value = wrenches[j, i] + offset[i] + noise * drawn[j, i]
            value = min(max(value, -limit), limit)
            for k in range(sections.shape[0]):
                x = value
                value = sections[k, 0] * x + memory[k, 0, i]
                memory[k, 0, i] = sections[k, 1] * x - sections[k, 4] * value + memory[k, 1, i]
                memory[k, 1, i] = sections[k, 2] * x - sections[k, 5] * value
        value -= zero[i]
        # + 0.0 removes a negative zero.
        reading[i] = np.rint(value / count) * count + 0.0 if count > 0.0 else value
