"""First step: images and their SIFT features in COLMAP's database. Worker process only.

Images enter the database in the order of the photos, so ids are the same in every run. What is
stored is not done again. Features of the same photos in an earlier database are copied; see
`feature_reuse`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2

from chronoscene.images.masks import find_masks
from chronoscene.io.processes import Report
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features import feature_reuse
from chronoscene.registration.features.database import quiet
from chronoscene.registration.features.sift import Features, photos_at_once, sift_features

BATCH = 64  # Photos


def extract(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Import images and extract SIFT features.

    Arguments: ``database``, ``photos`` (folder), ``groups`` (lists of names that share a camera,
    each with ``names``, ``model`` and ``params`` or null), ``max_image_size``, ``max_features``,
    ``threads``.

    Returns:
        ``keypoints``: number by name; ``focal_known``: whether the focal length of each camera is
        known beforehand; ``carried``: number of photos with features from an earlier database.
    """
    quiet()
    database, photos = arguments["database"], arguments["photos"]
    feature_reuse.renew(Path(database), feature_reuse.record_of(arguments))
    _import(database, photos, arguments["groups"])
    reused = feature_reuse.reuse_features(Path(database))
    names = sorted(name for group in arguments["groups"] for name in group["names"])
    left = [name for name, count in keypoint_counts(database).items() if count == 0]
    left = sorted(set(left) & set(names))
    options = (arguments[k] for k in ("max_image_size", "max_features", "threads"))
    masks = find_masks(Path(photos).parent, left)
    found = _features([(Path(photos, name), masks.get(name)) for name in left], *options)
    for done, (name, features) in enumerate(zip(left, found, strict=True), len(names) - len(left)):
        report("features", done, len(names))
        _store(database, name, features)
    report("features", len(names), len(names))
    with pycolmap.Database.open(database) as opened:
        known = {c.camera_id: bool(c.has_prior_focal_length) for c in opened.read_all_cameras()}
    counts = keypoint_counts(database)
    return {
        "keypoints": {name: counts[name] for name in names},
        "focal_known": known,
        "carried": reused,
    }


def _store(database: str, name: str, features: Features) -> None:
    """Store the features of an image; the keypoints last, by which it counts as done."""
    keypoints, descriptors = features
    with pycolmap.Database.open(database) as opened:
        image = opened.read_image_with_name(name)
        assert image is not None
        image_id = image.image_id
        if not opened.exists_descriptors(image_id):
            kind = pycolmap.FeatureExtractorType.SIFT
            opened.write_descriptors(image_id, pycolmap.FeatureDescriptors(kind, descriptors))
        if not opened.exists_keypoints(image_id):
            opened.write_keypoints(image_id, keypoints)


def _features(
    files: Sequence[tuple[Path, Path | None]], max_image_size: int, max_features: int, threads: int
) -> Iterator[Features]:
    """Features of photos with masks, in their order; threads are never far ahead of the caller."""
    cv2.setNumThreads(1)  # each photo is the work of one thread

    def compute(file: tuple[Path, Path | None]) -> Features:
        return sift_features(file[0], max_image_size, max_features, file[1])

    with ThreadPoolExecutor(photos_at_once(max_image_size, threads)) as pool:
        for first in range(0, len(files), BATCH):
            yield from pool.map(compute, files[first : first + BATCH])


def keypoint_counts(database: str | Path) -> dict[str, int]:
    """Number of keypoints of each image."""
    with pycolmap.Database.open(str(database)) as opened:
        return {
            str(image.name): int(opened.num_keypoints_for_image(image.image_id))
            for image in opened.read_all_images()
        }


def _import(database: str, photos: str, groups: Sequence[Mapping[str, Any]]) -> None:
    """Add the images of each group, with one camera for all of them, unless they are there."""
    with pycolmap.Database.open(database) as opened:
        present = {str(image.name) for image in opened.read_all_images()}
    for group in groups:
        if present.issuperset(group["names"]):
            continue
        options = pycolmap.ImageReaderOptions(camera_model=group["model"])
        if group["params"] is not None:
            options.camera_params = ",".join(repr(float(p)) for p in group["params"])
        pycolmap.import_images(
            database, photos, pycolmap.CameraMode.SINGLE, group["names"], options
        )
    with pycolmap.Database.open(database) as opened:
        opened.clear_pose_priors()  # positions are checked first; see gps_priors
