"""CS107 and CS11: the names of images."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import PurePosixPath

from chronoscene.io.wording import counted, quote, shown
from chronoscene.validation.checks.spelling import spelling
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.scene_folder import RawScene, is_safe

FORBIDDEN = re.compile(r'[<>:"|?*\\]|[ .]$')
"""What a file or folder name cannot have, or end in, on Windows (Microsoft, *Naming Files, Paths,
and Namespaces*)."""

DEVICES = re.compile(r"(con|prn|aux|nul|com[0-9]|lpt[0-9])(\..*)?", re.IGNORECASE)
"""Names that Windows keeps for devices, with any extension."""

LONGEST = 255
"""Bytes of a name on most file systems."""


@rule(
    "CS107",
    "duplicate-name",
    "error",
    what="Two images of the model have the same name.",
    remedy="keep one of them; if they are two photos, rename one file and register it again",
    bad="`a.jpg` with image id 1 and with image id 2",
    needs=("images",),
)
def duplicate_name(scene: RawScene) -> Iterator[Hit]:
    assert scene.images is not None
    for name, times in Counter(scene.images.names).items():
        if times > 1:
            yield Hit(scene.model_file("images"), "each name once", f"{quote(name)} {times} times")


@rule(
    "CS111",
    "name-leaves-folder",
    "error",
    what="An image name is empty or leads out of `images/`.",
    remedy="rename the image in the model to its path below images/",
    bad="`../other/a.jpg`, `/home/me/a.jpg`",
    needs=("images",),
)
def name_leaves_folder(scene: RawScene) -> Iterator[Hit]:
    assert scene.images is not None
    for name in scene.images.names:
        if not is_safe(name):
            yield Hit(scene.model_file("images"), "image names below images/", quote(name))


@rule(
    "CS112",
    "name-not-text",
    "error",
    what="An image name is not UTF-8, or contains control characters.",
    remedy="rename the file and the image in the model, with letters and digits",
    bad="a name in Latin-1; a name with a line break",
    needs=("images",),
)
def name_not_text(scene: RawScene) -> Iterator[Hit]:
    assert scene.images is not None
    for name in scene.images.names:
        if any(ord(c) < 32 or ord(c) == 127 or 0xD800 <= ord(c) < 0xE000 for c in name):
            place = scene.model_file("images")
            yield Hit(place, "names in UTF-8 without control characters", quote(name))


@rule(
    "CS113",
    "name-case-collision",
    "warning",
    what="Image names differ only by case or by how Unicode writes them: one file on the disks of "
    "Windows and macOS, so that a copy or a checkout of the scene loses an image.",
    remedy="rename one of the files, in images/ and in the model",
    bad="`IMG_1.jpg` and `img_1.JPG`; `é` as one character and as two",
    needs=("images",),
)
def name_case_collision(scene: RawScene) -> Iterator[Hit]:
    groups: dict[str, list[str]] = {}
    for name in scene.names:
        groups.setdefault(spelling(name), []).append(name)
    for group in groups.values():
        if len(group) > 1:
            place = scene.model_file("images")
            yield Hit(place, "names that differ by more than case", shown(sorted(group)))


@rule(
    "CS114",
    "name-not-portable",
    "info",
    what="Image names that other systems cannot store: characters that Windows refuses, a blank or "
    "a dot at the end, names of devices, or more than 255 bytes.",
    remedy="nothing to do here; rename the files, in images/ and in the model, to share the scene",
    bad="`2016-05-03T12:00:00.jpg`; `aux.png`",
    needs=("images",),
)
def name_not_portable(scene: RawScene) -> Iterator[Hit]:
    names = [name for name in scene.names if not is_portable(name)]
    if names:
        found = f"{counted(len(names), 'name')} that others cannot: {shown(names)}"
        yield Hit("images", "names that all systems can store", found, count=len(names))


def is_portable(name: str) -> bool:
    """Whether the common systems can store a file of this name, folders included."""
    return not any(
        FORBIDDEN.search(part)
        or DEVICES.fullmatch(part)
        or len(part.encode("utf-8", "surrogateescape")) > LONGEST
        for part in PurePosixPath(name).parts
    )
