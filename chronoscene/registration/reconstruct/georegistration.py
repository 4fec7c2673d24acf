"""The last steps of every route: into metres, adjustment with position priors. Worker only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.reconstruct.mapping import adjust, summary, write_model
from chronoscene.registration.reconstruct.model_edits import as_pycolmap, sorted_ids
from chronoscene.registration.reconstruct.submodels import Priors, gps_alignment


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """What became of the positions."""

    is_georeferenced: bool
    used: tuple[str, ...]
    """Images whose positions took part."""
    remarks: tuple[str, ...]


def place(model: pycolmap.Reconstruction, priors: Priors) -> tuple[Placed, Priors]:
    """Move a model into the frame of its GPS positions, if they are good for it.

    Returns:
        What was done, and the priors that agree with the model.
    """
    nothing = Priors({}, {})
    if not priors.enu:
        return Placed(False, (), ("no GPS: the scale and the frame are arbitrary",)), nothing
    found = gps_alignment(model, priors)
    if found is None:
        return Placed(False, (), ("fewer than 3 placed photos have GPS: no frame",)), nothing
    names = [str(model.images[i].name) for i in sorted_ids(model)]
    told = f"GPS against poses: rms {found.rms:.2f} m, scale known to {found.scale_error:.1%}"
    if not found.is_useful:
        remark = f"{told}: too rough to say anything about this model, which keeps its own scale"
        return Placed(False, (), (remark,)), nothing
    model.transform(as_pycolmap(found.enu_from_model))
    agreeing = {name for name, good in zip(names, found.inliers, strict=True) if good}
    remarks = [told]
    if found.on_a_line:
        remarks.append("cameras lie on a line: the rotation around it is from the horizon")
    for name, residual, good in zip(names, found.residuals, found.inliers, strict=True):
        if np.isfinite(residual) and not good:
            remarks.append(f"{name}: GPS is {residual:.1f} m from its pose: not used")
    sigma = max(found.rms / np.sqrt(3.0), 1e-3)
    kept = Priors(
        {name: priors.enu[name] for name in agreeing},
        # What cameras state is optimistic: the residuals of this very model have the last word.
        {name: np.maximum(priors.sigma[name], sigma).tolist() for name in agreeing},
    )
    return Placed(True, tuple(sorted(agreeing)), tuple(remarks)), kept


def finish(
    model: pycolmap.Reconstruction, arguments: Mapping[str, Any], remarks: list[str]
) -> dict[str, Any]:
    """Place, adjust and write a model; the result of a route's step."""
    placed, kept = place(model, Priors.of(arguments["priors"]))
    remarks += placed.remarks
    threads = arguments["threads"]
    if placed.is_georeferenced:
        before = summary(model)["reprojection_error_px"]
        ended = adjust(model, priors=kept, threads=threads)
        after = summary(model)["reprojection_error_px"]
        remarks.append(
            f"adjustment with {len(kept.enu)} position priors: {ended.lower()}, reprojection error "
            f"{before} -> {after} px"
        )
    write_model(model, Path(arguments["out"]), arguments["photos"])
    return {
        "remarks": remarks,
        "is_georeferenced": placed.is_georeferenced,
        "positions_used": list(placed.used),
        "model": summary(model),
    }
