"""The task ``features``: images and their features in COLMAP's database. Worker process only.

Images enter the database in the order of the photos, so ids are the same in every run. A record
beside the database says what it was made for: that of other photos, cameras or settings is made
anew. Otherwise, stored features are not computed again. Features that the user gives take the place
of SIFT (`given`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import cv2

from chronoscene.images.masks import find_masks
from chronoscene.io.processes import Report
from chronoscene.io.pycolmap import pycolmap
from chronoscene.io.staging import sha256_of, write_text_atomic
from chronoscene.registration.features import METHOD
from chronoscene.registration.features.database import Features, quiet, store_features
from chronoscene.registration.features.given import tasks as given_features
from chronoscene.registration.features.sift import photos_at_once, sift_features
from chronoscene.registration.work_folder import read_record

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
        known beforehand; ``absent``: photos that a given file lacks; ``remarks``.
    """
    quiet()
    database, photos, groups = (arguments[k] for k in ("database", "photos", "groups"))
    _prepare(Path(database), arguments)
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
        "absent": absent,
        "remarks": remarks,
    }


def _prepare(database: Path, arguments: Mapping[str, Any]) -> None:
    """Make a new database with the images, unless there is one that was made for the same."""
    record, wanted = database.with_suffix(".json"), _record(arguments)
    if database.exists() and read_record(record) == wanted:
        return
    # SQLite ignores the journals without their database.
    for path in (record, database, f"{database}-wal", f"{database}-shm"):
        Path(path).unlink(missing_ok=True)
    _import(str(database), arguments["photos"], arguments["groups"])
    write_text_atomic(record, json.dumps(wanted))  # without one, a database is incomplete


def _record(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return all that features depend on, photos and masks by their SHA-256."""
    folder, groups = Path(arguments["photos"]), arguments["groups"]
    names = sorted(name for group in groups for name in group["names"])
    masks = find_masks(folder.parent, names)
    files = [[folder / name, *([masks[name]] if name in masks else [])] for name in names]
    with ThreadPoolExecutor(arguments["threads"]) as pool:
        digests = list(pool.map(lambda group: "".join(map(sha256_of, group)), files))
    kept = ("max_image_size", "max_features", "given")
    settings = {key: arguments[key] for key in kept if key in arguments}
    made_by = {"method": METHOD, "pycolmap": pycolmap.__version__, "opencv": cv2.__version__}
    return {
        "settings": settings | made_by,
        "groups": groups,
        "photos": dict(zip(names, digests, strict=True)),
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
