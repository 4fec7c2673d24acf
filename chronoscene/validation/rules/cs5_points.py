"""CS501 to CS505, CS509, CS510, CS514, CS518, CS522, CS525: sparse points and their tracks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from chronoscene.colmap.raw_model import RawImages, RawPoints
from chronoscene.io.wording import counted, shown
from chronoscene.validation import rule
from chronoscene.validation.folder.observations import Observations
from chronoscene.validation.folder.scene_folder import RawScene
from chronoscene.validation.rule import Hit

MAX_SHORT = 0.01  # Share of the points up to which short tracks do not matter
MIN_COLOURED = 100  # Points from which their colours are judged
SAME_COLOUR = 0.95  # Share of points of one colour; snow and night skies have many shades
COLOURED_SAMPLE = 50_000  # Points whose colours are looked at

FAR = 100.0
"""Distance of a point from the centre, in units of the median distance of points and cameras."""


@rule.error(
    "CS501", bad="an empty `points3D.txt`", remedy=f"triangulate points ({rule.TRIANGULATE})"
)
def no_points(scene: RawScene, points: RawPoints) -> Iterator[Hit]:
    """The model has no points, but methods start from them. Benchmarks refuse the scene."""
    if not len(points):
        yield Hit(scene.model_file("points3D"), "sparse points", "none")


@rule.error(
    "CS502", bad="`nan` in `points3D.txt`", remedy="chronoscene validate --fix removes the points"
)
def point_not_finite(scene: RawScene, points: RawPoints) -> Iterator[Hit]:
    """The coordinates of a point are NaN or infinite."""
    yield from _some_points(scene, points, ~points.finite, "finite coordinates", "NaN or infinity")


@rule.warning(
    "CS503",
    bad="points of a laser scan, without tracks",
    remedy="filter the points, or write the tracks with the points",
)
def short_track(scene: RawScene, points: RawPoints) -> Iterator[Hit]:
    """Points are seen in one image or none, so their positions are not measured."""
    return _short_tracks(scene, points, few=False)


@rule.info(
    "CS525",
    what=f"Up to {100 * MAX_SHORT:g} % of the points are seen in one image or none, so their "
    "positions are not measured.",
    bad="a point that lost an observation when its image was cropped",
    remedy="nothing to do; chronoscene validate --fix removes them",
)
def few_short_tracks(scene: RawScene, points: RawPoints) -> Iterator[Hit]:
    return _short_tracks(scene, points, few=True)


def _short_tracks(scene: RawScene, points: RawPoints, *, few: bool) -> Iterator[Hit]:
    lengths = np.diff(points.track_start)
    short = int(np.count_nonzero(lengths < 2))
    if few != (short <= MAX_SHORT * len(points)):
        return
    for number, found in ((0, "no observation"), (1, "one observation")):
        expected = "two or more observations of each point"
        yield from _some_points(scene, points, lengths == number, expected, found)


@rule.error(
    "CS504",
    bad="`images.bin` and `points3D.bin` of two different runs",
    remedy="write images and points again together, from one model",
)
def broken_track(scene: RawScene, points: RawPoints, observations: Observations) -> Iterator[Hit]:
    """A track refers to an image, or a keypoint of an image, that does not exist."""
    place, missing = scene.model_file("points3D"), observations.image < 0
    if lost := int(np.count_nonzero(missing)):
        ids = _listed(np.unique(points.track_image[missing]).tolist())
        found = f"{counted(lost, 'observation')} in image ids {ids}"
        yield Hit(place, "tracks of registered images", found, count=lost)
    if lost := int(np.count_nonzero(~missing & ~observations.valid)):
        found = f"{counted(lost, 'observation')} with an index beyond the keypoints of the image"
        yield Hit(place, "tracks of existing keypoints", found, count=lost)


@rule.error(
    "CS505",
    bad="a keypoint refers to point 5, but the track of point 5 does not list it",
    remedy="write images and points again together, from one model",
)
def track_disagrees(
    scene: RawScene, images: RawImages, points: RawPoints, observations: Observations
) -> Iterator[Hit]:
    """Images and points disagree on which keypoint belongs to which point."""
    rows = np.flatnonzero(observations.valid)
    keypoints = observations.keypoint[rows]
    agree = images.keypoint_point[keypoints] == points.ids[observations.point[rows]]
    if wrong := int(np.count_nonzero(~agree)):
        found = f"{counted(wrong, 'observation')} whose keypoint refers to another point or none"
        yield Hit(scene.model_file("points3D"), "keypoints that agree", found, count=wrong)
    claimed = images.keypoint_point >= 0
    claimed[keypoints[agree]] = False
    if lost := int(np.count_nonzero(claimed)):
        found = f"{counted(lost, 'keypoint')} of points whose track does not list them"
        yield Hit(scene.model_file("images"), "tracks that agree", found, count=lost)


@rule.info(
    "CS509",
    bad="test images that were added with known poses",
    remedy="nothing to do if the poses come from another source",
)
def image_without_points(
    scene: RawScene, images: RawImages, observations: Observations
) -> Iterator[Hit]:
    """An image sees no point of the model, so no point confirms its pose."""
    counts = np.bincount(observations.image[observations.valid], minlength=len(images))
    names = [images.names[i] for i in np.flatnonzero(counts == 0)]
    if names:
        found = f"{counted(len(names), 'image')} without points: {shown(sorted(names))}"
        yield Hit(scene.model_file("images"), "points in every image", found, count=len(names))


@rule.warning(
    "CS510",
    bad="a keypoint at `nan nan` in a track",
    remedy="chronoscene validate --fix removes these observations; they come from pixels that "
    "cannot be undistorted",
)
def observation_not_finite(
    scene: RawScene, images: RawImages, observations: Observations
) -> Iterator[Hit]:
    """The position of an observation in its image is NaN or infinite."""
    if np.isfinite(images.keypoint_xy).all():
        return
    xy = images.keypoint_xy[observations.keypoint[observations.valid]]
    if bad := int(np.count_nonzero(~np.isfinite(xy).all(axis=1))):
        found = f"NaN or infinity in {bad} of {len(xy)} observations"
        yield Hit(scene.model_file("images"), "finite pixel positions", found, count=bad)


@rule.error(
    "CS514",
    bad="points seen only in test images",
    remedy=f"triangulate points ({rule.TRIANGULATE}), or change the split",
)
def no_training_points(
    scene: RawScene, images: RawImages, observations: Observations, tests: set[str]
) -> Iterator[Hit]:
    """No point of the model is seen in a training image, but methods start from such points.
    Benchmarks refuse the scene, unless its points have no tracks at all: then they take all."""
    train = np.array([name not in tests for name in images.names], bool)
    total = len(scene.points or ())
    if observations.valid.any() and not train[observations.image[observations.valid]].any():
        yield Hit(scene.model_file("points3D"), "points seen in training images", f"0 of {total}")


@rule.warning(
    "CS518",
    bad="a point 40 km away from a square of 100 m",
    remedy="filter the points: they come from wrong matches, or from the sky",
    needs=("images",),
)
def far_points(scene: RawScene, points: RawPoints) -> Iterator[Hit]:
    """Points are absurdly far from everything else; they blow up every bounding box."""
    xyz, cameras = points.xyz, scene.centres[scene.is_posed]
    usable = np.isfinite(xyz).all(axis=1)
    if not usable.any():
        return
    middle = np.median(xyz[usable], axis=0)
    distance = np.linalg.norm(xyz - middle, axis=1)
    typical = np.median(distance[usable])
    if len(cameras):
        typical = max(typical, np.median(np.linalg.norm(cameras - middle, axis=1)))
    far = usable & (distance > FAR * typical)
    if number := int(np.count_nonzero(far)):
        ids = _listed(points.ids[far])
        found = f"{counted(number, 'point')} up to {distance[far].max():.3g} away (ids {ids})"
        expected = f"points within {FAR * typical:.3g} of the centre"
        yield Hit(scene.model_file("points3D"), expected, found, count=number)


@rule.warning(
    "CS522",
    bad="a model triangulated without colours: all points are black",
    remedy="extract the colours (colmap color_extractor) and write the model again, or triangulate "
    f"new points ({rule.TRIANGULATE})",
)
def points_without_colours(scene: RawScene, points: RawPoints) -> Iterator[Hit]:
    """Nearly all points have the same colour, which is useless to methods that start from the
    colours of the points."""
    if len(points) < MIN_COLOURED:
        return
    packed = points.rgb.astype(np.int64) @ [65536, 256, 1]
    colours, numbers = np.unique(packed[:: len(packed) // COLOURED_SAMPLE + 1], return_counts=True)
    most = int(numbers.argmax())
    if numbers[most] > SAME_COLOUR * numbers.sum():
        found = f"#{colours[most]:06x} for {100 * numbers[most] / numbers.sum():.1f} % of them"
        yield Hit(scene.model_file("points3D"), "points in the colours of the photos", found)


def _some_points(
    scene: RawScene, points: RawPoints, bad: NDArray[np.bool_], expected: str, found: str
) -> Iterator[Hit]:
    """One hit for all bad points, with the first ids."""
    if number := int(np.count_nonzero(bad)):
        text = f"{found} for {number} of {len(points)} points (ids {_listed(points.ids[bad])})"
        yield Hit(scene.model_file("points3D"), expected, text, count=number)


def _listed(ids: Sequence[int] | NDArray[np.int64]) -> str:
    return ", ".join(map(str, ids[:3])) + (" ..." if len(ids) > 3 else "")
