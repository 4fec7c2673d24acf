"""Which periods disagree with the others, and what explains it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chronoscene.validation.checks.period_frames import explain
from chronoscene.validation.scene_folder import RawScene

WORSE = 3.0
"""Ratio of median reprojection errors, of a period to the best one or of an image to its period."""

LEAST_ERROR = 1.0
"""Pixels; below, everything is well whatever its ratio to the rest."""

MOST_WRONG = 0.5
"""Share of the images of a period with a pose that does not fit: beyond, the period is at fault."""


def period_limit(scene: RawScene) -> float:
    """Median reprojection error in pixels beyond which a period stands out among the others."""
    return max(LEAST_ERROR, WORSE * min(scene.period_errors.values(), default=0.0))


def explain_periods(scene: RawScene) -> dict[int, str]:
    """Periods in a frame of their own by index, with what brings them into that of the others."""
    if scene.point_periods is None:
        return {}
    judged = ~np.isnan(scene.image_errors) | _behind(scene)
    limits = {
        i: _limit_of_wrong(scene, np.flatnonzero(judged & (scene.image_periods == i)))
        for i in range(len(scene.period_ids))
    }
    if all(limit is not None for limit in limits.values()):
        return {}  # there is no frame to be in
    found = {i: explain(scene, i, limit) for i, limit in limits.items() if limit is not None}
    return {i: words for i, words in found.items() if words is not None}


def _limit_of_wrong(scene: RawScene, mine: NDArray[np.int64]) -> float | None:
    """Error in pixels that most images of a period exceed, if they do.

    Args:
        scene: The scene.
        mine: Indices of those images of the period that can be judged.
    """
    if not len(mine):
        return None
    usual = period_limit(scene) if len(scene.period_errors) > 1 else np.inf
    limit = min(usual, float(np.median([scene.pose_limit(i) for i in mine.tolist()])))
    wrong = np.count_nonzero(~(scene.image_errors[mine] <= limit))
    return limit if wrong > MOST_WRONG * len(mine) else None


def _behind(scene: RawScene) -> NDArray[np.bool_]:
    """Which images have most of their points behind them. [I]"""
    behind = np.zeros(len(scene.images or ()), bool)
    for seen in scene.reprojections or ():
        wrong = np.count_nonzero(~(seen.depth > 0))
        behind[seen.image] = wrong > MOST_WRONG * len(seen.depth)
    return behind
