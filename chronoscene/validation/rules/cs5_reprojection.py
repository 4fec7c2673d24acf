"""CS512, CS513, CS515, CS516: points, poses and cameras against each other."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from chronoscene.colmap.raw_model import RawImages
from chronoscene.io.wording import shown
from chronoscene.validation import rule
from chronoscene.validation.checks import reprojection
from chronoscene.validation.checks.reprojection import image_errors, pose_limit
from chronoscene.validation.folder.observations import Reprojection
from chronoscene.validation.folder.scene_folder import RawScene
from chronoscene.validation.rule import Hit
from chronoscene.validation.rules.cs1_poses import other_convention

MAX_BEHIND = 0.5  # Share of observations behind their camera. A consistent model has none.
MAX_WRONG = 0.5  # Share of the images of a period beyond which one finding reports all of them


@rule.error(
    "CS512",
    bad="poses with OpenGL axes",
    remedy="store world-to-camera poses with +x right, +y down, +z forward (negate the y and z "
    "axes of OpenGL cameras; invert camera-to-world poses)",
)
def points_behind_cameras(scene: RawScene, reprojections: list[Reprojection]) -> Iterator[Hit]:
    """Most points are behind the cameras that see them: the poses use another convention."""
    total = sum(len(seen.depth) for seen in reprojections)
    behind = sum(int(np.count_nonzero(~(seen.depth > 0))) for seen in reprojections)
    if behind > MAX_BEHIND * total:
        found = f"{behind} of {total} observations behind the camera"
        yield Hit(scene.model_file("images"), "points in front of the cameras", found)


@rule.warning(
    "CS513",
    bad="a camera-to-world pose; a focal length of another image size",
    remedy="check pose, camera and image size of this image, or register it again",
    needs=("reprojections",),
)
def pose_disagrees(scene: RawScene, images: RawImages) -> Iterator[Hit]:
    """The points that an image sees are reprojected far from where it sees them."""
    errors, judged = image_errors(scene), reprojection.judged_images(scene)
    limits = {image: pose_limit(scene, image) for image in judged}
    wrong = [image for image in judged if not errors[image] <= limits[image]]
    if wrong and other_convention(scene):
        return  # CS125 gives the reason for all of them
    for index in sorted({int(scene.image_periods[image]) for image in wrong}):
        mine = [image for image in wrong if scene.image_periods[image] == index]
        total = sum(int(scene.image_periods[image]) == index for image in judged)
        if index >= 0 and len(mine) > max(1, MAX_WRONG * total):
            limit = float(np.median([limits[image] for image in mine]))
            worst = sorted(mine, key=lambda image: -errors[image])
            named = shown([images.names[image] for image in worst])
            found = f"{np.median(errors[mine]):.3g} px in {len(mine)} of {total}: {named}"
            expected = f"images with a median reprojection error below {limit:.3g} px"
            yield Hit(f"period {scene.period_ids[index]}", expected, found, count=len(mine))
            continue
        for image in mine:
            place = scene.image_place(images.names[image])
            expected = f"a median reprojection error below {limits[image]:.3g} px"
            yield Hit(place, expected, f"{errors[image]:.3g} px")


@rule.warning(
    "CS515",
    bad="medians of 0.5 px in period 0 and 3.1 px in period 1",
    remedy="register the period again: refine its poses and its camera, or match more images",
    needs=("periods", "reprojections"),
)
def period_error(scene: RawScene, images: RawImages) -> Iterator[Hit]:
    """The reprojection error of a period is far above that of another period."""
    errors, judged = image_errors(scene), reprojection.judged_images(scene)
    medians = reprojection.period_errors(scene)
    limit = reprojection.outlier_limit(min(medians.values(), default=0.0))
    if not judged or limit > reprojection.WORSE * np.median([pose_limit(scene, i) for i in judged]):
        return  # no period fits: nothing to compare with
    for period, median in medians.items():
        if median > limit:
            index = scene.period_ids.index(period)
            known = np.flatnonzero((scene.image_periods == index) & ~np.isnan(errors))
            worst = known[np.argsort(-errors[known])]
            found = f"{median:.3g} px; the worst are {shown([images.names[i] for i in worst])}"
            yield Hit(f"period {period}", f"a median error below {limit:.3g} px", found)


@rule.warning(
    "CS516",
    bad="3.1 px in one image, 0.5 px in the others",
    remedy="check pose and camera of this image, or register it again",
    needs=("periods", "reprojections"),
)
def image_error(scene: RawScene, images: RawImages) -> Iterator[Hit]:
    """The reprojection error of an image is far above that of its period."""
    for image in reprojection.judged_images(scene):
        index, error = int(scene.image_periods[image]), float(image_errors(scene)[image])
        period = scene.period_ids[index] if index >= 0 else -1
        usual = reprojection.period_errors(scene).get(period, np.inf)
        limit = reprojection.outlier_limit(usual)
        if limit < error <= pose_limit(scene, image):  # CS513 reports larger ones
            place = scene.image_place(images.names[image])
            yield Hit(place, f"a median error below {limit:.3g} px", f"{error:.3g} px")
