"""Order of drawing: a stable radix sort of depths, so that equal depths keep the input's order."""

# mypy: allow-untyped-defs
# Numba infers the types of kernels.

from __future__ import annotations

import numpy as np
from numba import prange

from chronoscene.rasterizer.cpu.kernel import helper, kernel

DIGIT_BITS = 11


@helper
def _find_range(keys, first, last, found):
    """Count, smallest and largest of the keys that are not negative."""
    count, low, high = 0, np.int64(0x7FFFFFFF), np.int64(-1)
    for i in range(first, last):
        key = np.int64(keys[i])
        if key >= 0:
            count += 1
            low, high = min(low, key), max(high, key)
    found[0], found[1], found[2] = count, low, high


@helper
def _compact(keys, first, last, base, at, pairs):
    """Write (key - base) << 32 | index for the keys that are not negative."""
    for i in range(first, last):
        key = np.int64(keys[i])
        if key >= 0:
            pairs[at] = ((key - base) << 32) | i
            at += 1


@helper
def _count_digits(pairs, first, last, shift, mask, counts):
    counts[:] = 0
    for i in range(first, last):
        counts[(pairs[i] >> shift) & mask] += 1


@helper
def _offsets(counts, digits):
    """Turn counts [threads, digits] into places: by digit, within a digit by thread."""
    total = 0
    for digit in range(digits):
        for t in range(counts.shape[0]):
            count = counts[t, digit]
            counts[t, digit] = total
            total += count


@helper
def _scatter(pairs, first, last, shift, mask, places, target):
    for i in range(first, last):
        pair = pairs[i]
        digit = (pair >> shift) & mask
        target[places[digit]] = pair
        places[digit] += 1


@kernel
def sort_by_depth(threads, keys, counts, pairs, spare):
    """Sort the indices of keys that are not negative by key, then by index.

    Args:
        threads: How many workers to start; each takes one contiguous part.
        keys: Bits of positive float depths, or negative. int32 [N]
        counts: Scratch. int64 [threads, 2048]
        pairs: Scratch. int64 [N]
        spare: Scratch. int64 [N]

    Returns:
        How many, and whether the result is in ``spare`` rather than ``pairs``. The low 32 bits
        of an element are an index.
    """
    n = keys.size
    for t in prange(threads):
        _find_range(keys, n * t // threads, n * (t + 1) // threads, counts[t])
    total, base, top = 0, np.int64(0x7FFFFFFF), np.int64(-1)
    for t in range(threads):
        base, top = min(base, counts[t, 1]), max(top, counts[t, 2])
        count = counts[t, 0]
        counts[t, 0] = total
        total += count
    for t in prange(threads):
        _compact(keys, n * t // threads, n * (t + 1) // threads, base, counts[t, 0], pairs)
    bits = 0
    while top - base >> bits > 0:
        bits += 1
    passes = (bits + DIGIT_BITS - 1) // DIGIT_BITS
    source, target = pairs, spare
    for p in range(passes):
        width = (bits + passes - 1) // passes
        shift, mask = 32 + p * width, (1 << width) - 1
        for t in prange(threads):
            _count_digits(
                source,
                total * t // threads,
                total * (t + 1) // threads,
                shift,
                mask,
                counts[t],
            )
        _offsets(counts, mask + 1)
        for t in prange(threads):
            _scatter(
                source,
                total * t // threads,
                total * (t + 1) // threads,
                shift,
                mask,
                counts[t],
                target,
            )
        source, target = target, source
    return total, passes % 2 == 1
