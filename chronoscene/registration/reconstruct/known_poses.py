"""The task ``triangulate``: points of a scene whose poses are known. Worker process only.

Pairs are chosen by the poses, and matches are verified by them: a match stays if it lies near its
epipolar lines. No random samples are drawn, so pairs with few right matches are of use, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from chronoscene.io.processes import Report
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.matching import BATCH, store_matches
from chronoscene.registration.features.nearest import mutual_matches
from chronoscene.registration.features.pairs import posed_pairs
from chronoscene.registration.reconstruct.consistency import agreeing_matches
from chronoscene.registration.reconstruct.mapping import Task, triangulate
from chronoscene.registration.reconstruct.models import image_pose, known_images, set_poses


def triangulate_scene(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Match the images of a scene and triangulate points; poses and cameras do not change.

    Arguments: ``database`` (with features), ``photos``, ``poses`` (``cam_from_world``, 3 x 4, by
    name), ``periods`` (by name), ``exhaustive_limit``, ``out``, ``scratch``, ``threads``. Matches
    that are in the database already are not computed again.

    Returns:
        That of `Task.finish`, and the numbers of ``pairs``, ``matches`` and ``agreeing`` matches.
    """
    task = Task.start(arguments, report)
    model = known_images(task.database)
    set_poses(model, arguments["poses"])
    pairs = _choose_pairs(model, arguments["periods"], arguments["exhaustive_limit"])
    for first in range(0, len(pairs), BATCH):
        report("pairs", first, len(pairs))
        store_matches(task.database, pairs[first : first + BATCH], mutual_matches, task.threads)
    report("pairs", len(pairs), len(pairs))
    matches, agreeing = _verify(model, task.database)
    report("triangulate", 0, 1)
    # Known again, with the verified matches.
    model = known_images(task.database)
    set_poses(model, arguments["poses"])
    model = triangulate(model, task, "points")
    return task.finish(model, pairs=len(pairs), matches=matches, agreeing=agreeing)


def _choose_pairs(
    model: pycolmap.Reconstruction, periods: Mapping[str, int], limit: int
) -> list[tuple[str, str]]:
    """Choose all pairs of images, or neighbours where there are more than ``limit`` images."""
    images = sorted(model.images.values(), key=lambda image: str(image.name))
    names = [str(image.name) for image in images]
    chosen = {(i, j) for i in range(len(names)) for j in range(i)}
    if len(names) > limit:
        poses = np.stack([image_pose(image) for image in images])
        chosen = posed_pairs(poses, np.array([periods[name] for name in names]))
    return [(names[i], names[j]) for i, j in sorted(chosen)]


def _verify(model: pycolmap.Reconstruction, database: str) -> tuple[int, int]:
    """Store the matches that agree with the poses as verified; count all, and those."""
    with pycolmap.Database.open(database) as opened:
        pair_ids, found = opened.read_all_matches()
        pairs = [pycolmap.pair_id_to_image_pair(i) for i in pair_ids]
        matches = {
            (int(a), int(b)): np.asarray(rows, np.int64).reshape(-1, 2)
            for (a, b), rows in zip(pairs, found, strict=True)
        }
        good = agreeing_matches(model, matches)
        opened.clear_two_view_geometries()
        with pycolmap.DatabaseTransaction(opened):
            for (a, b), agreeing in good.items():
                _store_verified(opened, a, b, matches[a, b][agreeing])
    return sum(map(len, matches.values())), sum(int(mask.sum()) for mask in good.values())


def _store_verified(database: pycolmap.Database, first: int, second: int, rows: np.ndarray) -> None:
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    geometry.inlier_matches = rows.astype(np.uint32)
    database.write_two_view_geometry(first, second, geometry)
