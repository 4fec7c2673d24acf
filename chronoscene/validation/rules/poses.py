"""CS12: poses of the images."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from chronoscene.validation.checks.reprojection import good_poses
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.scene_folder import RawScene

UNIT_TOLERANCE = 1e-3
"""Deviation of a quaternion's length from 1 that rounding in a text file cannot explain."""

FAR = 1000.0
"""Distance from the origin in extents of the scene. Single precision has 7 digits: at this distance
it resolves a ten-thousandth of the scene, about a pixel."""

STRAY = 20.0
"""Distance of a camera from the middle of all, in units of the distance that nine tenths of the
cameras, or half of the points, do not exceed."""


@rule(
    "CS121",
    "pose-not-finite",
    "error",
    what="A pose has NaN, infinity, or a quaternion of zeros.",
    remedy="remove the image from the model, or register it again",
    bad="`nan` in a translation; quaternion `0 0 0 0`",
    needs=("images",),
)
def pose_not_finite(scene: RawScene) -> Iterator[Hit]:
    images = scene.images
    assert images is not None
    for i in np.flatnonzero(~good_poses(images)):
        pose = [*images.quaternions[i], *images.translations[i]]
        found = " ".join(f"{x:g}" for x in pose)
        yield Hit(scene.image_place(images.names[i]), "a finite pose", found)


@rule(
    "CS122",
    "quaternion-not-unit",
    "warning",
    what="A quaternion is not of length 1; some readers then scale the rotation.",
    remedy="divide the quaternion by its length, after checking that its order is w, x, y, z",
    bad="quaternion `2 0 0 0`",
    needs=("images",),
)
def quaternion_not_unit(scene: RawScene) -> Iterator[Hit]:
    images = scene.images
    assert images is not None
    norm = np.linalg.norm(images.quaternions[good := good_poses(images)], axis=1)
    rows = np.flatnonzero(good)[np.abs(norm - 1) > UNIT_TOLERANCE]
    for i in rows:
        length = np.linalg.norm(images.quaternions[i])
        place = scene.image_place(images.names[i])
        yield Hit(place, "a quaternion of length 1", f"length {length:.4g}")


@rule(
    "CS123",
    "far-from-origin",
    "warning",
    what="The scene is so far from the origin that single precision cannot resolve it.",
    remedy="subtract an offset from the model and state it in sparse/world.json",
    bad="a model in UTM coordinates, 4,427,000 m north",
    needs=("images",),
)
def far_from_origin(scene: RawScene) -> Iterator[Hit]:
    centres = scene.centres[~np.isnan(scene.centres).any(axis=1)]
    if len(centres) < 2:
        return
    middle = np.median(centres, axis=0)
    extent = float(np.median(np.linalg.norm(centres - middle, axis=1)))
    distance = float(np.linalg.norm(middle))
    if extent > 0 and distance > FAR * extent:
        found = f"cameras {distance:.3g} away from it, within {extent:.3g} of their median"
        yield Hit(scene.model_file("images"), "cameras near the origin of the world", found)


@rule(
    "CS124",
    "far-camera",
    "warning",
    what="A camera is absurdly far from the others and from the points; methods that take the size "
    "of the scene from its cameras get it wrong.",
    remedy="look at the pose: the image was probably registered in a wrong place; take it out of "
    "the model or register it again",
    bad="a camera 3 km from a square of 100 m",
    needs=("images",),
)
def far_camera(scene: RawScene) -> Iterator[Hit]:
    assert scene.images is not None
    posed = np.flatnonzero(~np.isnan(scene.centres).any(axis=1))
    if not len(posed):
        return
    middle = np.median(scene.centres[posed], axis=0)
    distance = np.linalg.norm(scene.centres[posed] - middle, axis=1)
    typical = float(np.percentile(distance, 90))
    if scene.points is not None and len(scene.points):
        typical = max(
            typical, float(np.nanmedian(np.linalg.norm(scene.points.xyz - middle, axis=1)))
        )
    if not 0 < typical < np.inf:
        return
    for i in np.flatnonzero(distance > STRAY * typical).tolist():
        place = scene.image_place(scene.images.names[posed[i]])
        expected = f"a camera within {STRAY * typical:.3g} of the middle of all"
        yield Hit(place, expected, f"one {distance[i]:.3g} away")
