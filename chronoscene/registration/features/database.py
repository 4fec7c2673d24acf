"""Features and matches in a COLMAP database. Worker process only.

Images enter the database in the order of the photos, so ids are the same in every run. What is
stored is not done again: features of each photo, matches of a batch of pairs. Features and matches
of the same photos in an earlier database are copied; see `feature_reuse`. Features and matches are
ours (`sift`, `nearest`); COLMAP verifies the matches by geometry.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from chronoscene.io.processes import Report
from chronoscene.io.pycolmap import pycolmap
from chronoscene.io.staging import write_text_atomic
from chronoscene.registration.features import feature_reuse
from chronoscene.registration.features.nearest import Descriptors, mutual_matches
from chronoscene.registration.features.sift import Features, photos_at_once, sift_features

Item = TypeVar("Item")
Result = TypeVar("Result")

BATCH = 64  # Photos or pairs

SEED = 0

INLIER_SHARES = ((45, 1 / 4), (30, 1 / 3), (20, 1 / 2), (0, 3 / 4))
"""From so many matches on, the share that must be inliers for COLMAP to draw enough samples. A pair
needs 15 inliers, which of fewer matches are a larger share: most pairs of photos without overlap
are done ten times as soon."""


def quiet() -> None:
    """Keep COLMAP's progress out of the log, and make its random numbers the same every time."""
    pycolmap.logging.minloglevel = 2
    pycolmap.set_random_seed(SEED)


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
    size, most, threads = (arguments[k] for k in ("max_image_size", "max_features", "threads"))

    def features_of(name: str) -> Features:
        return sift_features(Path(photos, name), size, most)

    cv2.setNumThreads(1)  # each photo is the work of one thread
    found = _in_order(features_of, left, photos_at_once(size, threads))
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


def _in_order(
    function: Callable[[Item], Result], items: Sequence[Item], workers: int
) -> Iterator[Result]:
    """Results in the order of the items, from threads that are never far ahead of the caller."""
    with ThreadPoolExecutor(workers) as pool:
        for first in range(0, len(items), BATCH):
            yield from pool.map(function, items[first : first + BATCH])


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


def match(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Match and verify pairs of images that are not in the database yet.

    Arguments: ``database``, ``pairs`` (text file with two names a line), ``threads``,
    ``scratch`` (folder).

    Returns:
        Number of ``pairs``, of those ``verified``, of their ``inliers``, and of the pairs
        ``carried`` over from an earlier database.
    """
    quiet()
    database = arguments["database"]
    pairs = read_pairs(Path(arguments["pairs"]))
    _drop_others(database, pairs)
    reused = feature_reuse.reuse_matches(Path(database), pairs)
    left = _unmatched(database, pairs)
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    options.num_threads = threads = arguments["threads"]
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    listed = Path(arguments["scratch"]) / "batch.txt"
    for first in range(0, len(left), BATCH):
        report("pairs", len(pairs) - len(left) + first, len(pairs))
        found = _match_descriptors(database, left[first : first + BATCH], threads)
        for least, share in INLIER_SHARES:
            write_pairs(listed, [pair for pair, count in found.items() if count >= least])
            found = {pair: count for pair, count in found.items() if count < least}
            verification.ransac.min_inlier_ratio = share
            pairing = pycolmap.ImportedPairingOptions(match_list_path=str(listed))
            # COLMAP takes the matches that are in the database, and verifies them.
            pycolmap.match_image_pairs(database, options, pairing, verification)
    listed.unlink(missing_ok=True)
    report("pairs", len(pairs), len(pairs))
    with pycolmap.Database.open(database) as opened:
        counts = [int(n) for n in opened.read_two_view_geometry_num_inliers()[1]]
    feature_reuse.forget(Path(database))
    return {
        "pairs": len(pairs),
        "verified": sum(n > 0 for n in counts),
        "inliers": sum(counts),
        "carried": reused,
    }


def _match_descriptors(
    database: str, pairs: Sequence[tuple[str, str]], threads: int
) -> dict[tuple[str, str], int]:
    """Store matches of pairs of images, in the order of their ids; the number of each pair."""
    with pycolmap.Database.open(database) as opened:
        ids = {str(image.name): int(image.image_id) for image in opened.read_all_images()}
        wanted = [(min(ids[a], ids[b]), max(ids[a], ids[b])) for a, b in pairs]
        used = sorted({i for pair in wanted for i in pair})
        descriptors = {i: Descriptors.of(opened.read_descriptors(i).data) for i in used}

        def matches_of(pair: tuple[int, int]) -> NDArray[np.uint32]:
            return mutual_matches(descriptors[pair[0]], descriptors[pair[1]])

        counts = []
        for pair, found in zip(wanted, _in_order(matches_of, wanted, threads), strict=True):
            opened.write_matches(*pair, found)
            counts.append(len(found))
    return dict(zip(pairs, counts, strict=True))


def _drop_others(database: str, pairs: Sequence[tuple[str, str]]) -> None:
    """Drop pairs that are not listed: an earlier list may have had others."""
    with pycolmap.Database.open(database) as opened:
        ids = {str(image.name): image.image_id for image in opened.read_all_images()}
        listed = {pycolmap.image_pair_to_pair_id(ids[a], ids[b]) for a, b in pairs}
        for pair_id in set(opened.read_num_matches()[0]) - listed:
            a, b = pycolmap.pair_id_to_image_pair(pair_id)
            opened.delete_matches(a, b)
            opened.delete_two_view_geometry(a, b)


def _unmatched(database: str, pairs: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Pairs without a geometry. If such a pair has matches, a killed run left them: COLMAP would
    verify them and then fail to store them a second time, so they are dropped."""
    left = []
    with pycolmap.Database.open(database) as opened:
        ids = {str(image.name): image.image_id for image in opened.read_all_images()}
        for a, b in pairs:
            if not opened.exists_two_view_geometry(ids[a], ids[b]):
                if opened.exists_matches(ids[a], ids[b]):
                    opened.delete_matches(ids[a], ids[b])
                left.append((a, b))
    return left


def read_pairs(path: Path) -> list[tuple[str, str]]:
    """Pairs of names from a file that `write_pairs` wrote."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return [(a, b) for a, b in (line.split(" ") for line in lines)]


def write_pairs(path: Path, pairs: Sequence[tuple[str, str]]) -> None:
    """Write pairs of names, one a line; COLMAP cuts at blanks, so names must have none."""
    write_text_atomic(path, "".join(f"{a} {b}\n" for a, b in pairs))


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
