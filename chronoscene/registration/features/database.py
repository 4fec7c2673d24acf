"""COLMAP's database of features and matches, and files of image pairs. Worker process only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from chronoscene.io.pycolmap import pycolmap
from chronoscene.io.staging import write_text_atomic

SEED = 0

Features = tuple[np.ndarray, np.ndarray]
"""Keypoints [K, 6], float32: x and y in pixels of the photo, and the 2 x 2 matrix of scale and
rotation by rows; descriptors [K, 128], uint8. Given ones may lack the matrix, and have descriptors
[K, D] of float32."""


def quiet() -> None:
    """Silence COLMAP's progress messages, and seed its random numbers."""
    pycolmap.logging.minloglevel = 2
    pycolmap.set_random_seed(SEED)


def copy_database(source: Path, target: Path) -> None:
    """Copy a database, including what is still in its journal."""
    import sqlite3

    with sqlite3.connect(source) as a, sqlite3.connect(target) as b:
        a.backup(b)
    a.close()
    b.close()
    remove_journals(target)


def remove_journals(database: Path) -> None:
    """Remove journals that remain after the last connection is closed, or when the disk is full."""
    for suffix in ("-wal", "-shm"):
        Path(f"{database}{suffix}").unlink(missing_ok=True)


def copy_with_cameras(
    source: str, target: Path, cameras: Mapping[int, tuple[str, Sequence[float]]]
) -> None:
    """Copy a database, with other models and parameters of some cameras, by their ids."""
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)
    copy_database(Path(source), target)
    with pycolmap.Database.open(target) as opened:
        for camera_id, (name, params) in cameras.items():
            camera = opened.read_camera(camera_id)
            camera.model = getattr(pycolmap.CameraModelId, name)
            camera.params = params
            opened.update_camera(camera)


def read_pairs(path: Path) -> list[tuple[str, str]]:
    """Read pairs of names from a file that `write_pairs` wrote."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return [(a, b) for a, b in (line.split(" ") for line in lines)]


def write_pairs(path: Path, pairs: Sequence[tuple[str, str]]) -> None:
    """Write pairs of names, one per line. COLMAP splits at blanks, so names must have none."""
    write_text_atomic(path, "".join(f"{a} {b}\n" for a, b in pairs))


def store_features(database: str, name: str, features: Features) -> None:
    """Store the features of an image; the keypoints last, by which it counts as done."""
    keypoints, descriptors = features
    with pycolmap.Database.open(database) as opened:
        image = opened.read_image_with_name(name)
        assert image is not None
        if not opened.exists_descriptors(image.image_id):
            kind = pycolmap.FeatureExtractorType.SIFT
            if descriptors.dtype != np.uint8:
                kind = pycolmap.FeatureExtractorType.UNDEFINED
                descriptors = np.ascontiguousarray(descriptors, np.float32).view(np.uint8)
            found = pycolmap.FeatureDescriptors(kind, descriptors)
            opened.write_descriptors(image.image_id, found)
        opened.write_keypoints(image.image_id, keypoints)


def read_features(opened: pycolmap.Database, image_id: int) -> Features:
    """Read what `store_features` wrote."""
    found = opened.read_descriptors(image_id)
    data = np.asarray(found.data)
    if found.type != pycolmap.FeatureExtractorType.SIFT:
        data = data.view(np.float32)
    return np.asarray(opened.read_keypoints(image_id)), data


def verified_matches(
    database: str | Path,
) -> tuple[dict[int, str], dict[tuple[int, int], np.ndarray]]:
    """Names by image id, and the inliers of each verified pair as keypoint indices. [M, 2]"""
    with pycolmap.Database.open(str(database)) as opened:
        names = {int(i.image_id): str(i.name) for i in opened.read_all_images()}
        pair_ids, geometries = opened.read_two_view_geometries()
    matches = {}
    for pair_id, geometry in zip(pair_ids, geometries, strict=True):
        inliers = np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)
        if len(inliers):
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            matches[int(first), int(second)] = inliers
    return names, matches


def keypoints_of(database: str | Path) -> dict[int, np.ndarray]:
    """Pixel positions of the keypoints of each image. [K, 2]"""
    with pycolmap.Database.open(str(database)) as opened:
        return {
            int(i.image_id): np.asarray(opened.read_keypoints(i.image_id), np.float64)[:, :2]
            for i in opened.read_all_images()
        }
