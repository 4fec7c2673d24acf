"""Route frozen: a new period joins a scene whose poses and cameras stay. Worker process only.

The photos of the scene get new features, and points are triangulated from them with the poses as
they are. New photos are then placed against these points one after the other, and a last adjustment
moves only what is new.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.errors import RegistrationError
from chronoscene.registration.features.database import quiet, verified_matches
from chronoscene.registration.reconstruct.consistency import agreement, pair_agreements
from chronoscene.registration.reconstruct.mapping import (
    adjust,
    place_rest,
    summary,
    triangulate,
    write_model,
)
from chronoscene.registration.reconstruct.merge import take_out_misplaced
from chronoscene.registration.reconstruct.model_edits import known_images, set_pose
from chronoscene.registration.worker import Report

LEAST_POINTS = 50
"""Fewer points from the photos of the scene do not carry new photos."""

LEAST_AGREEING = 0.5
"""Share of the matches among the photos of the scene that must agree with its poses."""


def run(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Place new photos in the frame of a scene.

    Arguments: ``database``, ``photos``, ``poses`` (``cam_from_world``, 3 x 4, by name, of the
    scene's images), ``periods`` (by name, of all), ``out``, ``scratch``, ``threads``.
    """
    quiet()
    photos, threads = arguments["photos"], arguments["threads"]
    scratch = Path(arguments["scratch"])
    base, old = _posed(arguments)
    _, matches = verified_matches(arguments["database"])
    agreeing = agreement(pair_agreements(base, matches), old)
    if agreeing < LEAST_AGREEING:
        raise RegistrationError(
            "the scene",
            expected=f"poses with which {LEAST_AGREEING:.0%} of the matches of its images agree",
            found=f"{agreeing:.0%}",
            todo="check that its poses belong to its images: chronoscene validate",
        )
    report("triangulating", 0, 1)
    base = triangulate(base, arguments["database"], photos, scratch / "base", threads)
    found = int(base.num_points3D())
    remarks = [
        f"{agreeing:.0%} of the matches within the scene agree with its poses",
        f"{len(old)} images of the scene give {found} points with their poses unchanged",
    ]
    if found < LEAST_POINTS:
        raise RegistrationError(
            "the scene",
            expected=f"at least {LEAST_POINTS} points from matches of its images at their poses",
            found=f"{found}",
            todo="check that its poses fit its images: chronoscene validate",
        )
    total = len(arguments["periods"])
    database = arguments["database"]
    model = place_rest(base, database, photos, scratch / "continued", threads, total, report)
    take_out_misplaced(model, matches, remarks, sorted(old))
    new = [i for i in model.reg_image_ids() if i not in old]
    if not new:
        raise RegistrationError(
            "the new period",
            expected="photos that match those of the scene",
            found="none that could be placed",
            todo="add photos with views like those of the scene, or register all periods anew; "
            "features and matches are kept",
        )
    remarks.append(f"{len(new)} new images placed")
    report("adjusting", 0, 1)
    ended = adjust(model, constant=old, threads=threads)
    moved = _largest_move(model, arguments["poses"])
    remarks.append(f"adjustment of what is new: {ended.lower()}; old poses moved by {moved:.1e}")
    write_model(model, Path(arguments["out"]), photos)
    return {
        "remarks": remarks,
        "is_georeferenced": False,
        "positions_used": [],
        "model": summary(model),
        "left": [],
        "unplaced": [],
    }


def _posed(arguments: Mapping[str, Any]) -> tuple[pycolmap.Reconstruction, set[int]]:
    """All images of the database, those of the scene with their poses; ids of the latter."""
    model = known_images(arguments["database"])
    old = set()
    for image_id, image in list(model.images.items()):
        pose = arguments["poses"].get(str(image.name))
        if pose is not None:
            set_pose(model, image_id, pycolmap.Rigid3d(np.array(pose, np.float64)))
            old.add(int(image_id))
    return model, old


def _largest_move(model: pycolmap.Reconstruction, poses: Mapping[str, Any]) -> float:
    """Largest change of any number in the poses of the scene's images: a check on the solver."""
    moves = [
        np.abs(image.cam_from_world().matrix() - np.array(poses[str(image.name)])).max()
        for i in model.reg_image_ids()
        if str((image := model.images[i]).name) in poses
    ]
    return float(max(moves, default=0.0))
