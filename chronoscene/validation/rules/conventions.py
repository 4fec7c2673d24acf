"""CS125: poses that are right, but written in another convention."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray

from chronoscene.scene.geometry import rotation_from_quaternion
from chronoscene.validation.checks.reprojection import good_poses
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.scene_folder import RawScene

Array = NDArray[np.float64]

MOST_WRONG = 0.5
"""Share of the images with a pose that does not fit, beyond which all of them are doubted."""

MOST_OBSERVATIONS = 5000

ORDERS = {"": [0, 1, 2, 3], "quaternions in the order x, y, z, w": [3, 0, 1, 2]}
"""In words, which of the four numbers are w, x, y and z."""

MEANINGS = (
    "",
    "camera-to-world poses",
    "camera centres in place of the translations",
    "rotations from camera to world",
)
"""What rotation and translation say, in words; the first is what COLMAP writes."""

AXES = {"": np.ones(3), "axes of OpenGL (y up, z backwards)": np.array([1.0, -1.0, -1.0])}


@rule(
    "CS125",
    "pose-convention",
    "error",
    what="The poses fit the points if they are read in another convention.",
    remedy="write world-to-camera poses as COLMAP does: quaternion w, x, y, z, translation "
    "t = -R c for a camera centre c, +x right, +y down, +z forward",
    bad="camera-to-world poses; quaternions as SciPy has them; camera centres as translations",
    needs=("images", "reprojections"),
)
def pose_convention(scene: RawScene) -> Iterator[Hit]:
    errors, images = scene.image_errors, scene.images
    assert images is not None
    looked_at = [r for r in scene.reprojections or () if len(r.rows)]
    limits = {r.image: scene.pose_limit(r.image) for r in looked_at}
    wrong = [r for r in looked_at if not errors[r.image] <= limits[r.image]]
    if not wrong or len(wrong) <= MOST_WRONG * len(looked_at):
        return
    sample = _Sample(scene, np.concatenate([r.rows for r in wrong]))
    limit = float(np.median([limits[r.image] for r in wrong]))
    tried = {
        (order, meaning, axes): sample.error(order, meaning, axes)
        for order, meaning, axes in product(ORDERS, MEANINGS, AXES)
    }
    best = min(tried, key=lambda key: tried[key])
    if tried[best] <= limit and any(best[:2]):  # axes alone have their own rule
        found = " and ".join(words for words in best if words)
        place = scene.model_file("images")
        yield Hit(place, "poses as COLMAP writes them", f"poses that fit as {found}")


class _Sample:
    """Some observations, with what projects them in any convention (m observations)."""

    def __init__(self, scene: RawScene, rows: NDArray[np.int64]) -> None:
        images, points, seen = scene.images, scene.points, scene.observations
        assert images is not None and points is not None and seen is not None
        rows = rows[:: len(rows) // MOST_OBSERVATIONS + 1]
        image = seen.image[rows]
        cameras = [scene.usable_cameras[int(i)] for i in images.camera_ids[image]]
        K = np.array([camera.K for camera in cameras])
        self._pixels = images.keypoint_xy[seen.keypoint[rows]]
        self._focal, self._middle = K[:, [0, 1], [0, 1]], K[:, :2, 2]
        self._xyz = points.xyz[seen.point[rows]]
        self._quaternion = np.where(good_poses(images)[:, None], images.quaternions, 1.0)[image]
        self._translation = images.translations[image]

    def error(self, order: str, meaning: str, axes: str) -> float:
        """Median error in pixels, without distortion, in a convention."""
        with np.errstate(all="ignore"):
            rotation = rotation_from_quaternion(self._quaternion[:, ORDERS[order]])
            translation = self._translation
            which = MEANINGS.index(meaning)
            if which in (1, 3):
                rotation = np.swapaxes(rotation, 1, 2)
            if which in (1, 2):
                translation = -np.einsum("nij,nj->ni", rotation, translation)
            local = np.einsum("nij,nj->ni", rotation, self._xyz) + translation
            local = local * AXES[axes]
            xy = local[:, :2] / local[:, 2:] * self._focal + self._middle
            distance = np.linalg.norm(xy - self._pixels, axis=1)
        distance[~(local[:, 2] > 0) | np.isnan(distance)] = np.inf
        return float(np.median(distance))
