"""Orientation tags of JPEG files set to upright, in place: no pixel is compressed again.

Source: JFIF (segments) and TIFF 6.0 (directories), as Exif 2.32 puts one into the other.
"""

from __future__ import annotations

import struct

_EXIF = b"Exif\0\0"
_APP1, _START_OF_SCAN = 0xE1, 0xDA
_ORIENTATION, _SHORT = 0x0112, 3
_ENTRY_BYTES = 12


def set_upright(data: bytes) -> bytes | None:
    """The same JPEG with orientation 1, or None if there is no such tag where it should be."""
    at = _find_exif(data)
    if at is None:
        return None
    order = {b"II": "<", b"MM": ">"}.get(data[at : at + 2])
    if order is None:
        return None
    try:
        (offset,) = struct.unpack_from(f"{order}I", data, at + 4)
        (count,) = struct.unpack_from(f"{order}H", data, at + offset)
        for i in range(count):
            entry = at + offset + 2 + _ENTRY_BYTES * i
            tag, kind, length = struct.unpack_from(f"{order}HHI", data, entry)
            if (tag, kind, length) == (_ORIENTATION, _SHORT, 1):
                value = struct.pack(f"{order}H", 1)
                return data[: entry + 8] + value + data[entry + 10 :]
    except struct.error:
        pass  # a directory beyond the end of the file
    return None


def _find_exif(data: bytes) -> int | None:
    """Where the TIFF header in the first Exif segment begins."""
    if data[:2] != b"\xff\xd8":
        return None
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != _START_OF_SCAN:
        (length,) = struct.unpack_from(">H", data, at + 2)
        if data[at + 1] == _APP1 and data.startswith(_EXIF, at + 4):
            return at + 4 + len(_EXIF)
        at += 2 + length
    return None
