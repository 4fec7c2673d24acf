"""Features and matches of an earlier run, copied where the photos did not change. Worker only.

Features depend on the content of a photo and a few settings, matches on the features and cameras
of two photos. A record beside the database holds these. When it changes, the database is renamed,
a new one is made in the order of the photos, and what still holds is copied to it. The record is
written last: a database without one is incomplete, and made again.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

from chronoscene.images.masks import find_masks
from chronoscene.io.pycolmap import pycolmap
from chronoscene.io.staging import sha256_of, write_text_atomic
from chronoscene.registration.features import METHOD
from chronoscene.registration.work_folder import read_record

Record = dict[str, Any]
"""``settings`` that all features depend on, ``groups`` of photos with one camera, and ``photos``:
SHA-256 by name, followed by that of the mask where there is one."""


def record_of(arguments: Mapping[str, Any]) -> Record:
    """Record of the features that `extraction.extract` computes with these arguments."""
    import cv2  # the process that matches does not need it

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


def renew(database: Path, wanted: Record, create: Callable[[], None]) -> int:
    """Replace the database unless it is one of these photos.

    Args:
        database: Complete or not, or missing.
        wanted: Record of the photos.
        create: Called to import the images into a new database.

    Returns:
        Number of photos whose features were copied.
    """
    record = read_record(_record_path(database)) if database.exists() else None
    if record == wanted:
        return 0
    old = database.with_name(f"{database.stem}-old{database.suffix}")
    if record is not None and _is_readable(database):
        _remove(old)
        write_text_atomic(_record_path(old), json.dumps(record))
        database.replace(old)
    _remove(database)
    create()
    copied = _copy(old, database, wanted) if old.exists() else 0
    write_text_atomic(_record_path(database), json.dumps(wanted))
    _remove(old)
    return copied


def _record_path(database: Path) -> Path:
    return database.with_suffix(".json")


def _is_readable(database: Path) -> bool:
    """Return True unless it is damaged; closing it merges the journal of a killed process."""
    try:
        pycolmap.Database.open(database).close()
    except RuntimeError:
        return False
    return True


def _remove(database: Path) -> None:
    """Remove a record, its database, then the journals, which SQLite ignores without it."""
    for path in (_record_path(database), database, f"{database}-wal", f"{database}-shm"):
        Path(path).unlink(missing_ok=True)


def _copy(old_path: Path, new_path: Path, wanted: Record) -> int:
    """Copy features of the same photos, and matches and geometries of the same photos and cameras.

    Matches are sorted and verified in the order of the ids, and verification is not symmetric to
    the last bit. Where the order is reversed, a pair is matched again, so that the database is the
    same as one from scratch.
    """
    names = _unchanged(read_record(_record_path(old_path)), wanted)
    with closing(sqlite3.connect(old_path)) as plain:
        rows = plain.execute("SELECT pair_id FROM two_view_geometries").fetchall()
    copied = 0
    with (
        pycolmap.Database.open(old_path) as source,
        pycolmap.Database.open(new_path) as target,
        pycolmap.DatabaseTransaction(target),
    ):
        old, new = _Cameras(source), _Cameras(target)
        for was, name in names.items():
            i, j = old.ids[was], new.ids[name]
            if source.exists_keypoints(i):
                copied += 1
                target.write_descriptors(j, source.read_descriptors(i))
                target.write_keypoints(j, source.read_keypoints(i))
        for (pair_id,) in rows:
            i, j = pycolmap.pair_id_to_image_pair(pair_id)
            a, b = sorted((old.names[i], old.names[j]))
            if a not in names or b not in names or names[a] > names[b]:
                continue
            if old.verification(a, b) == new.verification(names[a], names[b]):
                to = new.pair(names[a], names[b])
                target.write_matches(*to, source.read_matches(i, j))
                geometry = source.read_two_view_geometry(i, j)
                for camera, image in zip((geometry.camera1, geometry.camera2), to, strict=True):
                    if camera is not None:  # with the focal length that the pair suggests
                        camera.camera_id = new.camera_ids[image]
                target.write_two_view_geometry(*to, geometry)
    return copied


def _unchanged(was: Record | None, now: Record) -> dict[str, str]:
    """New name of each photo of the same content, by old name; the same name where possible."""
    if was is None or was["settings"] != now["settings"]:
        return {}
    old = {digest: name for name, digest in was["photos"].items()}
    return {
        name if was["photos"].get(name) == digest else old[digest]: name
        for name, digest in now["photos"].items()
        if digest in old
    }


class _Cameras:
    """Ids and cameras of the images of a database."""

    def __init__(self, database: pycolmap.Database) -> None:
        self.cameras = {int(c.camera_id): c for c in database.read_all_cameras()}
        images = database.read_all_images()
        self.ids = {str(image.name): int(image.image_id) for image in images}
        self.names = {i: name for name, i in self.ids.items()}
        self.camera_ids = {int(image.image_id): int(image.camera_id) for image in images}

    def pair(self, first: str, second: str) -> tuple[int, int]:
        """Ids of two images in the order of COLMAP."""
        a, b = sorted((self.ids[first], self.ids[second]))
        return a, b

    def verification(self, first: str, second: str) -> tuple[Any, ...]:
        """Everything that the geometry of a pair depends on, apart from its features."""
        pair = self.ids[first], self.ids[second]
        cameras = [self.cameras[self.camera_ids[i]] for i in pair]
        settings = [
            (c.model, c.width, c.height, tuple(c.params), c.has_prior_focal_length) for c in cameras
        ]
        return pair[0] > pair[1], cameras[0].camera_id == cameras[1].camera_id, *settings
