"""Given features and matches in COLMAP's database. Worker process only."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.images.decoding import image_size
from chronoscene.io.processes import Report
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.database import Features, read_features, write_pairs
from chronoscene.registration.features.given.image_features import (
    ImageFeatures,
    checked,
    checked_matches,
    nearest,
    wrong,
)
from chronoscene.registration.features.given.source import (
    Source,
    load_plugin,
    match_names,
    open_file,
)

Given = Mapping[str, Any]
"""Result of `source.find_sources`."""

NONE = (np.zeros((0, 6), np.float32), np.zeros((0, 128), np.uint8))


def extractor(
    given: Given, photos: Path, names: Sequence[str]
) -> tuple[Callable[[Path, Path | None], Features], list[str], list[str]]:
    """Function that gives the features of a photo, names that a file lacks, and remarks.

    A photo that a file lacks has no features; none are extracted for it.
    """
    source = Source(**given["features"])
    if source.kind == "plug-in":
        extract = load_plugin("--features", source)

        def compute(path: Path, mask: Path | None) -> Features:
            keypoints, descriptors = extract(path, mask)
            values = None if descriptors is None else np.asarray(descriptors)
            found = ImageFeatures(np.asarray(keypoints, np.float32), values, None)
            place = f"{source.place}: {path.name}"
            return _stored(checked(place, found, image_size(path)))

        return compute, [], []
    file = open_file(source)
    known = match_names(source.place, names, file.names)

    def read(path: Path, _: Path | None) -> Features:
        name = known.get(path.relative_to(photos).as_posix())
        if name is None:
            return NONE
        place = f"{source.place}: {name}"
        return _stored(checked(place, file.features(name), image_size(path)))

    remarks = []
    if file.is_coarse:
        remarks.append(
            f"{Path(source.place).name}: keypoints have 16 bits, and so steps of a pixel from "
            "1,024 pixels on; as_half=False in hloc keeps them exact"
        )
    return read, sorted(set(names) - known.keys()), remarks


def _stored(found: ImageFeatures) -> Features:
    empty = np.zeros((len(found.keypoints), 0), np.uint8)
    return found.keypoints, empty if found.descriptors is None else found.descriptors


def import_matches(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Store the matches of a file, and list their pairs.

    Arguments: those of `pairs.choose_pairs`, and ``given``.

    Returns:
        As `pairs.choose_pairs`.
    """
    source = Source(**(matches_of(arguments["given"]) or {}))
    periods = {image["name"]: image["period"] for image in arguments["images"]}
    pairs = []
    with pycolmap.Database.open(arguments["database"]) as opened:
        ids = {str(i.name): int(i.image_id) for i in opened.read_all_images()}
        counts = {n: int(opened.num_keypoints_for_image(i)) for n, i in ids.items()}
        first_source = Source(**arguments["given"]["features"])
        photo = {name: name for name in ids}
        if first_source.kind != "plug-in":
            stored_names = open_file(first_source).names
            photo = {v: k for k, v in match_names(source.place, sorted(ids), stored_names).items()}
        stored = open_file(source)
        with pycolmap.DatabaseTransaction(opened):
            for first, second, rows in stored.matches(photo):
                a, b = photo[first], photo[second]
                place = f"{source.place}: {first} and {second}"
                rows = checked_matches(place, rows, (counts[a], counts[b]))
                if ids[a] > ids[b]:
                    a, b, rows = b, a, np.ascontiguousarray(rows[:, ::-1])
                if len(rows) and not opened.exists_matches(ids[a], ids[b]):
                    opened.write_matches(ids[a], ids[b], rows)
                if len(rows):
                    pairs.append((a, b))
        if not pairs:
            raise wrong(source.place, "matches between the photos", "none",
                        "give the matches of these features")  # fmt: skip
    pairs = sorted(set(pairs))
    write_pairs(Path(arguments["pairs"]), pairs)
    across = sum(periods[a] != periods[b] for a, b in pairs)
    kind = f"of {Path(source.place).name}"
    return {"pairs": len(pairs), "across_periods": across, "kinds": {kind: len(pairs)}}


def matches_of(given: Given | None) -> dict[str, Any] | None:
    """Source of matches in a file: the one given, or the database of the features; else None."""
    if given is None:
        return None
    source = given["matches"] or given["features"]
    if source["kind"] == "plug-in":
        return None
    if given["matches"] is None:
        file = open_file(Source(**source))
        if next(iter(file.matches(file.names)), None) is None:
            return None
    return dict(source)


def matcher(given: Given) -> Callable[[ImageFeatures, ImageFeatures], np.ndarray]:
    """Matcher for descriptors that are not SIFT."""
    source = given["matches"]
    if source is None or source["kind"] != "plug-in":
        return nearest
    match = load_plugin("--matches", Source(**source))

    def run(first: ImageFeatures, second: ImageFeatures) -> np.ndarray:
        counts = len(first.keypoints), len(second.keypoints)
        return checked_matches(source["place"], np.asarray(match(first, second)), counts)

    return run


def load_features(opened: pycolmap.Database, image_id: int) -> ImageFeatures:
    """Features of an image, for a matcher."""
    keypoints, descriptors = read_features(opened, image_id)
    camera = opened.read_camera(opened.read_image(image_id).camera_id)
    if not descriptors.shape[1] and len(keypoints):
        raise wrong("--features", "descriptors, to match the photos by", "none in the file",
                    "give the matches, too: --matches")  # fmt: skip
    return ImageFeatures(keypoints, descriptors, (int(camera.width), int(camera.height)))
