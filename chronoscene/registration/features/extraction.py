"""The task ``features``: images and their features in COLMAP's database. Worker process only.

Images enter the database in the order of the photos, so ids are the same in every run. Features
that are stored are not computed again, and those of the same photos in an earlier database are
copied (`feature_reuse`). Features that the user gives take the place of SIFT (`given`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import cv2

from chronoscene.images.masks import find_masks
from chronoscene.io.processes import Report
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.database import Features, quiet, store_features
from chronoscene.registration.features.feature_reuse import record_of, renew
from chronoscene.registration.features.given import tasks as given_features
from chronoscene.registration.features.sift import photos_at_once, sift_features

BATCH = 64  # Photos

Extractor = Callable[[Path, Path | None], Features]
"""Compute the features of a photo, given its mask or None; called by several threads."""


def extract(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Import images and extract SIFT features, or take given ones.

    Arguments: ``database``, ``photos`` (folder), ``groups`` (lists of names that share a camera,
    each with ``names``, ``model`` and ``params`` or null), ``max_image_size``, ``max_features``,
    ``threads``, ``given`` (see `given.source.find_sources`; may be missing).

    Returns:
        ``keypoints``: number by name; ``focal_known``: whether the focal length of each camera is
        known beforehand; ``carried``: number of photos with features from an earlier database;
        ``absent``: photos that a given file lacks; ``remarks``.
    """
    quiet()
    database, photos, groups = (arguments[k] for k in ("database", "photos", "groups"))
    create = partial(_import, database, photos, groups)
    reused = renew(Path(database), record_of(arguments), create)
    size = arguments["max_image_size"]
    extractor: Extractor = partial(
        sift_features, max_image_size=size, max_features=arguments["max_features"]
    )
    names = sorted(name for group in groups for name in group["names"])
    absent: list[str] = []
    remarks: list[str] = []
    if given := arguments.get("given"):
        extractor, absent, remarks = given_features.extractor(given, Path(photos), names)
    left = _without_features(database, names)
    threads = photos_at_once(size, arguments["threads"])
    found = _features(extractor, Path(photos), left, threads)
    for done, (name, features) in enumerate(zip(left, found, strict=True), len(names) - len(left)):
        report("features", done, len(names))
        store_features(database, name, features)
    report("features", len(names), len(names))
    with pycolmap.Database.open(database) as opened:
        known = {c.camera_id: bool(c.has_prior_focal_length) for c in opened.read_all_cameras()}
        counts = {
            str(image.name): int(opened.num_keypoints_for_image(image.image_id))
            for image in opened.read_all_images()
        }
    return {
        "keypoints": {name: counts[name] for name in names},
        "focal_known": known,
        "carried": reused,
        "absent": absent,
        "remarks": remarks,
    }


def _features(
    extractor: Extractor, folder: Path, names: Sequence[str], threads: int
) -> Iterator[Features]:
    """Features of photos, in their order; threads are never far ahead of the caller."""
    cv2.setNumThreads(1)  # each photo is the work of one thread
    masks = find_masks(folder.parent, names)
    with ThreadPoolExecutor(threads) as pool:
        for first in range(0, len(names), BATCH):
            batch = names[first : first + BATCH]
            yield from pool.map(extractor, map(folder.joinpath, batch), map(masks.get, batch))


def _without_features(database: str, names: Sequence[str]) -> list[str]:
    """Photos whose features are not stored; a photo in which none were found is done."""
    with pycolmap.Database.open(database) as opened:
        ids = {str(image.name): image.image_id for image in opened.read_all_images()}
        return [name for name in names if not opened.exists_keypoints(ids[name])]


def _import(database: str, photos: str, groups: Sequence[Mapping[str, Any]]) -> None:
    """Add the images of each group, with one camera for all of them, to a new database."""
    pycolmap.Database.open(database).close()
    for group in groups:
        options = pycolmap.ImageReaderOptions(camera_model=group["model"])
        if group["params"] is not None:
            options.camera_params = ",".join(repr(float(p)) for p in group["params"])
        pycolmap.import_images(
            database, photos, pycolmap.CameraMode.SINGLE, group["names"], options
        )
    with pycolmap.Database.open(database) as opened:
        opened.clear_pose_priors()  # positions are checked first; see gps_priors
