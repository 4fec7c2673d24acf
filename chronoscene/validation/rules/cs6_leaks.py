"""CS6: one photo in train and test or in two periods, near copies, and test images seen in
training.

Equal bytes are always looked for, equal pixels and near copies with ``--decode``.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from chronoscene.colmap.raw_model import RawImages
from chronoscene.io.wording import joined, shown
from chronoscene.scene.geometry import rotation_from_quaternion
from chronoscene.scene.grouping import grouped
from chronoscene.validation import rule
from chronoscene.validation.checks.reprojection import typical_depth
from chronoscene.validation.folder.pixels import Pixels
from chronoscene.validation.folder.scene_folder import RawScene, derived
from chronoscene.validation.rule import Hit

SAME_PLACE = 1e-3
"""Distance of two cameras, in typical depths of the scene, below which they are in one place: it
moves points by a pixel or two in an image of 1600."""

SAME_DIRECTION = 2e-3  # Difference of two rotation matrices; about a tenth of a degree

MAX_DIFFERENCE = 3.0
"""Root mean square difference of two thumbnails in grey levels 0..255. Measured: photos saved again
as JPEG differ by 0.1 to 1.8 (quality 50 and more), neighbouring frames of a video by 9 and more,
aerial photos of one flight by 30 and more."""

FEATURELESS = 4.0  # Standard deviation of a thumbnail below which it looks like any other
ROUNDING = 1.01  # Margin by which pairs pass to the exact comparison
MAX_TRIED = 8  # Images compared pixel by pixel with one that looks like all of them

_ROWS = 256


@rule.error(
    "CS601",
    bad="`a.jpg` and its copy `a_copy.jpg`, one of them in `test.txt`",
    remedy=f"leave one of the images out ({rule.LEAVE_OUT})",
)
def leak_train_test(scene: RawScene, tests: set[str]) -> Iterator[Hit]:
    """A test image is also a training image (same bytes or, with `--decode`, same pixels)."""
    for kind, group in _equal(scene):
        train = [n for n in group if n not in tests]
        test = [n for n in group if n in tests]
        if train and test:
            found = f"the same {kind} in training: {shown(train)}"
            expected = "a test image that is not a training image"
            yield Hit(f"images/{test[0]}", expected, found, also=tuple(train))


@rule.error(
    "CS602",
    bad="a folder of 2016 copied into the folder of 2023",
    remedy="keep the image in the period in which it was taken, and leave the other one out "
    f"({rule.LEAVE_OUT})",
)
def leak_periods(scene: RawScene, periods: dict[str, int]) -> Iterator[Hit]:
    """One photo is in two periods (same bytes or, with `--decode`, same pixels)."""
    for kind, group in _equal(scene):
        listed = sorted({periods[n] for n in group})
        if len(listed) > 1:
            found = f"the same {kind} in periods {joined(map(str, listed))}: {shown(group)}"
            yield Hit(f"images/{group[0]}", "an image of one period", found, also=tuple(group[1:]))


@rule.warning(
    "CS603",
    bad="`a.jpg` and `a_copy.jpg`",
    remedy=f"leave one of the images out ({rule.LEAVE_OUT})",
)
def image_twice(scene: RawScene, periods: dict[str, int], tests: set[str]) -> Iterator[Hit]:
    """One photo is there twice, in one period and twice in train or twice in test."""
    for kind, group in _equal(scene):
        if len({(periods[n], n in tests) for n in group}) == 1:
            found = f"the same {kind} in {shown(group[1:])}"
            yield Hit(f"images/{group[0]}", "a unique image", found, also=tuple(group[1:]))


@rule.warning(
    "CS604",
    bad="a training image, and the same photo saved again as JPEG for testing",
    remedy=f"look at both; if one is a copy that was saved again, leave it out ({rule.LEAVE_OUT})",
)
def near_leak(
    scene: RawScene, periods: dict[str, int], tests: set[str], pixels: dict[str, Pixels]
) -> Iterator[Hit]:
    """A test image looks the same as a training image or as an image of another period (needs
    `--decode`)."""
    role = {n: (period, n in tests) for n, period in periods.items()}
    pixels = {n: p for n, p in pixels.items() if n in role}
    for a, b, number in near_pairs(pixels, role):
        place, other = (b, a) if role[b][1] and not role[a][1] else (a, b)
        distance = f"{number:.2g} grey levels from that of {shown([other])}"
        found = f"a thumbnail {distance}{_apart(scene, a, b)}"
        yield Hit(f"images/{place}", "a distinct image", found, also=(other,))


def _apart(scene: RawScene, a: str, b: str) -> str:
    """Describe the distance between the cameras of two images, where it is known."""
    names = scene.images.names if scene.images else ()
    if a not in names or b not in names:
        return ""
    shift = np.linalg.norm(scene.centres[names.index(a)] - scene.centres[names.index(b)])
    extent = typical_depth(scene)
    if not np.isfinite(shift) or not extent:
        return ""
    if shift <= SAME_PLACE * extent:
        return ", taken from the same place"
    return f", though their cameras are {shift / extent:.2g} times the depth of the scene apart"


@rule.warning(
    "CS605",
    bad="a burst of three photos, the second of which is in `test.txt`",
    remedy=f"leave one of the two out ({rule.LEAVE_OUT}), or make the test image a training image",
)
def pose_leak(scene: RawScene, images: RawImages, tests: set[str]) -> Iterator[Hit]:
    """A test image has the pose of a training image of its period, so it measures memorisation
    rather than new views."""
    posed = np.flatnonzero(scene.is_posed)
    pairs = twins(
        scene.centres[posed],
        rotation_from_quaternion(images.quaternions[posed]),
        scene.image_periods[posed],
        np.array([images.names[i] in tests for i in posed.tolist()], bool),
        near=SAME_PLACE * typical_depth(scene),
    )
    for a, b in pairs:
        name, other = images.names[posed[a]], images.names[posed[b]]
        found = f"the pose of {shown([other])}"
        yield Hit(scene.image_place(name), "a pose of its own", found, also=(other,))


def near_pairs(
    pixels: Mapping[str, Pixels], role: Mapping[str, object]
) -> Iterator[tuple[str, str, float]]:
    """Pairs of images of different roles whose thumbnails differ by less than `MAX_DIFFERENCE`.

    Pairs of equal pixels are left out. For each image there is at most one pair with a later image:
    thousands of frames of a fixed camera must not yield millions of pairs.
    """
    kept = {n: p.thumbnail for n, p in pixels.items() if p.thumbnail is not None}
    names = [n for n, thumbnail in kept.items() if thumbnail.std(axis=(0, 1)).max() >= FEATURELESS]
    if len(names) < 2:
        return
    full = np.stack([np.ravel(kept[n]) for n in names])
    table = full - full.mean(axis=0)  # smaller numbers have smaller rounding errors below
    norms = (table * table).sum(axis=1)
    _, group = np.unique([repr(role[n]) for n in names], return_inverse=True)
    for first in range(0, len(names), _ROWS):
        rows = slice(first, first + _ROWS)
        squares = norms[rows, None] + norms[first:] - 2 * table[rows] @ table[first:].T
        near = squares < (MAX_DIFFERENCE**2 * table.shape[1]) * ROUNDING
        near &= group[rows, None] != group[first:]
        near = np.triu(near, 1)
        for i in np.flatnonzero(near.any(axis=1)).tolist():
            others = np.flatnonzero(near[i])
            nearest = others[np.argsort(squares[i, others])[:MAX_TRIED]]
            for a, b in ((first + i, first + j) for j in nearest.tolist()):
                distance = float(np.sqrt(np.mean((full[a] - full[b]) ** 2)))
                if distance < MAX_DIFFERENCE and pixels[names[a]].digest != pixels[names[b]].digest:
                    yield names[a], names[b], distance
                    break


def twins(
    places: NDArray[np.float64],
    rotations: NDArray[np.float64],
    periods: NDArray[np.int64],
    test: NDArray[np.bool_],
    *,
    near: float,
) -> Iterator[tuple[int, int]]:
    """Pairs of a test image and a training image of its period with the same pose.

    ``places`` [N, 3] are camera centres, in one place up to a distance of ``near``; ``rotations``
    are [N, 3, 3]; ``periods`` [N] are negative for none; ``test`` [N] is true for test images.
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


@derived
def _equal(scene: RawScene) -> list[tuple[str, list[str]]]:
    """Groups of equal images that have a period, and what of them is equal."""
    assert scene.periods is not None
    digests = {n: d for n, d in scene.digests.items() if n in scene.periods}
    equal = [("bytes", group) for group in _groups(digests.items())]
    if scene.pixels is None:
        return equal
    decoded = {n: p.digest for n, p in scene.pixels.items() if n in scene.periods and p.digest}
    for group in _groups(decoded.items()):
        if len({digests.get(n, n.encode("utf-8", "surrogateescape")) for n in group}) > 1:
            equal += [("pixels", group)]
    return equal


def _groups(items: Iterable[tuple[str, Hashable]]) -> Iterator[list[str]]:
    """Sorted names that share a digest; groups of two or more."""
    groups = grouped((digest, name) for name, digest in items)
    return (sorted(group) for group in groups.values() if len(group) > 1)
