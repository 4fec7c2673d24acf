"""CS12: poses of the images, and the convention they are written in."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array
from chronoscene.colmap.raw_model import RawImages
from chronoscene.scene.geometry import rotation_from_quaternion
from chronoscene.validation import rule
from chronoscene.validation.checks.reprojection import image_errors, pose_limit
from chronoscene.validation.folder.observations import good_poses
from chronoscene.validation.folder.scene_folder import RawScene, derived
from chronoscene.validation.rule import Hit

UNIT_TOLERANCE = 1e-3  # Deviation of a quaternion's length from 1 beyond rounding in a text file

MAX_DISTANCE = 1000.0
"""Distance from the origin in extents of the scene. Single precision has 7 digits: at this distance
it resolves a ten-thousandth of the scene, about a pixel."""

STRAY = 20.0
"""Distance of a camera from the centre of all cameras, in units of the distance within which nine
tenths of the cameras, or half of the points, lie."""

MAX_WRONG = 0.5
"""Share of the images with a pose that does not fit, beyond which all poses are doubted."""

MAX_OBSERVATIONS = 5000

ORDERS = {"": [0, 1, 2, 3], "quaternions in the order x, y, z, w": [3, 0, 1, 2]}
"""Description to the positions of w, x, y and z among the four numbers."""

MEANINGS = (
    "",
    "camera-to-world poses",
    "camera centres in place of the translations",
    "rotations from camera to world",
)
"""Meanings of rotation and translation; COLMAP writes the first."""

AXES = {"": np.ones(3), "OpenGL axes (y up, z backwards)": np.array([1.0, -1.0, -1.0])}


@rule.error(
    "CS121",
    bad="`nan` in a translation; quaternion `0 0 0 0`",
    remedy=f"leave the image out ({rule.LEAVE_OUT}), or register it again",
)
def pose_not_finite(scene: RawScene, images: RawImages) -> Iterator[Hit]:
    """A pose contains NaN or infinity, or its quaternion is zero."""
    for i in np.flatnonzero(~good_poses(images)):
        found = " ".join(f"{x:g}" for x in [*images.quaternions[i], *images.translations[i]])
        yield Hit(scene.image_place(images.names[i]), "a finite pose", found)


@rule.warning(
    "CS122",
    bad="quaternion `2 0 0 0`",
    remedy="normalise the quaternion, after checking that its order is w, x, y, z",
)
def quaternion_not_unit(scene: RawScene, images: RawImages) -> Iterator[Hit]:
    """A quaternion does not have unit length; some readers then scale the rotation."""
    length = np.linalg.norm(images.quaternions, axis=1)
    for i in np.flatnonzero(good_poses(images) & (np.abs(length - 1) > UNIT_TOLERANCE)):
        place = scene.image_place(images.names[i])
        yield Hit(place, "a quaternion of length 1", f"length {length[i]:.4g}")


@rule.warning(
    "CS123",
    bad="a model in UTM coordinates, 4,427,000 m north",
    remedy="subtract an offset from the model and record it in sparse/world.json",
)
def far_from_origin(scene: RawScene, centres: Array) -> Iterator[Hit]:
    """The scene is too far from the origin to be resolved in single precision."""
    centres = centres[scene.is_posed]
    if len(centres) < 2:
        return
    middle = np.median(centres, axis=0)
    extent = float(np.median(np.linalg.norm(centres - middle, axis=1)))
    distance = float(np.linalg.norm(middle))
    if extent > 0 and distance > MAX_DISTANCE * extent:
        found = f"cameras {distance:.3g} away from it, within {extent:.3g} of their median"
        yield Hit(scene.model_file("images"), "cameras near the origin of the world", found)


@rule.warning(
    "CS124",
    bad="a camera 3 km away from a square of 100 m",
    remedy="check the pose: the image was probably registered in the wrong place; leave it out "
    f"({rule.LEAVE_OUT}) or register it again",
)
def far_camera(scene: RawScene, images: RawImages) -> Iterator[Hit]:
    """A camera is absurdly far from the other cameras and the points; methods that derive the size
    of the scene from its cameras get it wrong."""
    posed = np.flatnonzero(scene.is_posed)
    if not len(posed):
        return
    middle = np.median(scene.centres[posed], axis=0)
    distance = np.linalg.norm(scene.centres[posed] - middle, axis=1)
    typical = float(np.percentile(distance, 90))
    if scene.points is not None and len(scene.points):
        to_points = np.linalg.norm(scene.points.xyz - middle, axis=1)
        typical = max(typical, float(np.nanmedian(to_points)))
    if not 0 < typical < np.inf:
        return
    expected = f"a camera within {STRAY * typical:.3g} of the centre of all cameras"
    for i in np.flatnonzero(distance > STRAY * typical).tolist():
        place = scene.image_place(images.names[posed[i]])
        yield Hit(place, expected, f"a camera {distance[i]:.3g} away")


@rule.error(
    "CS125",
    bad="camera-to-world poses; SciPy's quaternions; camera centres as translations",
    remedy="write world-to-camera poses as COLMAP does: quaternion w, x, y, z, translation t = -R "
    "c for a camera centre c, +x right, +y down, +z forward",
    needs=("images", "reprojections"),
)
def pose_convention(scene: RawScene) -> Iterator[Hit]:
    """The poses fit the points only when read in another convention."""
    if found := other_convention(scene):
        place = scene.model_file("images")
        yield Hit(place, "poses as COLMAP writes them", f"poses that fit as {found}")


@derived
def other_convention(scene: RawScene) -> str | None:
    """Describe the convention that explains poses most of which do not fit."""
    errors = image_errors(scene)
    looked_at = [r for r in scene.reprojections or () if len(r.rows)]
    limits = {r.image: pose_limit(scene, r.image) for r in looked_at}
    wrong = [r for r in looked_at if not errors[r.image] <= limits[r.image]]
    if not wrong or len(wrong) <= MAX_WRONG * len(looked_at):
        return None
    sample = _Sample(scene, np.concatenate([r.rows for r in wrong]))
    limit = float(np.median([limits[r.image] for r in wrong]))
    tried = {
        (order, meaning, axes): sample.error(order, meaning, axes)
        for order, meaning, axes in product(ORDERS, MEANINGS, AXES)
    }
    best = min(tried, key=lambda key: tried[key])
    if tried[best] <= limit and any(best[:2]):  # axes alone have their own rule
        return " and ".join(words for words in best if words)
    return None


class _Sample:
    """A sample of observations that can be projected in any convention (m observations)."""

    def __init__(self, scene: RawScene, rows: NDArray[np.int64]) -> None:
        images, points, seen = scene.images, scene.points, scene.observations
        assert images is not None and points is not None and seen is not None
        rows = rows[:: len(rows) // MAX_OBSERVATIONS + 1]
        image = seen.image[rows]
        cameras = [scene.usable_cameras[int(i)] for i in images.camera_ids[image]]
        K = np.array([camera.K for camera in cameras])
        self._pixels = images.keypoint_xy[seen.keypoint[rows]]
        self._focal, self._middle = K[:, [0, 1], [0, 1]], K[:, :2, 2]
        self._xyz = points.xyz[seen.point[rows]]
        self._quaternion = np.where(good_poses(images)[:, None], images.quaternions, 1.0)[image]
        self._translation = images.translations[image]

    def error(self, order: str, meaning: str, axes: str) -> float:
        """Median reprojection error in pixels in a convention, without distortion."""
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
