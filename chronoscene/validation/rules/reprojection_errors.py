"""CS51: whether points, poses and cameras fit each other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from chronoscene.io.wording import shown
from chronoscene.validation.checks.period_frames import own_frames
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.rules.conventions import pose_convention
from chronoscene.validation.scene_folder import RawScene

MOST_OUTSIDE = 0.05
"""Share of observations outside of the image; undistortion leaves a few there."""

MOST_BEHIND = 0.5
"""Share of observations behind their camera. In a model that belongs together there are none."""

MOST_WRONG = 0.5
"""Share of the images of a period that disagree, beyond which one finding is on all of them."""


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
    errors = scene.image_errors
    judged = np.flatnonzero(~np.isnan(errors)).tolist()
    limits = {image: scene.pose_limit(image) for image in judged}
    wrong = [image for image in judged if not errors[image] <= limits[image]]
    if wrong and any(pose_convention(scene)):
        return  # says why, for all of them
    for index in sorted({int(scene.image_periods[image]) for image in wrong}):
        if index in scene.derived(own_frames):
            continue  # says why
        mine = [image for image in wrong if scene.image_periods[image] == index]
        of_period = sum(int(scene.image_periods[image]) == index for image in judged)
        if index >= 0 and len(mine) > max(1, MOST_WRONG * of_period):
            yield _most_of(scene, index, mine, of_period)
            continue
        for image in mine:
            place = scene.image_place(scene.images.names[image])
            expected = f"a median reprojection error below {limits[image]:.3g} px"
            yield Hit(place, expected, f"{errors[image]:.3g} px")


def _most_of(scene: RawScene, index: int, wrong: list[int], judged: int) -> Hit:
    """One hit for the images of a period that disagree."""
    assert scene.images is not None
    limit = float(np.median([scene.pose_limit(image) for image in wrong]))
    worst = sorted(wrong, key=lambda image: -scene.image_errors[image])
    named = shown([scene.images.names[image] for image in worst])
    found = f"{np.median(scene.image_errors[wrong]):.3g} px in {len(wrong)} of {judged}: {named}"
    expected = f"images with a median reprojection error below {limit:.3g} px"
    return Hit(f"period {scene.period_ids[index]}", expected, found, count=len(wrong))
