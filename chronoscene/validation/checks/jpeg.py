"""Damage in JPEG files that decoders pass over in silence.

libjpeg makes a picture of almost anything: what a broken transfer filled with zeros decodes to grey
or to stripes, without an error. The structure of the file tells.

Source: ITU-T T.81, annex B (markers) and F.1.2.3 (a 255 in compressed data is followed by a 0).
"""

from __future__ import annotations

import numpy as np

_START, _SCAN, _END = b"\xff\xd8", 0xDA, 0xD9
_RESTART_INTERVAL = 0xDD

_SEGMENTS = frozenset({0xC4, 0xDA, 0xDB, 0xDC, 0xDD, 0xFE, *range(0xE0, 0xF0)})
"""Markers of what may stand between two scans: tables, comments, the next scan."""

PADDING = 64
"""Equal bytes at the end of a file that no compressed data ends in."""


def jpeg_damage(data: bytes) -> str | None:
    """What is wrong with the compressed data of a JPEG file, if that can be seen.

    Args:
        data: The whole file. What comes after the end of its first image does not count.
    """
    at, has_restarts = _first_scan(data)
    if at is None:
        return None  # decoders complain about what has no scan
    codes = np.frombuffer(data, np.uint8)
    marks = np.flatnonzero(codes[at:-1] == 0xFF) + at
    follow = codes[marks + 1]
    plain = (follow == 0) | (follow == 0xFF)
    if has_restarts:
        plain |= (follow >= 0xD0) & (follow <= 0xD7)
    skip = at
    for mark in marks[~plain].tolist():
        marker = data[mark + 1]
        if mark < skip:
            continue
        if marker == _END:
            return None
        if marker not in _SEGMENTS:
            return f"compressed data with an impossible marker at byte {mark}"
        skip = mark + 2 + int.from_bytes(data[mark + 2 : mark + 4])
    if len(set(data[-PADDING:])) == 1:
        return f"no end of the image, and {data[-1]:#04x} in all of the last bytes"
    return None


def has_end(data: bytes) -> bool:
    """Whether the mark that ends an image comes after the compressed data has begun."""
    at, _ = _first_scan(data)
    return at is not None and data.find(bytes((0xFF, _END)), at) >= 0


def _first_scan(data: bytes) -> tuple[int | None, bool]:
    """Where compressed data begins, and whether it is cut by restart markers."""
    at, restarts = len(_START), False
    while data.startswith(_START) and at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # a byte to fill up
            at += 1
            continue
        restarts |= marker == _RESTART_INTERVAL
        at += 2 + int.from_bytes(data[at + 2 : at + 4])
        if marker == _SCAN:
            return at, restarts
    return None, restarts
