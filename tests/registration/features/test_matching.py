"""Pairs that are matched and verified."""

from __future__ import annotations

from itertools import combinations, pairwise
from pathlib import Path

import numpy as np

import chronoscene.colmap.model  # noqa: F401  # loads pycolmap safely
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.database import write_pairs
from chronoscene.registration.features.matching import INLIER_SHARES, match


def test_matches_that_are_stored_are_verified_and_not_computed_again(tmp_path: Path) -> None:
    """A killed run may have left them, or another program may have written them."""
    path = str(tmp_path / "features.db")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 3
    with pycolmap.Database.open(path) as database:
        pycolmap.synthesize_dataset(options, database)
        ids = {str(image.name): image.image_id for image in database.read_all_images()}
        pairs = list(combinations(sorted(ids), 2))
        assert all(database.exists_matches(ids[a], ids[b]) for a, b in pairs)
        broken = tuple(ids[name] for name in pairs[1])
        before = database.read_two_view_geometry(*broken).inlier_matches
        stored = database.read_matches(*broken)
        database.delete_two_view_geometry(*broken)
    write_pairs(tmp_path / "pairs.txt", pairs)
    arguments = {"database": path, "pairs": str(tmp_path / "pairs.txt"), "threads": 1}
    done: list[int] = []
    found = match(arguments, lambda what, number, total: done.append(number))
    assert (found["pairs"], found["verified"], done[0]) == (3, 3, 2)
    with pycolmap.Database.open(path) as database:
        np.testing.assert_array_equal(database.read_matches(*broken), stored)
        after = database.read_two_view_geometry(*broken).inlier_matches
    assert len(after) > 0.9 * len(before) > 0


def test_no_pair_that_could_be_verified_gets_too_few_samples() -> None:
    """COLMAP draws samples for a share of inliers, and accepts pairs with 15 of them."""
    needed = pycolmap.TwoViewGeometryOptions()
    bounds = [least for least, _ in INLIER_SHARES]
    assert bounds == sorted(bounds, reverse=True)
    assert bounds[-1] == 0
    assert INLIER_SHARES[0][1] == needed.ransac.min_inlier_ratio
    for (above, _), (_, share) in pairwise(INLIER_SHARES):
        assert share <= needed.min_num_inliers / (above - 1)
