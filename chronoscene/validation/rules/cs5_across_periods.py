"""CS506 to CS508, CS520: how the periods relate to each other, and the scene to metres."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from chronoscene.arrays import Ints, Mask
from chronoscene.errors import ChronoSceneError
from chronoscene.formats.chronoscene import WORLD, read_world
from chronoscene.validation import rule
from chronoscene.validation.checks.photo_metadata import fit_gps
from chronoscene.validation.folder.scene_folder import RawScene
from chronoscene.validation.rule import NOTHING, Hit

MIN_SHARED = 10  # Shared points from which a similarity between two periods can be more than chance
MAX_BLOCK = 10_000_000  # Points times periods that are counted at a time

UNIT_TOLERANCE = 0.1
"""Relative difference between the unit and the metre by GPS that its noise can explain."""


@rule.warning(
    "CS506",
    bad="points of period 0 only; the images of period 1 were added later",
    remedy=f"triangulate points with the images of this period ({rule.TRIANGULATE})",
)
def period_without_points(scene: RawScene, point_periods: Mask) -> Iterator[Hit]:
    """No point is seen in any image of a period."""
    if not point_periods.any():
        return  # no tracks at all, or no points: CS501, CS514
    for column, period in enumerate(scene.period_ids):
        if not point_periods[:, column].any():
            found = f"0 of {len(point_periods)}"
            yield Hit(f"period {period}", "points that its images see", found)


@rule.info("CS507", bad="(for information only)", remedy=NOTHING)
def points_of_one_period(scene: RawScene, point_periods: Mask) -> Iterator[Hit]:
    """Number of points seen in a single period, and in several."""
    total = len(point_periods)
    if not total or point_periods.shape[1] < 2:
        return
    alone = point_periods[point_periods.sum(axis=1) == 1].sum(axis=0).tolist()
    each = ", ".join(f"period {p} {n}" for p, n in zip(scene.period_ids, alone, strict=True))
    found = f"{sum(alone)} of {total} in one only ({100 * sum(alone) / total:.1f} %): {each}"
    yield Hit(scene.model_file("points3D"), "points of several periods", found)


@rule.warning(
    "CS508",
    what=f"A period, or a group of periods, shares fewer than {MIN_SHARED} points with the other "
    "periods, so nothing shows that they are in one frame.",
    bad="two models merged by hand; periods 0 and 1 share points, 2 and 3 do, 1 and 2 do not",
    remedy="match images across the periods; if they were aligned by other means, ignore this rule",
)
def period_unconnected(scene: RawScene, point_periods: Mask) -> Iterator[Hit]:
    points = point_periods.sum(axis=0)
    groups = connected(common_points(point_periods), MIN_SHARED)
    groups = [group for group in groups if points[group].any()]  # others have their own rule
    groups.sort(key=lambda group: -int(points[group].sum()))
    for group in groups[1:]:
        own = point_periods[:, group].any(axis=1)
        shared = np.count_nonzero(own & np.delete(point_periods, group, axis=1).any(axis=1))
        ids = [str(scene.period_ids[i]) for i in group]
        place = f"period {ids[0]}" if len(ids) == 1 else f"periods {', '.join(ids)}"
        expected = f"at least {MIN_SHARED} points shared with the other periods"
        yield Hit(place, expected, f"{shared} of {np.count_nonzero(own)}")


def common_points(seen: Mask) -> Ints:
    """Number of points seen in both of two periods; zero on the diagonal. [P, T] -> [T, T]"""
    seen = seen[seen.sum(axis=1) > 1]
    rows = max(1, MAX_BLOCK // max(1, seen.shape[1]))
    common = np.zeros((seen.shape[1],) * 2, np.int64)
    for first in range(0, len(seen), rows):
        block = seen[first : first + rows].astype(np.float32)
        common += (block.T @ block).astype(np.int64)
    np.fill_diagonal(common, 0)
    return common


def connected(common: Ints, minimum: int) -> list[Ints]:
    """Groups of periods linked by chains of at least ``minimum`` common points, as indices."""
    from scipy.sparse.csgraph import connected_components  # takes 0.2 s, which --help need not

    count, group = connected_components(common >= minimum, directed=False)
    return [np.flatnonzero(group == i) for i in range(count)]


@rule.warning(
    "CS520",
    bad='`{"unit": "metre"}` with a model straight from COLMAP\'s mapper',
    remedy="scale the model, or correct the unit in sparse/world.json",
    needs=("cameras", "images"),
)
def frame_scale(scene: RawScene) -> Iterator[Hit]:
    """`sparse/world.json` says metres, but the GPS positions of the photos give another unit."""
    try:
        if read_world(scene.root).unit != "metre":
            return
    except ChronoSceneError:
        return  # has its own rule
    fit = fit_gps(scene)
    if fit is None:
        return
    scale = fit.metres_from_world.scale
    tolerance = max(UNIT_TOLERANCE, 3 * fit.sigma / (fit.spread * len(fit.images) ** 0.5))
    if abs(np.log(scale)) > np.log1p(tolerance):
        found = f"{scale:.4g} m per unit, by the GPS positions of {len(fit.images)} photos"
        yield Hit(WORLD, "a world in metres", found)
