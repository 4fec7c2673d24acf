"""From submodels to one model with which the matches of every image agree. Worker process only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.database import verified_matches
from chronoscene.registration.reconstruct.consistency import misplaced, pair_agreements
from chronoscene.registration.reconstruct.gps_alignment import Priors, to_gps_frame
from chronoscene.registration.reconstruct.mapping import Job, adjust, register_rest, triangulate
from chronoscene.registration.reconstruct.models import summary
from chronoscene.registration.reconstruct.submodels import Combined, Submodel, combine

Matches = Mapping[tuple[int, int], NDArray[np.int64]]
"""Verified matches of all pairs of images, by image ids. [M, 2] each"""

ROUNDS = 2
"""Of triangulation with all matches and bundle adjustment, after merging."""

ATTEMPTS = 2
"""To register an image: at the second, more of the others have poses."""


def merge_and_finish(
    submodels: Sequence[Submodel], arguments: Mapping[str, Any], job: Job
) -> dict[str, Any]:
    """Align, merge, adjust and write submodels; the result of a route's step.

    Args:
        submodels: At least one.
        arguments: Of the step; see `routes.joint`.
        job: The step.
    """
    _, matches = verified_matches(job.database)
    priors, keep_unplaced = Priors.of(arguments["priors"]), arguments["keep_unplaced"]
    if len(submodels) == 1:
        combined = Combined(submodels[0].model, (), (), ())
        model = combined.model
        adjust(model, threads=job.threads)
    else:
        job.report("aligning", 0, 1)
        combined = combine(submodels, matches, priors, job.database, keep_unplaced=keep_unplaced)
        job.remarks.extend(combined.remarks)
        model = combined.model
        for i in range(ROUNDS):
            job.report("adjusting", i, ROUNDS)
            model = triangulate(model, job, "points")
            adjust(model, threads=job.threads)
    if not keep_unplaced:  # periods that wait for tie points would contradict the others
        model = _settled(model, matches, len(arguments["periods"]), job)
    job.report("adjusting", 0, 1)
    placed, used = to_gps_frame(model, priors, job.remarks)
    if placed:
        before = summary(model)["reprojection_error_px"]
        ended = adjust(model, priors=used, threads=job.threads)
        after = summary(model)["reprojection_error_px"]
        job.remarks.append(
            f"bundle adjustment with {len(used.enu)} position priors: {ended.lower()}, "
            f"reprojection error {before} -> {after} px"
        )
    return job.finish(
        model,
        is_georeferenced=placed,
        positions_used=sorted(used.enu),
        left=[list(group) for group in combined.left],
        unplaced=list(combined.unplaced),
    )


def _settled(
    model: pycolmap.Reconstruction, matches: Matches, total: int, job: Job
) -> pycolmap.Reconstruction:
    """Register missing images, deregister those that the others contradict, and try these again."""
    for _ in range(ATTEMPTS):
        model = _complete(model, total, job)
        if not deregister_misplaced(model, matches, job.remarks):
            break
        adjust(model, threads=job.threads)
    return model


def deregister_misplaced(
    model: pycolmap.Reconstruction,
    matches: Matches,
    remarks: list[str],
    trusted: Sequence[int] = (),
) -> int:
    """Deregister images whose matches contradict their poses; how many there were.

    Args:
        model: Changed in place.
        matches: Of all images.
        remarks: Added to.
        trusted: Ids of images that are right by definition.
    """
    wrong = misplaced(pair_agreements(model, matches), model.reg_image_ids(), trusted)
    if wrong:
        names = ", ".join(sorted(str(model.images[i].name) for i in wrong))
        remarks.append(f"{names}: deregistered: matches with the other photos contradict the pose")
    for image_id in wrong:
        model.deregister_frame(model.images[image_id].frame_id)
    return len(wrong)


def _complete(model: pycolmap.Reconstruction, total: int, job: Job) -> pycolmap.Reconstruction:
    """Register what its own period could not: other periods may have the points for it."""
    before = int(model.num_reg_images())
    if before == total or not model.num_points3D():
        return model
    fuller = register_rest(model, job, total, "rest")
    added = int(fuller.num_reg_images()) - before
    if added <= 0:
        return model
    adjust(fuller, threads=job.threads)
    job.remarks.append(f"{added} more images registered with the merged model")
    return fuller
