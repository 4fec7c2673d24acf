"""CS6: the same photo twice: in train and test, in two periods, or just twice.

Equal bytes are looked for always, equal pixels and near copies with ``--decode``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from chronoscene.validation.finding import Hit, shown
from chronoscene.validation.pixels import Pixels
from chronoscene.validation.raw_scene import RawScene
from chronoscene.validation.rule import rule

NEAR = 3.0
"""Root mean square difference of two thumbnails in grey levels 0..255. Measured: photos saved again
as JPEG differ by 0.1 to 1.8 (quality 50 and more), neighbouring frames of a video by 9 and more,
aerial photos of one flight by 30 and more."""

FEATURELESS = 4.0
"""Standard deviation of a thumbnail below which it looks like any other one."""

_ROWS = 256


@rule(
    "CS601",
    "leak-train-test",
    "error",
    what="A test image is also a training image (same bytes, or with `--decode` same pixels).",
    remedy="remove one of the images from the model",
    bad="`a.jpg` and its copy `a_copy.jpg`, of which one is in `test.txt`",
    needs=("tests",),
)
def leak_train_test(scene: RawScene) -> Iterator[Hit]:
    assert scene.tests is not None
    for kind, group in _equal(scene):
        train = [n for n in group if n not in scene.tests]
        test = [n for n in group if n in scene.tests]
        if train and test:
            found = f"the same {kind} in training: {shown(train)}"
            yield Hit(f"images/{test[0]}", "a test image that no training image equals", found)


@rule(
    "CS602",
    "leak-periods",
    "error",
    what="The same photo is in two periods (same bytes, or with `--decode` same pixels).",
    remedy="keep the image in the period in which it was taken",
    bad="a folder of 2016 copied into the folder of 2023",
    needs=("periods",),
)
def leak_periods(scene: RawScene) -> Iterator[Hit]:
    assert scene.periods is not None
    for kind, group in _equal(scene):
        periods = {scene.periods[n] for n in group}
        if len(periods) > 1:
            listed = " and ".join(map(str, sorted(periods)))
            found = f"the same {kind} in periods {listed}: {shown(group)}"
            yield Hit(f"images/{group[0]}", "an image of one period", found)


@rule(
    "CS603",
    "image-twice",
    "warning",
    what="The same photo is there twice, in one period and both in train or both in test.",
    remedy="remove one of the images from the model",
    bad="`a.jpg` and `a_copy.jpg`",
    needs=("tests",),
)
def image_twice(scene: RawScene) -> Iterator[Hit]:
    assert scene.periods is not None and scene.tests is not None
    for kind, group in _equal(scene):
        roles = {(scene.periods[n], n in scene.tests) for n in group}
        if len(roles) == 1:
            found = f"the same {kind} in {shown(group[1:])}"
            yield Hit(f"images/{group[0]}", "an image that no other equals", found)


@rule(
    "CS604",
    "near-leak",
    "warning",
    what="A test image looks the same as a training image or as one of another period (needs "
    "`--decode`).",
    remedy="look at both; remove one if it is a copy that was saved again",
    bad="a training image, and the same photo saved again as JPEG for testing",
    needs=("tests", "pixels"),
)
def near_leak(scene: RawScene) -> Iterator[Hit]:
    assert scene.periods is not None and scene.tests is not None and scene.pixels is not None
    role = {n: (period, n in scene.tests) for n, period in scene.periods.items()}
    for a, b, distance in near_pairs(scene.pixels):
        if a not in role or b not in role or role[a] == role[b]:
            continue
        place, other = (b, a) if role[b][1] and not role[a][1] else (a, b)
        found = f"a thumbnail {distance:.2g} grey levels from that of {shown([other])}"
        yield Hit(f"images/{place}", "an image of its own", found)


def near_pairs(pixels: Mapping[str, Pixels]) -> Iterator[tuple[str, str, float]]:
    """Pairs of images whose thumbnails differ by less than `NEAR`, but not equal ones."""
    kept = {n: p.thumbnail for n, p in pixels.items() if p.thumbnail is not None}
    names = [n for n, thumbnail in kept.items() if thumbnail.std(axis=(0, 1)).max() >= FEATURELESS]
    if len(names) < 2:
        return
    table = np.stack([np.ravel(kept[n]) for n in names]).astype(np.float32)
    table -= table.mean(axis=0)  # smaller numbers, smaller rounding errors below
    norms = (table * table).sum(axis=1)
    for first in range(0, len(names), _ROWS):
        rows = slice(first, first + _ROWS)
        squares = norms[rows, None] + norms - 2 * table[rows] @ table.T
        for i, j in zip(*np.nonzero(squares < NEAR**2 * table.shape[1]), strict=True):
            a, b = names[first + i], names[j]
            if first + i < j and pixels[a].digest != pixels[b].digest:
                yield a, b, _distance(table[first + i], table[j])


def _distance(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))


def _equal(scene: RawScene) -> Iterator[tuple[str, list[str]]]:
    """Groups of equal images that have a period, and in what they are equal."""
    assert scene.periods is not None
    digests = {n: d for n, d in scene.digests.items() if n in scene.periods}
    for group in _groups(digests.items()):
        yield "bytes", group
    if scene.pixels is None:
        return
    decoded = {n: p.digest for n, p in scene.pixels.items() if n in scene.periods and p.digest}
    for group in _groups(decoded.items()):
        if len({digests.get(n, n.encode("utf-8", "surrogateescape")) for n in group}) > 1:
            yield "pixels", group


def _groups(items: Iterable[tuple[str, bytes]]) -> Iterator[list[str]]:
    """Names that share a digest, sorted; groups of two or more."""
    found: dict[bytes, list[str]] = {}
    for name, digest in items:
        found.setdefault(digest, []).append(name)
    yield from (sorted(group) for group in found.values() if len(group) > 1)
