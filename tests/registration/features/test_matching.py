"""Pairs that are matched and verified."""

from __future__ import annotations

from itertools import combinations, pairwise
from pathlib import Path

import chronoscene.colmap.model  # noqa: F401  # loads pycolmap safely
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.matching import INLIER_SHARES, _unmatched


def test_matches_that_a_killed_run_left_are_dropped(tmp_path: Path) -> None:
    """COLMAP aborts when it stores the matches of a pair a second time."""
    path = str(tmp_path / "features.db")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 3
    with pycolmap.Database.open(path) as database:
        pycolmap.synthesize_dataset(options, database)
        ids = {str(image.name): image.image_id for image in database.read_all_images()}
        pairs = list(combinations(sorted(ids), 2))
        assert all(database.exists_matches(ids[a], ids[b]) for a, b in pairs)
        broken = pairs[1]
        database.delete_two_view_geometry(*(ids[name] for name in broken))
    assert _unmatched(path, pairs) == [broken]
    with pycolmap.Database.open(path) as database:
        left = [pair for pair in pairs if database.exists_matches(*(ids[n] for n in pair))]
    assert left == [pair for pair in pairs if pair != broken]


def test_no_pair_that_could_be_verified_gets_too_few_samples() -> None:
    """COLMAP draws samples for a share of inliers, and accepts pairs with 15 of them."""
    needed = pycolmap.TwoViewGeometryOptions()
    bounds = [least for least, _ in INLIER_SHARES]
    assert bounds == sorted(bounds, reverse=True)
    assert bounds[-1] == 0
    assert INLIER_SHARES[0][1] == needed.ransac.min_inlier_ratio
    for (above, _), (_, share) in pairwise(INLIER_SHARES):
        assert share <= needed.min_num_inliers / (above - 1)
