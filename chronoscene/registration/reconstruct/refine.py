"""Poses that tie points changed from outside, adjusted anew. Worker process only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.database import quiet
from chronoscene.registration.reconstruct.mapping import adjust, summary, triangulate, write_model
from chronoscene.registration.reconstruct.model_edits import known_images, set_pose
from chronoscene.registration.worker import Report

TIE_COLOR = np.array([255, 255, 255], np.uint8)


def run(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Triangulate from given poses, add tie points, adjust, and write the model.

    Arguments: ``database``, ``photos``, ``poses`` (3 x 4 by name), ``cameras`` (parameters by
    name), ``ties`` (each with ``xyz`` and ``clicks``: name, x, y), ``out``, ``scratch``,
    ``threads``.
    """
    quiet()
    database, photos, threads = (arguments[k] for k in ("database", "photos", "threads"))
    scratch = Path(arguments["scratch"])
    model = known_images(database)
    ids = {str(image.name): i for i, image in model.images.items()}
    for name, pose in arguments["poses"].items():
        set_pose(model, ids[name], pycolmap.Rigid3d(np.array(pose, np.float64)))
        camera = model.cameras[model.images[ids[name]].camera_id]
        camera.params = arguments["cameras"][name]
    for i in range(2):
        report("adjusting", i, 2)
        model = triangulate(model, database, photos, scratch, threads)
        add_ties(model, arguments["ties"], ids)
        adjust(model, threads=threads)
    write_model(model, Path(arguments["out"]), photos)
    remark = f"adjusted anew with {len(arguments['ties'])} tie points"
    return {
        "remarks": [remark],
        "is_georeferenced": False,
        "positions_used": [],
        "model": summary(model),
        "left": [],
        "unplaced": [],
    }


def add_ties(
    model: pycolmap.Reconstruction, ties: Sequence[Mapping[str, Any]], ids: Mapping[str, int]
) -> None:
    """Add clicked points with their clicks as observations."""
    for tie in ties:
        track = pycolmap.Track()
        for name, x, y in tie["clicks"]:
            points2D = model.images[ids[name]].points2D
            points2D.append(pycolmap.Point2D(np.array([x, y], np.float64)))
            track.add_element(ids[name], len(points2D) - 1)
        model.add_point3D(np.array(tie["xyz"], np.float64), track, TIE_COLOR)
