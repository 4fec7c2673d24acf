"""Further attempts to map photos, and the choice among them. Worker process only.

Photos along a street have short tracks and small angles, of which the usual settings drop the most.
They are mapped with both, and by the global mapper. More images do not make a better model: where
structure repeats, a model with wrong poses has the most. The matches decide.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from chronoscene.arrays import Ints
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.database import copy_with_cameras, verified_matches
from chronoscene.registration.reconstruct.consistency import Matches, misplaced, pair_agreements

SHORT_ANGLE = 0.5  # Degrees between the rays of points of short tracks

CERTAIN_INLIERS = 30
"""Inliers of a pair of photos of two dates that count without confirmation: half of the pairs with
fewer are wrong where facades repeat."""

CONFIRMED = 5  # Matches of such a pair that a third photo must confirm


def allow_short_tracks(options: pycolmap.IncrementalPipelineOptions) -> None:
    """Let points of two images and of small angles count."""
    options.triangulation.ignore_two_view_tracks = False
    options.triangulation.min_angle = SHORT_ANGLE
    options.mapper.filter_min_tri_angle = SHORT_ANGLE
    options.mapper.init_min_tri_angle = SHORT_ANGLE
    options.mapper.ba_local_min_tri_angle = SHORT_ANGLE


def support(model: pycolmap.Reconstruction, matches: Matches) -> int:
    """Matches that agree with the poses, less those that contradict them or have a wrong image."""
    agreements = pair_agreements(model, matches)
    wrong = set(misplaced(agreements, model.reg_image_ids()))
    return sum(
        -total if a in wrong or b in wrong else 2 * good - total
        for (a, b), (good, total) in agreements.items()
    )


def without_weak_pairs(database: str, copy: Path, periods: Mapping[str, int]) -> int:
    """Copy a database without `weak_pairs`, and return their number."""
    copy_with_cameras(database, copy, {})
    names, matches = verified_matches(copy)
    weak = weak_pairs(matches, {i: periods[name] for i, name in names.items()})
    with pycolmap.Database.open(str(copy)) as opened:
        for a, b in weak:
            opened.delete_two_view_geometry(a, b)
    return len(weak)


def weak_pairs(matches: Matches, period: Mapping[int, int]) -> list[tuple[int, int]]:
    """Pairs of two dates with few inliers, which no third photo confirms.

    A third photo confirms a match if it is matched with both of its keypoints, at one of its own.
    """
    directed: dict[int, dict[int, dict[int, int]]] = {}
    for (a, b), pairs in matches.items():
        directed.setdefault(a, {})[b] = dict(pairs.tolist())
        directed.setdefault(b, {})[a] = dict(pairs[:, ::-1].tolist())

    def confirmed(a: int, b: int, pairs: Ints) -> int:
        thirds = directed[a].keys() & directed[b].keys()
        return sum(
            any(
                (k := directed[a][c].get(i)) is not None and k == directed[b][c].get(j)
                for c in thirds
            )
            for i, j in pairs.tolist()
        )

    return [
        (a, b)
        for (a, b), pairs in matches.items()
        if period[a] != period[b]
        and len(pairs) < CERTAIN_INLIERS
        and confirmed(a, b, pairs) < CONFIRMED
    ]
