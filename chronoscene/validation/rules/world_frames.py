"""CS519 to CS521: the frames of the periods against each other, and of the scene against metres."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from chronoscene.errors import ChronoSceneError
from chronoscene.formats.chronoscene import WORLD, read_world
from chronoscene.scene.geometry import rotation_from_quaternion
from chronoscene.validation.checks.gps_positions import fit_gps
from chronoscene.validation.checks.period_frames import own_frames
from chronoscene.validation.checks.reprojection import project
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.scene_folder import RawScene

DEPTH_RATIO = 10.0
"""Between the median depths of two periods without shared points: nothing else tells scales."""

UNIT_TOLERANCE = 0.1
"""Relative difference between the unit and the metre by GPS that its noise can explain."""

NEAREST, FARTHEST = 0.01, 50_000.0
"""Metres between cameras and points that are plausible."""

APART = 0.05
"""Share of a period's points that cameras of another one should at least look at."""

OWN = 0.5
"""Share of a period's points that its own cameras must look at."""

MOST_PERIODS = 100
"""Each is compared with each."""

MOST_POINTS, MOST_IMAGES = 3000, 300
"""Points and images of all periods together that are compared."""

REACH = 3.0
"""How far a camera sees, in units of the depth that 95% of its period's points do not exceed."""


@rule(
    "CS519",
    "period-frame",
    "warning",
    what="A period is in a frame of its own: mirrored, scaled, turned or moved against the others.",
    remedy="bring its poses into the frame of the others, or register all periods together",
    bad="period 1 was mapped by itself, then scaled to metres; the other periods were not",
    needs=("images", "periods", "reprojections", "point_periods"),
)
def period_frame(scene: RawScene) -> Iterator[Hit]:
    for index, explained in scene.derived(own_frames).items():
        place = f"period {scene.period_ids[index]}"
        yield Hit(place, "the frame of the other periods", explained)
    yield from _other_depths(scene).values()


def _other_depths(scene: RawScene) -> dict[int, Hit]:
    """Periods without shared points whose depths are of another order than those of the rest.

    Returns:
        One hit for each, by the index of the period.
    """
    hits: dict[int, Hit] = {}
    seen = scene.point_periods
    assert seen is not None
    shared = seen[seen.sum(axis=1) > 1].any(axis=0)
    medians = scene.depths(50)
    for index, period in enumerate(scene.period_ids):
        others = [d for i, d in medians.items() if i != index]
        if shared[index] or index not in medians or not others:
            continue
        ratio = medians[index] / float(np.median(others))
        if not 1 / DEPTH_RATIO <= ratio <= DEPTH_RATIO:
            expected = "a frame scaled like those of the other periods"
            found = f"points {ratio:.3g} times as far from the cameras, and none shared"
            hits[index] = Hit(f"period {period}", expected, found)
    return hits


@rule(
    "CS520",
    "frame-scale",
    "warning",
    what="`sparse/world.json` says metres, but the world is not in metres.",
    remedy="scale the model, or correct the unit in sparse/world.json",
    bad='`{"unit": "metre"}` with a model straight from COLMAP\'s mapper',
    needs=("cameras", "images"),
)
def frame_scale(scene: RawScene) -> Iterator[Hit]:
    try:
        if read_world(scene.root).unit != "metre":
            return
    except ChronoSceneError:
        return  # has its own rule
    fit = fit_gps(scene)
    if fit is not None:
        scale = fit.metres_from_world.scale
        tolerance = max(UNIT_TOLERANCE, 3 * fit.sigma / (fit.spread * len(fit.images) ** 0.5))
        if abs(np.log(scale)) > np.log1p(tolerance):
            found = f"{scale:.4g} m for one unit, by the GPS of {len(fit.images)} photos"
            yield Hit(WORLD, "a world in metres", found)
        return
    for index, depth in scene.depths(50).items():
        if index >= 0 and not NEAREST <= depth <= FARTHEST:
            place = f"period {scene.period_ids[index]}"
            yield Hit(place, "a world in metres", f"points {depth:.3g} m from the cameras (median)")


@rule(
    "CS521",
    "period-apart",
    "warning",
    what="A period looks at another place than the others: hardly any of their points are in the "
    "views of its cameras, and hardly any of its points in theirs.",
    remedy="leave the period out, or make it a scene of its own; if the places are the same, its "
    "frame is another one: register the periods together",
    bad="the photos of 2016 show the north side, those of 2023 the south side",
    needs=("images", "periods", "reprojections", "point_periods"),
)
def period_apart(scene: RawScene) -> Iterator[Hit]:
    if len(scene.period_ids) > MOST_PERIODS:
        return
    share = common_view(scene)
    share[~(np.diag(share) >= OWN)] = np.nan  # cameras that miss their own points tell nothing
    elsewhere = scene.derived(own_frames).keys() | _other_depths(scene).keys()
    for index in elsewhere:  # what is seen in a wrong frame says nothing of places
        share[index], share[:, index] = np.nan, np.nan
    for index, period in enumerate(scene.period_ids):
        both = np.fmax(np.delete(share[index], index), np.delete(share[:, index], index))
        if np.isfinite(both).any() and np.nanmax(both) < APART:
            found = f"at most {100 * np.nanmax(both):.1f} % of the points in common view"
            yield Hit(f"period {period}", "views of the place that the others show", found)


def common_view(scene: RawScene) -> NDArray[np.float64]:
    """Share of the points of a period (columns) in the view of a camera of another one (rows).

    Points and images are samples. NaN for periods without points or without cameras. [T, T]
    """
    images, points, seen = scene.images, scene.points, scene.point_periods
    assert images is not None and points is not None and seen is not None
    count = len(scene.period_ids)
    share = np.full((count, count), np.nan)
    reach = scene.depths(95)
    finite = np.isfinite(points.xyz).all(axis=1)
    owners = [_sample(finite & seen[:, i], MOST_POINTS // count) for i in range(count)]
    xyz = points.xyz[np.concatenate([np.zeros(0, np.int64), *owners])]
    owner = np.repeat(np.arange(count), list(map(len, owners)))
    known = np.isin(images.camera_ids, list(scene.usable_cameras))
    known &= ~np.isnan(scene.centres).any(axis=1)
    rotations = rotation_from_quaternion(images.quaternions)
    for row in sorted(reach.keys() - {-1}):
        viewed = np.zeros(len(xyz), bool)
        for image in _sample(known & (scene.image_periods == row), MOST_IMAGES // count).tolist():
            camera = scene.usable_cameras[int(images.camera_ids[image])]
            rotation, translation = rotations[image], images.translations[image]
            depth, x, y = project(rotation, translation, camera, *xyz.T)
            inside = (x >= 0) & (x <= camera.width) & (y >= 0) & (y <= camera.height)
            viewed |= inside & (depth > 0) & (depth < REACH * reach[row])
        for column in range(count):
            if len(owners[column]):
                share[row, column] = viewed[owner == column].mean()
    return share


def _sample(mask: NDArray[np.bool_], most: int) -> NDArray[np.int64]:
    """Indices where a mask is true, about ``most`` of them evenly spread."""
    index = np.flatnonzero(mask)
    return index[:: len(index) // max(1, most) + 1]
