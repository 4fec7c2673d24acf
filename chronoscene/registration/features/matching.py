"""The task ``matches``: pairs of photos, verified matches, held-out tracks. Worker process only.

A `Matcher` gives the matches (`epipolar.plausible_matches`), and COLMAP verifies them by geometry.
Matches that are in the database already are verified as they are, those of a given file among them
(`given.tasks.import_matches`); verified pairs are kept.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.io.processes import Report
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.database import SEED, quiet, read_pairs
from chronoscene.registration.features.epipolar import Placed, plausible_matches
from chronoscene.registration.features.given.tasks import (
    import_matches,
    load_features,
    matcher,
    matches_of,
)
from chronoscene.registration.features.holdout import hold_out
from chronoscene.registration.features.nearest import Descriptors
from chronoscene.registration.features.pairs import choose_pairs

BATCH = 64  # Pairs

Matcher = Callable[[Any, Any], NDArray[np.uint32]]
"""Match two images as its loader gives them; indices [M, 2], sorted. Called by several threads."""

Loader = Callable[[pycolmap.Database, int], Any]
"""Read what a `Matcher` needs of an image."""

INLIER_SHARES = ((45, 1 / 4), (30, 1 / 3), (20, 1 / 2), (0, 3 / 4))
"""From so many matches on, the share that must be inliers for COLMAP to draw enough samples. A pair
needs 15 inliers, which of fewer matches are a larger share: most pairs of photos without overlap
are done ten times as soon."""


def match_photos(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Choose pairs, match them, and hold out tracks, in one process: starting three takes longer.

    Arguments and results: those of `choose_pairs`, `match` and `hold_out`.
    """
    imported = matches_of(arguments.get("given")) is not None
    chosen = (import_matches if imported else choose_pairs)(arguments, report)
    return chosen | match(arguments, report) | hold_out(arguments, report)


def match(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Match and verify pairs of images, except those that are verified already.

    Arguments: ``database``, ``pairs`` (text file with two names a line), ``threads``,
    ``given`` (see `given.source.find_sources`; may be missing).

    Returns:
        Number of ``pairs``, of those ``verified``, and of their ``inliers``.
    """
    quiet()
    database = arguments["database"]
    pairs = read_pairs(Path(arguments["pairs"]))
    _drop_others(database, pairs)
    left = _unverified(database, pairs)
    threads, given = arguments["threads"], arguments.get("given")
    pairwise, load = (matcher(given), load_features) if given else (plausible_matches, load_placed)
    for first in range(0, len(left), BATCH):
        report("pairs", len(pairs) - len(left) + first, len(pairs))
        batch = left[first : first + BATCH]
        store_matches(database, batch, pairwise, threads, load)
        _verify(database, batch, threads)
    report("pairs", len(pairs), len(pairs))
    with pycolmap.Database.open(database) as opened:
        counts = [int(n) for n in opened.read_two_view_geometry_num_inliers()[1]]
    return {"pairs": len(pairs), "verified": sum(n > 0 for n in counts), "inliers": sum(counts)}


def load_sift(opened: pycolmap.Database, image_id: int) -> Descriptors:
    """Read SIFT descriptors."""
    return Descriptors.of(opened.read_descriptors(image_id).data)


def load_placed(opened: pycolmap.Database, image_id: int) -> Placed:
    """Read SIFT descriptors and the pixels of their keypoints."""
    return load_sift(opened, image_id), _pixels(opened, image_id)


def _pixels(opened: pycolmap.Database, image_id: int) -> NDArray[np.float64]:
    """Read the pixels of keypoints. [N, 2]"""
    return np.ascontiguousarray(opened.read_keypoints(image_id)[:, :2], np.float64)


def store_matches(
    database: str,
    pairs: Sequence[tuple[str, str]],
    matcher: Matcher,
    threads: int,
    load: Loader = load_sift,
) -> None:
    """Store matches of pairs of images, in the order of their ids, unless they are stored."""
    with pycolmap.Database.open(database) as opened:
        ids = {str(image.name): int(image.image_id) for image in opened.read_all_images()}
        ordered = {(a, b): (min(ids[a], ids[b]), max(ids[a], ids[b])) for a, b in pairs}
        new = [pair for pair in pairs if not opened.exists_matches(*ordered[pair])]
        used = sorted({i for pair in new for i in ordered[pair]})
        descriptors = {i: load(opened, i) for i in used}
        first, second = ([descriptors[ordered[pair][k]] for pair in new] for k in (0, 1))
        with ThreadPoolExecutor(threads) as pool:
            for pair, matches in zip(new, pool.map(matcher, first, second), strict=True):
                opened.write_matches(*ordered[pair], matches)


def _verify(database: str, pairs: Sequence[tuple[str, str]], threads: int) -> None:
    """Store the geometry of pairs of images by their matches, degenerate ones too."""
    with pycolmap.Database.open(database) as opened:
        images = {str(image.name): image for image in opened.read_all_images()}
        cameras = {int(c.camera_id): c for c in opened.read_all_cameras()}
        ordered = [
            sorted((images[a], images[b]), key=lambda image: int(image.image_id)) for a, b in pairs
        ]
        ids = [(int(first.image_id), int(second.image_id)) for first, second in ordered]
        used = sorted({i for pair in ids for i in pair})
        points = {i: _pixels(opened, i) for i in used}
        sides = [
            [(cameras[image.camera_id], points[int(image.image_id)]) for image in pair]
            for pair in ordered
        ]
        matches = [opened.read_matches(*pair) for pair in ids]
        with ThreadPoolExecutor(threads) as pool:
            found = list(pool.map(_geometry, sides, matches))
        with pycolmap.DatabaseTransaction(opened):
            for pair, geometry in zip(ids, found, strict=True):
                opened.write_two_view_geometry(*pair, geometry)


def _geometry(
    sides: Sequence[tuple[pycolmap.Camera, NDArray[np.float64]]], matches: NDArray[np.uint32]
) -> pycolmap.TwoViewGeometry:
    """Verify the matches of two images by the camera and the keypoints of each."""
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = SEED
    options.ransac.min_inlier_ratio = next(s for least, s in INLIER_SHARES if len(matches) >= least)
    (camera_a, a), (camera_b, b) = sides
    return pycolmap.estimate_two_view_geometry(camera_a, a, camera_b, b, matches, options)


def _drop_others(database: str, pairs: Sequence[tuple[str, str]]) -> None:
    """Drop pairs of an earlier list that are not in this one."""
    with pycolmap.Database.open(database) as opened:
        ids = {str(image.name): image.image_id for image in opened.read_all_images()}
        listed = {pycolmap.image_pair_to_pair_id(ids[a], ids[b]) for a, b in pairs}
        for pair_id in set(opened.read_num_matches()[0]) - listed:
            a, b = pycolmap.pair_id_to_image_pair(pair_id)
            opened.delete_matches(a, b)
            opened.delete_two_view_geometry(a, b)


def _unverified(database: str, pairs: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Pairs without a geometry; COLMAP stores one for each pair that it has verified."""
    with pycolmap.Database.open(database) as opened:
        ids = {str(image.name): image.image_id for image in opened.read_all_images()}
        return [(a, b) for a, b in pairs if not opened.exists_two_view_geometry(ids[a], ids[b])]
