"""Features and matches of an earlier database that still hold when photos change. Worker only.

Features depend on the content of a photo and a few settings, matches on the features and cameras
of two photos. A record beside the database says from which contents and settings it was made. When
these change, the database is set aside, a new one is made in the order of the photos, and what
still holds is copied to it. The old database stays until all pairs are matched, so that each of
these functions can be killed and called again.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from chronoscene.images.masks import find_masks
from chronoscene.io.pycolmap import pycolmap
from chronoscene.io.staging import sha256_of, write_text_atomic
from chronoscene.registration.features import METHOD
from chronoscene.registration.work_folder import read_record

Record = dict[str, Any]
"""``settings`` that all features depend on, ``groups`` of photos with one camera, and ``photos``:
SHA-256 by name, and of the mask where there is one."""


def record_of(arguments: Mapping[str, Any]) -> Record:
    """What features are made from, by the arguments of `extraction.extract`."""
    import cv2  # the process that matches does not need it

    folder, groups = Path(arguments["photos"]), arguments["groups"]
    names = sorted(name for group in groups for name in group["names"])
    masks = find_masks(folder.parent, names)
    files = [[folder / name, *([masks[name]] if name in masks else [])] for name in names]
    with ThreadPoolExecutor(arguments["threads"]) as pool:
        digests = list(pool.map(lambda group: "".join(map(sha256_of, group)), files))
    settings = {key: arguments[key] for key in ("max_image_size", "max_features")}
    made_by = {"method": METHOD, "pycolmap": pycolmap.__version__, "opencv": cv2.__version__}
    return {
        "settings": settings | made_by,
        "groups": groups,
        "photos": dict(zip(names, digests, strict=True)),
    }


def renew(database: Path, wanted: Record) -> None:
    """Set the database aside unless it is one of these photos, complete or not.

    If one was set aside before, the one of which more can be reused is kept. Records are right at
    every moment: a database is removed before its record.
    """
    if _read_record(database) == wanted:
        return
    aside = set_aside(database)
    worth = {path: _worth(path, wanted) for path in (aside, database)}
    if worth[database] > worth[aside]:
        _remove(aside)
        write_text_atomic(_record_path(aside), json.dumps(_read_record(database)))
        database.replace(aside)
    elif worth[aside] == (0, 0):
        _remove(aside)
    _remove(database)
    write_text_atomic(_record_path(database), json.dumps(wanted))


def set_aside(database: Path) -> Path:
    """Where the database before this one is kept."""
    return database.with_name(f"{database.stem}-old{database.suffix}")


def forget(database: Path) -> None:
    """Remove what was set aside: all that still holds has been reused."""
    _remove(set_aside(database))
    _record_path(set_aside(database)).unlink(missing_ok=True)


def reuse_features(database: Path) -> int:
    """Copy features of photos whose content is in the old database; the number of these photos."""
    reused = 0
    with _both(database) as (old, new, sources):
        for name, source in sources.items():
            was, now = old.ids.get(source), new.ids[name]
            if was is None or not old.database.num_keypoints_for_image(was):
                continue
            reused += 1
            if not new.database.exists_descriptors(now):
                new.database.write_descriptors(now, old.database.read_descriptors(was))
            if not new.database.exists_keypoints(now):  # by which a photo counts as done
                new.database.write_keypoints(now, old.database.read_keypoints(was))
    return reused


def reuse_matches(database: Path, pairs: Sequence[tuple[str, str]]) -> int:
    """Copy matches and geometries of pairs whose photos and cameras are the same; their number.

    Matches are sorted and verified in the order of the ids, and verification is not symmetric to
    the last bit. Where an order is reversed, the pair is matched again, so that the database is the
    same as one from scratch.
    """
    reused = 0
    with _both(database) as (old, new, sources):
        known = {name: source for name, source in sources.items() if source in old.ids}
        for first, second in pairs:
            a, b = known.get(first), known.get(second)
            if a is None or b is None or a >= b:
                continue
            alike = old.verification(a, b) == new.verification(first, second)
            was = old.ordered(a, b)
            if alike and old.database.exists_two_view_geometry(*was):
                reused += 1
                _copy_pair(old, was, new, new.ordered(first, second))
    return reused


class _Opened:
    """A database with the ids and cameras of its images by name."""

    def __init__(self, database: Any) -> None:
        self.database = database
        self.cameras = {int(c.camera_id): c for c in database.read_all_cameras()}
        images = database.read_all_images()
        self.ids = {str(image.name): int(image.image_id) for image in images}
        self.camera_ids = {int(image.image_id): int(image.camera_id) for image in images}

    def ordered(self, first: str, second: str) -> tuple[int, int]:
        """Ids of two images in the order of COLMAP, so that no geometry is inverted and rounded."""
        a, b = sorted((self.ids[first], self.ids[second]))
        return a, b

    def verification(self, first: str, second: str) -> tuple[Any, ...]:
        """What the geometry of a pair depends on, apart from its features."""
        pair = self.ids[first], self.ids[second]
        a, b = (self.cameras[self.camera_ids[i]] for i in pair)
        turned, shared = pair[0] > pair[1], a.camera_id == b.camera_id
        return (
            turned,
            shared,
            *(
                (c.model, c.width, c.height, tuple(c.params), c.has_prior_focal_length)
                for c in (a, b)
            ),
        )


@contextmanager
def _both(database: Path) -> Iterator[tuple[_Opened, _Opened, dict[str, str]]]:
    """The old database, the new one, and the old name of each new one."""
    aside = set_aside(database)
    with pycolmap.Database.open(database) as new:
        if not aside.exists():
            yield _Opened(new), _Opened(new), {}
            return
        sources = _sources(_read_record(aside), _read_record(database))
        with pycolmap.Database.open(aside) as old:
            yield _Opened(old), _Opened(new), sources


def _sources(was: Record | None, now: Record | None) -> dict[str, str]:
    """Old name of the same content by new name; the same name where possible."""
    if was is None or now is None or was["settings"] != now["settings"]:
        return {}
    names = {digest: name for name, digest in was["photos"].items()}
    return {
        name: name if was["photos"].get(name) == digest else names[digest]
        for name, digest in now["photos"].items()
        if digest in names
    }


def _copy_pair(old: _Opened, was: tuple[int, int], new: _Opened, now: tuple[int, int]) -> None:
    """Copy one pair, unless it is there; the geometry last, by which a pair counts as done."""
    if new.database.exists_two_view_geometry(*now):
        return
    if new.database.exists_matches(*now):
        new.database.delete_matches(*now)
    new.database.write_matches(*now, old.database.read_matches(*was))
    geometry = old.database.read_two_view_geometry(*was)
    for camera, image in zip((geometry.camera1, geometry.camera2), now, strict=True):
        if camera is not None:  # with the focal length that the pair suggests
            camera.camera_id = new.camera_ids[image]
    new.database.write_two_view_geometry(*now, geometry)


def _worth(database: Path, wanted: Record) -> tuple[int, int]:
    """About how many verified pairs, and photos with features, could be reused."""
    sources = set(_sources(_read_record(database), wanted).values())
    if not sources or not database.exists():
        return 0, 0
    try:
        with pycolmap.Database.open(database) as opened:
            ids = {i for name, i in _Opened(opened).ids.items() if name in sources}
            pairs = map(
                pycolmap.pair_id_to_image_pair, opened.read_two_view_geometry_num_inliers()[0]
            )
            verified = sum(a in ids and b in ids for a, b in pairs)
            photos = sum(opened.num_keypoints_for_image(i) > 0 for i in ids)
    except RuntimeError:  # damaged
        return 0, 0
    # Closing the last connection merges the journal, so that it is one file again.
    return (0, 0) if _journals(database) else (verified, photos)


def _journals(database: Path) -> list[Path]:
    return [p for suffix in ("-wal", "-shm") if (p := Path(f"{database}{suffix}")).exists()]


def _remove(database: Path) -> None:
    """Remove a database, then its journals, which SQLite ignores without it."""
    database.unlink(missing_ok=True)
    for path in _journals(database):
        path.unlink()


def _record_path(database: Path) -> Path:
    return database.with_suffix(".json")


def _read_record(database: Path) -> Record | None:
    return read_record(_record_path(database))
