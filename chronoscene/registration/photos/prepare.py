"""Photos as the rest wants them: unique names, pixels as stored, no orientation tag.

COLMAP and our format work on the pixels as stored. An orientation tag would make viewers and other
loaders turn them, so it is set to 1 in a copy, without touching the pixels. Files that COLMAP does
not read in colour are written as PNG. All others are links to the originals.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from PIL import Image

from chronoscene.images.exif import set_upright
from chronoscene.images.store import load_rgb
from chronoscene.io.staging import replacing
from chronoscene.registration.photos.photo import Capture

_ORIENTATION = 0x0112
_PLAIN_MODES = ("RGB", "L")


@dataclass(frozen=True, slots=True)
class Prepared:
    """Captures under their new names, those that are copies of others apart."""

    captures: tuple[Capture, ...]
    digests: dict[str, str]
    """SHA-256 of each original by new name."""
    refused: tuple[tuple[str, int, str], ...]
    remarks: tuple[str, ...]


def content_digests(captures: Sequence[Capture]) -> dict[str, str]:
    """SHA-256 of each file by name."""
    digests = {}
    for capture in captures:
        with capture.path.open("rb") as file:
            digests[capture.name] = hashlib.file_digest(file, "sha256").hexdigest()
    return digests


def drop_copies(captures: Sequence[Capture], digests: dict[str, str]) -> Prepared:
    """Keep one of each photo: the one of the earliest period.

    A photo belongs to one date. The same file in two periods would tie them together with matches
    that mean nothing.
    """
    first: dict[str, Capture] = {}
    kept, refused = [], []
    for capture in sorted(captures, key=lambda c: (c.period, c.name)):
        original = first.setdefault(digests[capture.name], capture)
        if original is capture:
            kept.append(capture)
            continue
        where = "in an earlier period" if original.period != capture.period else "in this period"
        reason = f"the same file as {original.name} {where}: a photo belongs to one date"
        refused.append((capture.name, capture.period, reason))
    kept.sort(key=lambda c: c.name)
    across = sum("earlier period" in reason for *_, reason in refused)
    remarks = [f"{across} photos are copies of photos of an earlier period"] if across else []
    return Prepared(tuple(kept), digests, tuple(refused), tuple(remarks))


def place_photos(captures: Sequence[Capture], folder: Path) -> tuple[list[str], list[str]]:
    """Put all captures below a folder.

    Returns:
        The name of each capture there, and remarks. Names differ only where a file is converted,
        or has blanks in its name.
    """
    names, turned, converted = [], 0, 0
    plain = plain_names([c.name for c in captures])
    for capture, name in zip(captures, plain, strict=True):
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        kind = _kind(capture.path)
        if kind == "convert":
            target = _convert(capture.path, target)
            converted += 1
        elif capture.exif.orientation != 1 and capture.path.suffix.lower() in (".jpg", ".jpeg"):
            _copy_upright(capture.path, target)
            turned += 1
        else:
            link(capture.path, target)
        names.append(target.relative_to(folder).as_posix())
    remarks = []
    if turned:
        remarks.append(f"{turned} photos have an orientation tag: set to 1, pixels left as stored")
    if converted:
        remarks.append(f"{converted} files converted to PNG: no plain 8-bit colours")
    if renamings := sum(a != c.name for a, c in zip(plain, captures, strict=True)):
        remarks.append(f"blanks in {renamings} names replaced by underscores")
    return names, remarks


def plain_names(names: Sequence[str]) -> list[str]:
    """Names without blanks, which COLMAP's lists and other loaders cannot hold; still unique."""
    taken, plain = set(names), []
    for name in names:
        new = re.sub(r"\s", "_", name)
        path = PurePosixPath(new)
        number = 2
        while new != name and new in taken:
            new = str(path.with_stem(f"{path.stem}_{number}"))
            number += 1
        taken.add(new)
        plain.append(new)
    return plain


def renamed(captures: Sequence[Capture], names: Sequence[str]) -> tuple[Capture, ...]:
    """Captures under the names that `place_photos` gave, sorted."""
    changed = [replace(c, name=name) for c, name in zip(captures, names, strict=True)]
    return tuple(sorted(changed, key=lambda c: c.name))


def _kind(path: Path) -> str:
    with Image.open(path) as image:
        plain = image.mode in _PLAIN_MODES and getattr(image, "n_frames", 1) == 1
        turned_tiff = image.format == "TIFF" and image.getexif().get(_ORIENTATION, 1) != 1
    return "keep" if plain and not turned_tiff else "convert"


def _convert(source: Path, target: Path) -> Path:
    target = target.with_name(f"{target.name}.png")
    with replacing(target) as partial:
        Image.fromarray(load_rgb(source)).save(partial, format="PNG")
    return target


def link(source: Path, target: Path) -> None:
    """Make a symbolic link, replacing what is there."""
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    partial.unlink(missing_ok=True)
    partial.symlink_to(source.resolve())
    partial.replace(target)


def _copy_upright(source: Path, target: Path) -> None:
    data = source.read_bytes()
    with replacing(target) as partial:
        partial.write_bytes(set_upright(data) or data)
