"""CS6: the same photo twice: in train and test, in two periods, or just twice.

Equal bytes are looked for always, equal pixels and near copies with ``--decode``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from chronoscene.io.wording import shown
from chronoscene.scene.geometry import rotation_from_quaternion
from chronoscene.validation.checks.near_duplicates import relit_pairs
from chronoscene.validation.checks.pixels import THUMBNAIL, Pixels
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.scene_folder import RawScene

NEAR = 3.0
"""Root mean square difference of two thumbnails in grey levels 0..255. Measured: photos saved again
as JPEG differ by 0.1 to 1.8 (quality 50 and more), neighbouring frames of a video by 9 and more,
aerial photos of one flight by 30 and more."""

FEATURELESS = 4.0
"""Standard deviation of a thumbnail below which it looks like any other one."""

SAME_PLACE = 1e-3
"""Distance of two cameras, in typical depths of the scene, below which they are in one place: it
moves points by a pixel or two in an image of 1600."""

SAME_DIRECTION = 2e-3
"""Difference of two rotation matrices; about a tenth of a degree."""

ROUNDING = 1.01
"""So much more is let through to the exact comparison."""

MOST_TRIED = 8
"""Images that are compared pixel by pixel with one that looks like them all."""

_BLOCK = 8
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
            expected = "a test image that no training image equals"
            yield Hit(f"images/{test[0]}", expected, found, also=tuple(train))


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
            yield Hit(f"images/{group[0]}", "an image of one period", found, also=tuple(group[1:]))


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
            expected = "an image that no other equals"
            yield Hit(f"images/{group[0]}", expected, found, also=tuple(group[1:]))


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
    pixels = {n: p for n, p in scene.pixels.items() if n in role}
    near = {(a, b): f"{d:.2g} grey levels from that" for a, b, d in near_pairs(pixels, role)}
    for a, b, alike in relit_pairs(pixels, role):
        if pixels[a].digest != pixels[b].digest:
            near.setdefault((a, b), f"that is, but for brightness, {alike:.2%} that")
    for (a, b), how in near.items():
        place, other = (b, a) if role[b][1] and not role[a][1] else (a, b)
        found = f"a thumbnail {how} of {shown([other])}"
        found += _apart(scene, a, b)
        yield Hit(f"images/{place}", "an image of its own", found, also=(other,))


def _apart(scene: RawScene, a: str, b: str) -> str:
    """What the poses of two images say about their likeness."""
    names = scene.images.names if scene.images else ()
    if a not in names or b not in names:
        return ""
    shift = np.linalg.norm(scene.centres[names.index(a)] - scene.centres[names.index(b)])
    extent = scene.typical_depth
    if not np.isfinite(shift) or not extent:
        return ""
    if shift <= SAME_PLACE * extent:
        return ", taken from the same place"
    return f", though their cameras are {shift / extent:.2g} times the depth of the scene apart"


@rule(
    "CS605",
    "pose-leak",
    "warning",
    what="A test image has the pose of a training image of its period, so it measures memory "
    "rather than new views.",
    remedy="take one of the two out, or move the test image to the training images",
    bad="a burst of three photos, of which the second is in `test.txt`",
    needs=("images", "tests"),
)
def pose_leak(scene: RawScene) -> Iterator[Hit]:
    images, tests = scene.images, scene.tests
    assert images is not None and tests is not None
    posed = np.flatnonzero(~np.isnan(scene.centres).any(axis=1))
    test = np.array([images.names[i] in tests for i in posed.tolist()], bool)
    rotations = rotation_from_quaternion(images.quaternions[posed])
    pairs = twins(
        scene.centres[posed],
        rotations,
        scene.image_periods[posed],
        test,
        near=SAME_PLACE * scene.typical_depth,
    )
    for a, b in pairs:
        name, other = images.names[posed[a]], images.names[posed[b]]
        found = f"that of {shown([other])}"
        yield Hit(scene.image_place(name), "a pose of its own", found, also=(other,))


def twins(
    places: NDArray[np.float64],
    rotations: NDArray[np.float64],
    periods: NDArray[np.int64],
    test: NDArray[np.bool_],
    *,
    near: float,
) -> Iterator[tuple[int, int]]:
    """Test images, each with a training image of its period and pose, if there is one.

    Args:
        places: Camera centres. [N, 3]
        rotations: [N, 3, 3]
        periods: Negative for none. [N]
        test: Which images are for testing. [N]
        near: Distance of two centres that are one.
    """
    order = np.argsort(places[:, 0], kind="stable")
    x = places[order, 0]
    for i in np.flatnonzero(test & (periods >= 0)).tolist():
        begin = np.searchsorted(x, places[i, 0] - near)
        others = order[begin : np.searchsorted(x, places[i, 0] + near, "right")]
        others = others[(periods[others] == periods[i]) & ~test[others]]
        close = np.linalg.norm(places[others] - places[i], axis=1) <= near
        turned = np.linalg.norm(rotations[others] - rotations[i], axis=(1, 2))
        if len(alike := others[close & (turned <= SAME_DIRECTION)]):
            yield i, int(alike[0])


def near_pairs(
    pixels: Mapping[str, Pixels], role: Mapping[str, object]
) -> Iterator[tuple[str, str, float]]:
    """Pairs of images of different roles whose thumbnails differ by less than `NEAR`, not equal.

    The difference of means over blocks is never above that of the pixels, so most pairs are
    settled by a sixty-fourth of the numbers. Of an image and all that come after it, one pair is
    given: thousands of frames of a fixed camera must not give millions of pairs.
    """
    kept = {n: p.thumbnail for n, p in pixels.items() if p.thumbnail is not None}
    names = [n for n, thumbnail in kept.items() if thumbnail.std(axis=(0, 1)).max() >= FEATURELESS]
    if len(names) < 2:
        return
    full = np.stack([np.ravel(kept[n]) for n in names])
    side = THUMBNAIL // _BLOCK
    blocks = full.reshape(len(names), side, _BLOCK, side, _BLOCK, 3).mean(axis=(2, 4))
    table = blocks.reshape(len(names), -1)
    table = table - table.mean(axis=0)  # smaller numbers, smaller rounding errors below
    norms = (table * table).sum(axis=1)
    _, group = np.unique([repr(role[n]) for n in names], return_inverse=True)
    for first in range(0, len(names), _ROWS):
        rows = slice(first, first + _ROWS)
        squares = norms[rows, None] + norms[first:] - 2 * table[rows] @ table[first:].T
        near = squares < (NEAR**2 * table.shape[1]) * ROUNDING
        near &= group[rows, None] != group[first:]
        near = np.triu(near, 1)
        for i in np.flatnonzero(near.any(axis=1)).tolist():
            others = np.flatnonzero(near[i])
            nearest = others[np.argsort(squares[i, others])[:MOST_TRIED]]
            for a, b in ((first + i, first + j) for j in nearest.tolist()):
                distance = _distance(full[a], full[b])
                if distance < NEAR and pixels[names[a]].digest != pixels[names[b]].digest:
                    yield names[a], names[b], distance
                    break


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
