"""CS50: sparse points, their tracks and their periods."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.colmap.arrays import RawPoints
from chronoscene.io.wording import counted, shown
from chronoscene.validation.finding import NOTHING, Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.scene_folder import RawScene

FEWEST_SHARED = 10
"""Points from which a similarity between two periods can be told from chance."""

FEWEST_COLOURED = 100
"""Points whose colours mean something."""

SAME_COLOUR = 0.95
"""Share of points of one colour; snow and night skies have many shades."""

COLOURED_SAMPLE = 50_000
"""Points whose colours are looked at."""

BLOCK = 10_000_000
"""Points times periods that are counted at a time."""


FEW = 0.01
"""Share of the points up to which short tracks do not matter."""


@rule(
    "CS501",
    "no-points",
    "error",
    what="The model has no points, from which methods start. Benchmarks refuse the scene.",
    remedy="triangulate points (colmap point_triangulator)",
    bad="an empty `points3D.txt`",
    needs=("points",),
)
def no_points(scene: RawScene) -> Iterator[Hit]:
    assert scene.points is not None
    if not len(scene.points):
        yield Hit(scene.model_file("points3D"), "sparse points", "none")


@rule(
    "CS502",
    "point-not-finite",
    "error",
    what="A point has NaN or infinite coordinates.",
    remedy="remove the points from the model",
    bad="`nan` in `points3D.txt`",
    needs=("points",),
)
def point_not_finite(scene: RawScene) -> Iterator[Hit]:
    points = scene.points
    assert points is not None
    bad = ~np.isfinite(points.xyz).all(axis=1)
    yield from _some_points(scene, points, bad, "finite coordinates", "NaN or infinity")


@rule(
    "CS503",
    "short-track",
    "warning",
    what="A point is seen by no image or by one, so its position is not a measurement.",
    remedy="filter the points, or write the tracks with the points",
    bad="points from a laser scan, without tracks",
    needs=("points",),
)
def short_track(scene: RawScene) -> Iterator[Hit]:
    return _short_tracks(scene, few=False)


@rule(
    "CS525",
    "few-short-tracks",
    "info",
    what=f"Of every hundred points at most {100 * FEW:g} are seen by no image or by one; their "
    "positions are not measurements.",
    remedy="nothing to do; validate --fix leaves them out",
    bad="a point that lost an observation when its image was cropped",
    needs=("points",),
)
def few_short_tracks(scene: RawScene) -> Iterator[Hit]:
    return _short_tracks(scene, few=True)


def _short_tracks(scene: RawScene, *, few: bool) -> Iterator[Hit]:
    points = scene.points
    assert points is not None
    lengths = np.diff(points.track_start)
    short = int(np.count_nonzero(lengths < 2))
    if few != (short <= FEW * len(points)):
        return
    if short and not lengths.any() and scene.tests is not None:
        return  # no tracks at all: an error of its own
    for number, found in ((0, "no observation"), (1, "one observation")):
        yield from _some_points(scene, points, lengths == number, "two or more", found)


@rule(
    "CS504",
    "broken-track",
    "error",
    what="A track refers to an image, or a keypoint of an image, that does not exist.",
    remedy="write images and points again together, from one model",
    bad="`images.bin` and `points3D.bin` of two different runs",
    needs=("observations",),
)
def broken_track(scene: RawScene) -> Iterator[Hit]:
    seen, points = scene.observations, scene.points
    assert seen is not None and points is not None
    place = scene.model_file("points3D")
    if lost := int(np.count_nonzero(seen.image < 0)):
        ids = np.unique(points.track_image[seen.image < 0])
        named = ", ".join(map(str, ids[:3])) + (" ..." if len(ids) > 3 else "")
        found = f"{counted(lost, 'observation')} in image ids {named}"
        yield Hit(place, "tracks over registered images", found, count=lost)
    if lost := int(np.count_nonzero((seen.image >= 0) & ~seen.valid)):
        found = f"{counted(lost, 'observation')} with an index beyond the keypoints of the image"
        yield Hit(place, "tracks over existing keypoints", found, count=lost)


@rule(
    "CS505",
    "track-disagrees",
    "error",
    what="Images and points disagree on which keypoint belongs to which point.",
    remedy="write images and points again together, from one model",
    bad="a keypoint says point 5, the track of point 5 does not have it",
    needs=("observations",),
)
def track_disagrees(scene: RawScene) -> Iterator[Hit]:
    seen, points, images = scene.observations, scene.points, scene.images
    assert seen is not None and points is not None and images is not None
    rows = np.flatnonzero(seen.valid)
    keypoints = seen.keypoint[rows]
    agree = images.keypoint_point[keypoints] == points.ids[seen.point[rows]]
    if wrong := int(np.count_nonzero(~agree)):
        found = f"{counted(wrong, 'observation')} whose keypoint names another point or none"
        yield Hit(scene.model_file("points3D"), "keypoints that agree", found, count=wrong)
    claimed = images.keypoint_point >= 0
    claimed[keypoints[agree]] = False
    if lost := int(np.count_nonzero(claimed)):
        found = f"{counted(lost, 'keypoint')} of points whose track does not have them"
        yield Hit(scene.model_file("images"), "tracks that agree", found, count=lost)


@rule(
    "CS506",
    "period-without-points",
    "warning",
    what="No point is seen by any image of a period.",
    remedy="triangulate points with the images of this period",
    bad="points of period 0 only; the images of period 1 were added later",
    needs=("observations", "periods", "point_periods"),
)
def period_without_points(scene: RawScene) -> Iterator[Hit]:
    seen = scene.point_periods
    assert seen is not None
    total = len(seen)
    if not seen.any():
        return  # no tracks at all: an error of its own
    for column, period in enumerate(scene.period_ids):
        if total and not seen[:, column].any():
            yield Hit(f"period {period}", "points that its images see", f"0 of {total}")


@rule(
    "CS507",
    "points-of-one-period",
    "info",
    what="How many points are seen in one period only, and how many in several.",
    remedy=NOTHING,
    bad="(tells numbers)",
    needs=("observations", "periods", "point_periods"),
)
def points_of_one_period(scene: RawScene) -> Iterator[Hit]:
    seen = scene.point_periods
    assert seen is not None
    if not len(seen) or seen.shape[1] < 2:
        return
    alone = seen[seen.sum(axis=1) == 1].sum(axis=0).tolist()
    each = ", ".join(f"period {p} {n}" for p, n in zip(scene.period_ids, alone, strict=True))
    share = 100 * sum(alone) / len(seen)
    found = f"{sum(alone)} of {len(seen)} in one only ({share:.1f} %): {each}"
    yield Hit(scene.model_file("points3D"), "points of several periods", found)


@rule(
    "CS508",
    "period-unconnected",
    "warning",
    what=f"A period, or a group of periods, shares fewer than {FEWEST_SHARED} points with the "
    "others, so nothing shows that they are in one frame.",
    remedy="match images across the periods; if they were aligned otherwise, ignore this rule",
    bad="two models merged by hand; periods 0 and 1 share points, 2 and 3 do, 1 and 2 do not",
    needs=("observations", "periods", "point_periods"),
)
def period_unconnected(scene: RawScene) -> Iterator[Hit]:
    seen = scene.point_periods
    assert seen is not None
    points = seen.sum(axis=0)
    groups = connected(common_points(seen), FEWEST_SHARED)
    groups = [group for group in groups if points[group].any()]  # else another rule's
    groups.sort(key=lambda group: -int(points[group].sum()))
    for group in groups[1:]:
        own = seen[:, group].any(axis=1)
        shared = np.count_nonzero(own & np.delete(seen, group, axis=1).any(axis=1))
        ids = [str(scene.period_ids[i]) for i in group]
        place = f"period {ids[0]}" if len(ids) == 1 else f"periods {', '.join(ids)}"
        found = f"{shared} of {np.count_nonzero(own)}"
        yield Hit(place, f"{FEWEST_SHARED} points or more shared with the other periods", found)


def common_points(seen: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Points that two periods see, for each two; nothing on the diagonal. [P, T] -> [T, T]"""
    seen = seen[seen.sum(axis=1) > 1]
    rows = max(1, BLOCK // max(1, seen.shape[1]))
    common = np.zeros((seen.shape[1],) * 2, np.int64)
    for first in range(0, len(seen), rows):
        block = seen[first : first + rows].astype(np.float32)
        common += (block.T @ block).astype(np.int64)
    np.fill_diagonal(common, 0)
    return common


def connected(common: NDArray[np.int64], fewest: int) -> list[NDArray[np.int64]]:
    """Indices of the periods of each group that chains of so many common points link."""
    reach = (common >= fewest) | np.eye(len(common), dtype=bool)
    for _ in range(len(common).bit_length()):  # each time twice as many steps
        reach = (reach.astype(np.float32) @ reach.astype(np.float32)) > 0
    first = [int(np.flatnonzero(row)[0]) for row in reach]  # period of the group
    return [np.flatnonzero(reach[period]) for period in sorted(set(first))]


@rule(
    "CS509",
    "image-without-points",
    "info",
    what="An image sees no point of the model, so no point confirms its pose.",
    remedy="nothing to do, if the poses are known otherwise",
    bad="test images that were added with known poses",
    needs=("observations",),
)
def image_without_points(scene: RawScene) -> Iterator[Hit]:
    seen, images = scene.observations, scene.images
    assert seen is not None and images is not None
    counts = np.bincount(seen.image[seen.valid], minlength=len(images))
    names = [images.names[i] for i in np.flatnonzero(counts == 0)]
    if names:
        found = f"{counted(len(names), 'image')} without any: {shown(sorted(names))}"
        yield Hit(scene.model_file("images"), "points in every image", found, count=len(names))


@rule(
    "CS510",
    "observation-not-finite",
    "warning",
    what="A point is observed at NaN or infinity in an image.",
    remedy="remove these observations; they come from pixels that cannot be undistorted",
    bad="a keypoint at `nan nan` in a track",
    needs=("observations",),
)
def observation_not_finite(scene: RawScene) -> Iterator[Hit]:
    seen, images = scene.observations, scene.images
    assert seen is not None and images is not None
    if np.isfinite(images.keypoint_xy).all():
        return
    xy = images.keypoint_xy[seen.keypoint[seen.valid]]
    if bad := int(np.count_nonzero(~np.isfinite(xy).all(axis=1))):
        found = f"NaN or infinity in {bad} of {len(xy)} observations"
        yield Hit(scene.model_file("images"), "finite pixel positions", found, count=bad)


@rule(
    "CS514",
    "no-training-points",
    "error",
    what="No training image sees a point of the model, and methods may start from no others. "
    "Benchmarks refuse the scene.",
    remedy="triangulate points (colmap point_triangulator), or change the split",
    bad="points without tracks; points that test images alone see",
    needs=("observations", "tests"),
)
def no_training_points(scene: RawScene) -> Iterator[Hit]:
    seen, images = scene.observations, scene.images
    assert seen is not None and images is not None and scene.tests is not None
    train = np.array([name not in scene.tests for name in images.names], bool)
    if len(scene.points or ()) and not train[seen.image[seen.valid]].any():
        found = f"0 of {len(scene.points or ())}"
        yield Hit(scene.model_file("points3D"), "points that training images see", found)


@rule(
    "CS522",
    "points-without-colours",
    "warning",
    what="Nearly all points have the same colour, which tells methods nothing that start from the "
    "colours of the points.",
    remedy="extract the colours (colmap color_extractor) and write the model again",
    bad="a model triangulated without colours: all points are black",
    needs=("points",),
)
def points_without_colours(scene: RawScene) -> Iterator[Hit]:
    points = scene.points
    assert points is not None
    if len(points) < FEWEST_COLOURED:
        return
    packed = points.rgb.astype(np.int64) @ [65536, 256, 1]
    colours, numbers = np.unique(packed[:: len(packed) // COLOURED_SAMPLE + 1], return_counts=True)
    most = int(numbers.argmax())
    if numbers[most] > SAME_COLOUR * numbers.sum():
        found = f"#{colours[most]:06x} for {100 * numbers[most] / numbers.sum():.1f} % of them"
        yield Hit(scene.model_file("points3D"), "points in the colours of the photos", found)


def _some_points(
    scene: RawScene, points: RawPoints, bad: Any, expected: str, found: str
) -> Iterator[Hit]:
    """One finding for all bad points, with the first ids."""
    if number := int(np.count_nonzero(bad)):
        ids = ", ".join(map(str, points.ids[bad][:3])) + (" ..." if number > 3 else "")
        text = f"{found} for {number} of {len(points)} points (ids {ids})"
        yield Hit(scene.model_file("points3D"), expected, text, count=number)
