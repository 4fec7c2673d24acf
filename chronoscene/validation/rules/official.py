"""CS7: what the released ChronoGS code would trip over. The scene is fine here.

`--ignore CS7` leaves all of them out. Facts on the released loader (commit e73bc9c): DATASET.md.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from chronoscene.formats.chronoscene import SPLIT, TEST
from chronoscene.io.wording import counted, quote, shown
from chronoscene.scene.splits import TEST_EVERY
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.rules.image_files import GREY_MODES
from chronoscene.validation.rules.test_list import ELSEWHERE
from chronoscene.validation.scene_folder import RawScene

VOXEL, NEAR = 0.001, 0.2
"""World units; constants of the released code, and of 3D Gaussian splatting."""

LOST = 0.1
"""Share of points or observations that is worth a word."""

SAMPLE = 10_000
"""Points from which the extent of the scene is taken."""

CROWDED = 10
"""Points lie on surfaces: on a square of side a, n points are about a / sqrt(n) apart. Where that
is so many voxels, no two of them share one."""

OFF_CENTRE = 0.5
"""Pixels; half a pixel is a difference of convention, not of the lens."""


@rule(
    "CS701",
    "official-split-line",
    "warning",
    what="The official loader would fail on a line of `split.txt`, or read another period.",
    remedy='write "<name> <period>" with one blank, no other blanks, no tabs and no empty lines',
    bad="`a.jpg  0` (two blanks); a tab; an empty line; a name with a blank",
    needs=("split_text",),
)
def official_split_line(scene: RawScene) -> Iterator[Hit]:
    assert scene.split_text is not None
    if scene.split_text.data[:3] == b"\xef\xbb\xbf":
        yield Hit(f"{SPLIT}:1", "plain text", "a byte order mark, part of the first name to it")
    if scene.split_text.data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        yield Hit(SPLIT, "UTF-8 or ASCII", "UTF-16, which it does not read")
        return
    wrong = {p.line for p in scene.split_problems if p.kind in ("fields", "period")}
    flat = not any("/" in name for name in scene.names)
    for number, line in enumerate(_lines(scene.split_text.text), start=1):
        problem = official_failure(line)
        if problem is None and flat and "/" in line:  # else they have their own rule
            problem = "a name with folders"
        if problem is not None and number not in wrong:
            yield Hit(f"{SPLIT}:{number}", "<file name> <period>", problem)


def official_failure(line: str) -> str | None:
    """What stops the official parser in a line: it strips it, then splits at single blanks."""
    fields = line.strip().split(" ")
    if fields == [""]:
        return "an empty line"
    if len(fields) < 2:
        return "a tab" if "\t" in line else "one field"
    if not re.fullmatch("[0-9]+", fields[1].strip()):
        return "two blanks" if fields[1] == "" else f"{quote(fields[1])} as its second field"
    if len(fields) > 2:
        return f"more fields; it reads period {fields[1]} for {quote(fields[0])}"
    return None


@rule(
    "CS702",
    "official-name-collision",
    "warning",
    what="Two images are one to the official loader, which knows them by their file name up to the "
    "first dot; the later line of `split.txt` overwrites the earlier one.",
    remedy="give all images different file names up to the first dot",
    bad="`x/0001.png` and `y/0001.png`; `a.1.png` and `a.2.png`; `0001.jpg` and `0001.png`",
    needs=("images",),
)
def official_name_collision(scene: RawScene) -> Iterator[Hit]:
    groups: dict[str, list[str]] = {}
    for name in scene.names:
        groups.setdefault(_cut(name), []).append(name)
    for key, names in groups.items():
        if len(names) > 1:
            found = f"{shown(names)}, all {quote(key)} to it"
            files = {PurePosixPath(name).name for name in names}
            if len(files) == 1:
                found += f", and all read from images/{files.pop()}"
            place = scene.model_file("images")
            yield Hit(place, "file names that differ before the first dot", found)


@rule(
    "CS703",
    "official-folders",
    "info",
    what="Images are in folders below `images/`; the official loader looks for all of them "
    "directly in `images/`, and fails on names with folders in `split.txt`.",
    remedy="nothing to do here; flatten the folders to use the scene with the official code too",
    bad="`images/2016/a.jpg`",
    needs=("images",),
)
def official_folders(scene: RawScene) -> Iterator[Hit]:
    inside = [name for name in scene.names if "/" in name]
    if inside:
        found = f"{counted(len(inside), 'image')} in folders: {shown(inside)}"
        yield Hit("images", "no folders", found, count=len(inside))


@rule(
    "CS704",
    "official-grey",
    "warning",
    what="The official loader would fail on a grey image.",
    remedy="save the image with three channels",
    bad="an 8 bit grey PNG",
    needs=("images",),
)
def official_grey(scene: RawScene) -> Iterator[Hit]:
    for name, header in scene.headers.items():
        if header.problem is None and header.mode in GREY_MODES:
            yield Hit(f"images/{name}", "an image with colours", f"pixels of kind {header.mode}")


@rule(
    "CS705",
    "official-principal-point",
    "info",
    what="The principal point is off the centre; it is used here, the official code ignores it.",
    remedy="nothing to do here; expect the official code to be worse on this scene",
    bad="cx = 140.8 with a width of 320",
    needs=("cameras",),
)
def official_principal_point(scene: RawScene) -> Iterator[Hit]:
    for camera in scene.usable_cameras.values():
        dx, dy = camera.K[0, 2] - camera.width / 2, camera.K[1, 2] - camera.height / 2
        if max(abs(dx), abs(dy)) > OFF_CENTRE:
            place = f"{scene.model_file('cameras')} (camera {camera.camera_id})"
            found = f"({dx:+.4g}, {dy:+.4g}) px from it"
            yield Hit(place, "a principal point in the centre", found)


@rule(
    "CS706",
    "official-default-split",
    "info",
    what="Without `test.txt` the official loader takes every 8th of all images, whatever their "
    "period: another split than ours.",
    remedy="write sparse/0/test.txt, so that everybody has the same split",
    bad="a scene without `test.txt`",
    needs=("tests",),
)
def official_default_split(scene: RawScene) -> Iterator[Hit]:
    assert scene.periods is not None and scene.tests is not None
    if scene.test is not None or any((scene.root / place).is_file() for place in ELSEWHERE):
        return  # there is a list, perhaps in a wrong place, which is reported
    theirs = set(sorted(scene.periods, key=_cut)[::TEST_EVERY])
    if theirs == scene.tests:
        return
    empty = sorted(set(scene.period_ids) - {scene.periods[n] for n in theirs})
    without = f", none in period {', '.join(map(str, empty))}" if empty else ""
    found = f"{counted(len(theirs), 'other test image')}{without}"
    yield Hit(TEST, "the same split in the official code", found)


@rule(
    "CS707",
    "official-units",
    "info",
    what="The scene is in small units for the released code, whose voxels have an edge of 0.001 "
    "world units; the code of 3D Gaussian splatting drops what is nearer to the camera than 0.2.",
    remedy="nothing to do here; scale the scene up, or set the voxel size, for the released code",
    bad="a city in units of 100 m",
    needs=("points",),
)
def official_units(scene: RawScene) -> Iterator[Hit]:
    points = scene.points
    assert points is not None
    xyz = points.xyz[np.isfinite(points.xyz).all(axis=1)]
    if _is_small(xyz):
        cells = len(np.unique(np.round(xyz / VOXEL), axis=0))
        if cells < (1 - LOST) * len(xyz):
            found = f"{cells} for {len(xyz)} points"
            yield Hit(scene.model_file("points3D"), f"a voxel of {VOXEL:g} for each point", found)
    depth = np.concatenate([np.zeros(0), *(s.depth for s in scene.reprojections or ())])
    near = int(np.count_nonzero((depth > 0) & (depth < NEAR)))
    if near > LOST * len(depth):
        found = f"{near} of {len(depth)} nearer"
        expected = f"observations {NEAR:g} world units or more from the camera"
        yield Hit(scene.model_file("points3D"), expected, found, count=near)


def _is_small(xyz: NDArray[np.float64]) -> bool:
    """Whether so many points could share voxels at all: saves the sorting of large scenes."""
    if len(xyz) < 2:
        return False
    low, high = np.percentile(xyz[:: len(xyz) // SAMPLE + 1], [5, 95], axis=0)
    return bool(np.max(high - low) < VOXEL * len(xyz) ** 0.5 * CROWDED)


def _cut(name: str) -> str:
    """What the official loader knows an image by."""
    return PurePosixPath(name).name.split(".")[0]


def _lines(text: str) -> list[str]:
    """Lines as Python's file iteration gives them: no empty one after the last line break."""
    lines = re.split("\r\n|\r|\n", text)
    return lines[:-1] if lines[-1] == "" else lines
