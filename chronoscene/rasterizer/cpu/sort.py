"""Order of drawing: a stable radix sort of depths, so that equal depths keep the input's order."""

from __future__ import annotations

import numpy as np

from chronoscene.kernels.compilation import inner
from chronoscene.kernels.thread_pool import draw, finish, wait_for

DIGIT_BITS = 11
SORT_PHASES = 3 + 3 * 3  # Keys have 31 bits


@inner(fast_math=True)
def _find_range(keys, first, last, found):
    """Count, smallest and largest of the keys that are not negative."""
    count, low, high = 0, np.int64(0x7FFFFFFF), np.int64(-1)
    for i in range(first, last):
        key = np.int64(keys[i])
        if key >= 0:
            count += 1
            low, high = min(low, key), max(high, key)
    found[0], found[1], found[2] = count, low, high


@inner(fast_math=True)
def _compact(keys, first, last, base, at, pairs):
    """Write (key - base) << 32 | index for the keys that are not negative."""
    for i in range(first, last):
        key = np.int64(keys[i])
        if key >= 0:
            pairs[at] = ((key - base) << 32) | i
            at += 1


@inner(fast_math=True)
def _count_digits(pairs, first, last, shift, mask, counts):
    counts[:] = 0
    for i in range(first, last):
        counts[(pairs[i] >> shift) & mask] += 1


@inner(fast_math=True)
def _scatter(pairs, first, last, shift, mask, places, target):
    for i in range(first, last):
        pair = pairs[i]
        digit = (pair >> shift) & mask
        target[places[digit]] = pair
        places[digit] += 1


@inner(fast_math=True)
def _merge_ranges(counts, result):
    """Turn the counts of the parts into places. Result: total, smallest key, bits of the range."""
    total, base, top = 0, np.int64(0x7FFFFFFF), np.int64(-1)
    for part in range(counts.shape[0]):
        count = counts[part, 0]
        base, top = min(base, counts[part, 1]), max(top, counts[part, 2])
        counts[part, 0] = total
        total += count
    bits = 0
    while top - base >> bits > 0:
        bits += 1
    result[0], result[1], result[2] = total, base, bits


@inner(fast_math=True)
def _digit_offsets(counts, digits):
    """Turn counts [parts, digits] into places: by digit, within a digit by part."""
    total = 0
    for digit in range(digits):
        for part in range(counts.shape[0]):
            count = counts[part, digit]
            counts[part, digit] = total
            total += count


@inner(fast_math=True)
def sort_phases(control, phase, keys, counts, pairs, spare, result):
    """Sort the indices of keys that are not negative by key, then by index.

    Takes part in up to `SORT_PHASES` phases.

    Args:
        control, phase: See `thread_pool`; the first phase that is free.
        keys: Bits of positive float depths, or negative. int32 [N]
        counts: Scratch; the work is cut into as many parts as it has rows. int64 [parts, 2048]
        pairs, spare: Scratch; the order is in the low 32 bits of one of them. int64 [N]
        result: Written: how many, scratch, scratch. int64 [3]

    Returns:
        The next free phase, and whether the order is in ``spare``.
    """
    n, parts = keys.size, counts.shape[0]
    part = draw(control, phase)
    while part < parts:
        _find_range(keys, n * part // parts, n * (part + 1) // parts, counts[part])
        finish(control, phase)
        part = draw(control, phase)
    wait_for(control, phase, parts)
    if draw(control, phase + 1) == 0:
        _merge_ranges(counts, result)
        finish(control, phase + 1)
    wait_for(control, phase + 1, 1)
    part = draw(control, phase + 2)
    while part < parts:
        first, last = n * part // parts, n * (part + 1) // parts
        _compact(keys, first, last, result[1], counts[part, 0], pairs)
        finish(control, phase + 2)
        part = draw(control, phase + 2)
    wait_for(control, phase + 2, parts)
    phase += 3
    total, bits = result[0], result[2]
    passes = (bits + DIGIT_BITS - 1) // DIGIT_BITS
    source, target = pairs, spare
    for p in range(passes):
        width = (bits + passes - 1) // passes
        _sort_pass(control, phase, source, target, total, 32 + p * width, (1 << width) - 1, counts)
        source, target = target, source
        phase += 3
    return phase, passes % 2 == 1


@inner(fast_math=True)
def _sort_pass(control, phase, source, target, total, shift, mask, counts):
    """Three phases: move the pairs to the places of one digit."""
    parts = counts.shape[0]
    part = draw(control, phase)
    while part < parts:
        first, last = total * part // parts, total * (part + 1) // parts
        _count_digits(source, first, last, shift, mask, counts[part])
        finish(control, phase)
        part = draw(control, phase)
    wait_for(control, phase, parts)
    if draw(control, phase + 1) == 0:
        _digit_offsets(counts, mask + 1)
        finish(control, phase + 1)
    wait_for(control, phase + 1, 1)
    part = draw(control, phase + 2)
    while part < parts:
        first, last = total * part // parts, total * (part + 1) // parts
        _scatter(source, first, last, shift, mask, counts[part], target)
        finish(control, phase + 2)
        part = draw(control, phase + 2)
    wait_for(control, phase + 2, parts)
