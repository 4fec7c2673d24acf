"""The route ``resection``: photos with known cameras placed by surveyed points."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from chronoscene.arrays import Array
from chronoscene.errors import ConfigError
from chronoscene.geodesy import Georeference, ReferenceSystem
from chronoscene.registration.context import Context, Options
from chronoscene.registration.features.correspondences import Matched
from chronoscene.registration.photos.inputs import PhotoInputs
from chronoscene.registration.reconstruct.estimation import resected
from chronoscene.registration.result import Registered, Resection
from chronoscene.registration.ties.control import LEAST_SIGMA
from chronoscene.registration.ties.tie_alignment import (
    TieAlignment,
    align_with_tie_points,
    control_frame,
)
from chronoscene.registration.ties.tie_points import TiePoint, TiePoints


def check_options(options: Options) -> None:
    """Raise an error if what the route needs is missing."""
    for option, value in (("--tie-points", options.tie_points), ("--cameras", options.cameras)):
        if options.route == "resection" and value is None:
            raise ConfigError(
                "--route resection", expected=f"{option}: surveyed points and known cameras",
                found="none", todo=f"give {option}",
            )  # fmt: skip


def resect_photos(
    inputs: PhotoInputs,
    matched: Matched,
    points: TiePoints,
    output: ReferenceSystem | None,
    context: Context,
) -> tuple[Registered, TieAlignment]:
    """Place the photos by the control, and compare it with the result."""
    frame = control_frame(points)
    known = points.located(frame)

    def argument(point: TiePoint, xyz: Array | None) -> dict[str, Any]:
        sigma = None
        if xyz is not None:
            sigma = list(point.sigma or (LEAST_SIGMA,) * 3)
        clicks = [[c.image, c.x, c.y] for c in point.clicks if c.image in inputs.periods]
        place = None if xyz is None else xyz.tolist()
        return {"name": point.name, "xyz": place, "sigma": sigma, "clicks": clicks}

    control = [argument(p, known[p.name]) for p in points.points if p.role == "control"]
    ties = [argument(p, None) for p in points.points if p.role == "tie"]
    model, result = resected({"control": control, "ties": ties}, inputs, matched, context)
    model = replace(model, georeference=frame, gps_enu=_positions_in(frame, model, inputs))
    used = {c["name"] for c in control if c["clicks"]}
    left_out = {
        name: None if at is None else (np.subtract(at[0], known[name]).tolist(), at[1])
        for name, at in result["left_out"].items()
    }
    model = replace(model, resection=Resection(result["deviations"], left_out))
    found = align_with_tie_points(model, points, mode="check", output=output, adjusted=used)
    return found.model, found


def _positions_in(frame: Georeference | None, model: Registered, inputs: PhotoInputs) -> Array:
    """GPS positions of the images of a model in another frame than that of all GPS. [N, 3]"""
    found = np.full_like(model.gps_enu, np.nan)
    if frame is not None and inputs.georeference is not None:
        known = np.isfinite(model.gps_enu).all(axis=1)
        places = inputs.georeference.to_geodetic(model.gps_enu[known])
        found[known] = frame.to_enu(*places.T)
    return found
