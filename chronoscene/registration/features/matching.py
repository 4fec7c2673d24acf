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
from chronoscene.registration.features.database import SEED, quiet, read_pairs, write_pairs
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
    ``scratch`` (folder), ``given`` (see `given.source.find_sources`; may be missing).

    Returns:
        Number of ``pairs``, of those ``verified``, of their ``inliers``, and of the pairs
        ``carried`` over from an earlier run.
    """
    quiet()
    database = arguments["database"]
    pairs = read_pairs(Path(arguments["pairs"]))
    _drop_others(database, pairs)
    left = _unverified(database, pairs)
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    options.num_threads = threads = arguments["threads"]
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    listed = Path(arguments["scratch"]) / "batch.txt"
    given = arguments.get("given")
    pairwise, load = (matcher(given), load_features) if given else (plausible_matches, load_placed)
    for first in range(0, len(left), BATCH):
        report("pairs", len(pairs) - len(left) + first, len(pairs))
        found = store_matches(database, left[first : first + BATCH], pairwise, threads, load)
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
    return {
        "pairs": len(pairs),
        "verified": sum(n > 0 for n in counts),
        "inliers": sum(counts),
        "carried": len(pairs) - len(left),
    }


def load_sift(opened: pycolmap.Database, image_id: int) -> Descriptors:
    """Read SIFT descriptors."""
    return Descriptors.of(opened.read_descriptors(image_id).data)


def load_placed(opened: pycolmap.Database, image_id: int) -> Placed:
    """Read SIFT descriptors and the pixels of their keypoints."""
    keypoints = np.asarray(opened.read_keypoints(image_id), np.float64)[:, :2]
    return load_sift(opened, image_id), np.ascontiguousarray(keypoints)


def store_matches(
    database: str,
    pairs: Sequence[tuple[str, str]],
    matcher: Matcher,
    threads: int,
    load: Loader = load_sift,
) -> dict[tuple[str, str], int]:
    """Store matches of pairs of images, in the order of their ids, unless they are stored.

    Returns:
        Number of matches of each pair.
    """
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
        return {pair: len(opened.read_matches(*ordered[pair])) for pair in pairs}


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
