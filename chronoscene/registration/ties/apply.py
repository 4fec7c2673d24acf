"""Tie points in the pipeline: from a file to an aligned, adjusted registration."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from chronoscene.geodesy import Georeference
from chronoscene.registration.result import Registered
from chronoscene.registration.ties.tie_alignment import (
    TieAlignment,
    align_with_tie_points,
    with_tie_tracks,
)
from chronoscene.registration.ties.tie_points import TiePoints

Refine = Callable[[Mapping[str, Any]], Registered]
"""Called with poses, cameras and tie points; gives the adjusted registration."""


def tie(model: Registered, points: TiePoints, refine: Refine) -> TieAlignment:
    """Check a registration by tie points; align and adjust it by them where they do not fit.

    Ground control in a reference system gives a model without a place one.
    """
    framed = model
    if model.georeference is None and (frame := control_frame(points)) is not None:
        framed = replace(model, georeference=frame, gps_enu=np.full_like(model.gps_enu, np.nan))
    first = align_with_tie_points(framed, points, mode="replace" if model.unplaced else "auto")
    if not first.replaced:
        return _unless_placed(first, model)
    adjusted = refine(refine_arguments(first.model, points))
    adjusted = replace(adjusted, georeference=framed.georeference, gps_enu=framed.gps_enu)
    last = align_with_tie_points(adjusted, points, mode="check")
    told = replace(last, replaced=True, remarks=(*first.remarks, *last.remarks))
    return _unless_placed(told, model)


def _unless_placed(result: TieAlignment, before: Registered) -> TieAlignment:
    """Take the frame away again if there was no control to move the model into it."""
    if result.controlled or before.georeference is not None:
        return result
    return replace(result, model=replace(result.model, georeference=None))


def control_frame(points: TiePoints) -> Georeference | None:
    """A frame around the ground control; None without control in a reference system."""
    if points.crs is None or not any(p.world is not None for p in points.points):
        return None
    anywhere = Georeference(0.0, 0.0, 0.0, "as stated")
    places = anywhere.to_geodetic(np.stack(list(points.located(anywhere).values())))
    latitude, longitude, height = np.median(places, axis=0).tolist()
    return Georeference(round(latitude, 7), round(longitude, 7), round(height, 2), "as stated")


def refine_arguments(model: Registered, points: TiePoints) -> dict[str, Any]:
    """What `chronoscene.registration.reconstruct.refine.run` needs to know of an aligned model."""
    tied = with_tie_tracks(model, points)
    starts = tied.track_start[len(model.points) :].tolist()
    ties = []
    for xyz, first, last in zip(
        tied.points[len(model.points) :].tolist(), starts[:-1], starts[1:], strict=True
    ):
        rows = range(first, last)
        clicks = [[tied.names[tied.track_image[i]], *tied.track_xy[i].tolist()] for i in rows]
        ties.append({"xyz": xyz, "clicks": clicks})
    named = list(zip(model.names, model.cam_from_world, model.cameras, strict=True))
    return {
        "poses": {name: pose[:3].tolist() for name, pose, _ in named},
        "cameras": {name: list(camera.params) for name, _, camera in named},
        "ties": ties,
    }
