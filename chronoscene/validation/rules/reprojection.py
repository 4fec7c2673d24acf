"""CS51: whether points, poses and cameras fit each other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from chronoscene.validation.finding import Hit
from chronoscene.validation.raw_scene import RawScene
from chronoscene.validation.rule import rule

MOST_OUTSIDE = 0.05
"""Share of observations outside of the image; undistortion leaves a few there."""

MOST_BEHIND = 0.5
"""Share of observations behind their camera. In a model that belongs together there are none."""

ERROR_SHARE, LEAST_ERROR = 0.01, 4.0
"""Median reprojection error of an image, as a share of its diagonal and in pixels, beyond which its
pose does not fit. COLMAP itself drops observations beyond 4 pixels."""


@rule(
    "CS511",
    "observations-outside",
    "warning",
    what=f"More than {MOST_OUTSIDE:.0%} of a camera's observations are outside of its image.",
    remedy="give the camera the size at which the keypoints were found",
    bad="a camera scaled to half the size, keypoints still at full size",
    needs=("images", "reprojections"),
)
def observations_outside(scene: RawScene) -> Iterator[Hit]:
    assert scene.images is not None
    total: Counter[int] = Counter()
    outside: Counter[int] = Counter()
    for seen in scene.reprojections or ():
        camera_id = int(scene.images.camera_ids[seen.image])
        total[camera_id] += len(seen.rows)
        outside[camera_id] += seen.outside
    for camera_id, number in outside.items():
        if number > MOST_OUTSIDE * total[camera_id]:
            camera = scene.usable_cameras[camera_id]
            place = f"{scene.model_file('cameras')} (camera {camera_id})"
            expected = f"observations within {camera.width} x {camera.height}"
            yield Hit(place, expected, f"{number} of {total[camera_id]} outside", count=number)


@rule(
    "CS512",
    "points-behind-cameras",
    "error",
    what="Most points are behind the cameras that see them: the poses are in another convention.",
    remedy="store world-to-camera poses with +x right, +y down, +z forward (negate the y and z "
    "axes of OpenGL cameras; invert camera-to-world poses)",
    bad="poses with OpenGL axes",
    needs=("reprojections",),
)
def points_behind_cameras(scene: RawScene) -> Iterator[Hit]:
    total = behind = 0
    for seen in scene.reprojections or ():
        total += len(seen.depth)
        behind += int(np.count_nonzero(~(seen.depth > 0)))
    if behind > MOST_BEHIND * total:
        found = f"{behind} of {total} observations behind the camera"
        yield Hit(scene.model_file("images"), "points in front of the cameras", found)


@rule(
    "CS513",
    "pose-disagrees",
    "warning",
    what="The points that an image sees do not project to where it sees them.",
    remedy="check pose, camera and image size of this image, or register it again",
    bad="a camera-to-world pose; a focal length of another image size",
    needs=("images", "reprojections"),
)
def pose_disagrees(scene: RawScene) -> Iterator[Hit]:
    assert scene.images is not None
    for image in np.flatnonzero(~np.isnan(scene.image_errors)).tolist():
        limit, median = pose_limit(scene, image), scene.image_errors[image]
        if not median <= limit:
            place = scene.image_place(scene.images.names[image])
            expected = f"a median reprojection error below {limit:.3g} px"
            yield Hit(place, expected, f"{median:.3g} px")


def pose_limit(scene: RawScene, image: int) -> float:
    """Reprojection error in pixels beyond which the pose of an image does not fit."""
    assert scene.images is not None
    camera = scene.usable_cameras[int(scene.images.camera_ids[image])]
    return max(LEAST_ERROR, ERROR_SHARE * float(np.hypot(camera.width, camera.height)))
