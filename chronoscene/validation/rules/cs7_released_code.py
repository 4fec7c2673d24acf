"""CS7: scenes on which the released ChronoGS code would fail. ChronoScene itself reads them.

`--ignore CS7` skips all of these rules. Facts on the released loader (commit e73bc9c): DATASET.md.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import PurePosixPath

from chronoscene.formats.chronoscene import SPLIT, TEST
from chronoscene.io.wording import counted, quote, shown
from chronoscene.scene import Camera
from chronoscene.scene.grouping import grouped
from chronoscene.scene.splits import TEST_EVERY
from chronoscene.validation import rule
from chronoscene.validation.folder.pixels import Header
from chronoscene.validation.folder.scene_folder import RawScene, TextFile
from chronoscene.validation.rule import Hit
from chronoscene.validation.rules.cs3_split import test_elsewhere

GREY_MODES = ("1", "L", "LA", "La", "I", "I;16", "I;16B", "I;16L", "I;16N")
"""Pillow's modes without colour."""

OFF_CENTRE = 0.5  # Pixels; half a pixel is a difference of convention, not of the lens


@rule.warning(
    "CS701",
    bad="`a.jpg  0` (two spaces); a tab; an empty line; a name with a space",
    remedy='write "<name> <period>" with one space, no other spaces, no tabs and no empty lines',
)
def official_split_line(scene: RawScene, split_text: TextFile) -> Iterator[Hit]:
    """The official loader would fail on a line of `split.txt`, or read a different period."""
    if split_text.data[:3] == b"\xef\xbb\xbf":
        found = "a byte order mark, which it takes for part of the first name"
        yield Hit(f"{SPLIT}:1", "plain text", found)
    if split_text.data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        yield Hit(SPLIT, "UTF-8 or ASCII", "UTF-16, which it cannot read")
        return
    wrong = {p.line for p in scene.split_problems if p.kind in ("fields", "period")}
    flat = not any("/" in name for name in scene.names)
    lines = re.split("\r\n|\r|\n", split_text.text)
    if lines[-1] == "":  # Python's iteration over a file ends before it
        lines.pop()
    for number, line in enumerate(lines, start=1):
        problem = official_failure(line)
        if problem is None and flat and "/" in line:  # otherwise CS703 reports it
            problem = "a name with folders"
        if problem is not None and number not in wrong:
            yield Hit(f"{SPLIT}:{number}", "<file name> <period>", problem)


def official_failure(line: str) -> str | None:
    """Describe why the official parser fails on a line, which it splits at single spaces."""
    fields = line.strip().split(" ")
    if fields == [""]:
        return "an empty line"
    if len(fields) < 2:
        return "a tab" if "\t" in line else "one field"
    if not re.fullmatch("[0-9]+", fields[1].strip()):
        return "two spaces" if fields[1] == "" else f"{quote(fields[1])} as the second field"
    if len(fields) > 2:
        return f"more than two fields; it reads period {fields[1]} for {quote(fields[0])}"
    return None


@rule.warning(
    "CS702",
    bad="`x/0001.png` and `y/0001.png`; `a.1.png` and `a.2.png`; `0001.jpg` and `0001.png`",
    remedy=f"give all images different file names up to the first dot ({rule.RENAME})",
)
def official_name_collision(scene: RawScene, names: list[str]) -> Iterator[Hit]:
    """Two images are the same to the official loader, which identifies them by their file name up
    to the first dot; the later line of `split.txt` overwrites the earlier one."""
    for key, group in grouped((_cut(name), name) for name in names).items():
        if len(group) > 1:
            found = f"{shown(group)}, all known to it as {quote(key)}"
            files = {PurePosixPath(name).name for name in group}
            if len(files) == 1:
                found += f", and all read from images/{files.pop()}"
            place = scene.model_file("images")
            yield Hit(place, "file names that differ before the first dot", found)


@rule.info(
    "CS703",
    bad="`images/2016/a.jpg`",
    remedy="nothing to do here; flatten the folders to use the scene with the official code, too",
)
def official_folders(names: list[str]) -> Iterator[Hit]:
    """Images are in folders below `images/`; the official loader looks for all of them directly in
    `images/`, and fails on names with folders in `split.txt`."""
    if inside := [name for name in names if "/" in name]:
        found = f"{counted(len(inside), 'image')} in folders: {shown(inside)}"
        yield Hit("images", "no folders", found, count=len(inside))


@rule.warning("CS704", bad="an 8 bit greyscale PNG", remedy="save the image with three channels")
def official_grey(readable: dict[str, Header]) -> Iterator[Hit]:
    """The official loader would fail on a greyscale image."""
    for name, header in readable.items():
        if header.mode in GREY_MODES:
            yield Hit(f"images/{name}", "an image with colours", f"pixels of mode {header.mode}")


@rule.info(
    "CS705",
    bad="cx = 140.8 with a width of 320",
    remedy="nothing to do here; expect worse results from the official code, or crop the images "
    "with chronoscene undistort --center",
)
def official_principal_point(scene: RawScene, usable_cameras: dict[int, Camera]) -> Iterator[Hit]:
    """The principal point is not in the centre of the image; ChronoScene uses it, the official code
    ignores it."""
    for camera in usable_cameras.values():
        dx, dy = camera.K[0, 2] - camera.width / 2, camera.K[1, 2] - camera.height / 2
        if max(abs(dx), abs(dy)) > OFF_CENTRE:
            found = f"an offset of ({dx:+.4g}, {dy:+.4g}) px"
            yield Hit(scene.camera_place(camera), "a principal point in the centre", found)


@rule.info(
    "CS706",
    bad="a scene without `test.txt`",
    remedy="write sparse/0/test.txt, so that everybody uses the same split",
)
def official_default_split(
    scene: RawScene, periods: dict[str, int], tests: set[str]
) -> Iterator[Hit]:
    """Without `test.txt` the official loader takes every 8th of all images, whatever their period:
    a different split from that of ChronoScene."""
    if scene.test is not None or test_elsewhere(scene):
        return  # there is a list, perhaps in the wrong place, which has its own rule
    theirs = set(sorted(periods, key=_cut)[::TEST_EVERY])
    if theirs == tests:
        return
    empty = sorted(set(scene.period_ids) - {periods[n] for n in theirs})
    without = f", none in period {', '.join(map(str, empty))}" if empty else ""
    found = f"{counted(len(theirs), 'other test image')}{without}"
    yield Hit(TEST, "the same split in the official code", found)


def _cut(name: str) -> str:
    """The name by which the official loader identifies an image."""
    return PurePosixPath(name).name.split(".")[0]
