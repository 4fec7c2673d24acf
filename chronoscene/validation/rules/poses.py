"""CS12: poses of the images."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from chronoscene.validation.finding import Hit
from chronoscene.validation.raw_scene import RawScene
from chronoscene.validation.reprojection import good_poses
from chronoscene.validation.rule import rule

UNIT_TOLERANCE = 1e-3
"""Deviation of a quaternion's length from 1 that rounding in a text file cannot explain."""

FAR = 1000.0
"""Distance from the origin in extents of the scene. Single precision has 7 digits: at this distance
it resolves a ten-thousandth of the scene, about a pixel."""


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
