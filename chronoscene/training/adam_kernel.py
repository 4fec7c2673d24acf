"""One Adam update over a flat float32 array, compiled."""

from __future__ import annotations

import math

from numba import prange
from numpy import float32

from chronoscene.kernels.compilation import kernel

BETA1 = 0.9
BETA2 = 0.999
# Rounded once: 1 - float32(0.999) would be off by 5e-5.
GAIN1 = float32(1 - BETA1)
KEEP2 = float32(BETA2)
GAIN2 = float32(1 - BETA2)

BLOCK = 16384
"""Elements per task. Fixed, so that vector bodies and remainders fall on the same elements, and
results are equal bit by bit, for any number of threads."""

# Moments below these are zero for every practical purpose: the update that they cause is under
# 1e-18 of a learning rate. Left to decay they end up as denormals, which are slow on many CPUs.
TINY_MEAN = float32(1e-34)
TINY_SQUARE = float32(1e-37)


@kernel(fastmath={"contract", "nsz", "arcp"})
def adam_block(values, grads, means, squares, rate, root, eps):  # type: ignore[no-untyped-def]
    """Update a flat array in place.

    mean += (1 - BETA1) (grad - mean);  square = BETA2 square + (1 - BETA2) grad²;
    value -= rate * mean / (sqrt(square) * root + eps).

    Args:
        rate: Learning rate over the bias correction of the first moment.
        root: 1 over the root of the bias correction of the second moment.
    """
    zero = float32(0)
    for i in range(values.shape[0]):
        grad = grads[i]
        mean = means[i] + GAIN1 * (grad - means[i])
        square = KEEP2 * squares[i] + GAIN2 * grad * grad
        mean = zero if abs(mean) < TINY_MEAN else mean
        square = zero if square < TINY_SQUARE else square
        values[i] -= rate * mean / (math.sqrt(square) * root + eps)
        means[i] = mean
        squares[i] = square


@kernel(parallel=True)
def adam_blocks(values, grads, means, squares, rate, root, eps):  # type: ignore[no-untyped-def]
    """Update a large flat array in place, blocks spread over the threads."""
    size = values.shape[0]
    for block in prange((size + BLOCK - 1) // BLOCK):
        # Slices: an index that is counted from 0 is known not to wrap, so the loop vectorises.
        part = slice(block * BLOCK, min((block + 1) * BLOCK, size))
        adam_block(values[part], grads[part], means[part], squares[part], rate, root, eps)
