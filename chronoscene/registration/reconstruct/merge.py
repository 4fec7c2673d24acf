"""From models that share no image to one that every image agrees with. Worker process only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.database import verified_matches
from chronoscene.registration.reconstruct.consistency import misplaced, pair_agreements
from chronoscene.registration.reconstruct.georegistration import finish
from chronoscene.registration.reconstruct.mapping import adjust, place_rest, triangulate
from chronoscene.registration.reconstruct.submodels import Combined, Priors, Unit, combine
from chronoscene.registration.worker import Report

Matches = Mapping[tuple[int, int], NDArray[np.int64]]
"""Verified matches of all pairs of images, by image ids. [M, 2] each"""

ROUNDS = 2
"""Of triangulation with all matches and adjustment, after merging."""

ATTEMPTS = 2
"""At placing an image: the second time, more of the others have poses."""


def join(
    units: Sequence[Unit], arguments: Mapping[str, Any], remarks: list[str], report: Report
) -> dict[str, Any]:
    """Lay units into one frame, merge, adjust and write them; the result of a route's step.

    Args:
        units: At least one.
        arguments: Of the step; see `joint.run`.
        remarks: Added to.
        report: Called with the progress.
    """
    _, matches = verified_matches(arguments["database"])
    if len(units) == 1:
        combined = Combined(units[0].model, (units[0].label,), (), (), ())
        model = combined.model
        adjust(model, threads=arguments["threads"])
    else:
        report("aligning", 0, 1)
        combined = combine(
            units,
            matches,
            Priors.of(arguments["priors"]),
            arguments["database"],
            keep_unplaced=arguments["keep_unplaced"],
        )
        remarks += combined.remarks
        model = _adjusted(combined.model, arguments, report)
    if not arguments["keep_unplaced"]:  # those that wait for tie points would contradict the rest
        model = _settled(model, matches, arguments, remarks, report)
    report("adjusting", 0, 1)
    left = [list(group) for group in combined.left]
    unplaced = list(combined.unplaced)
    return finish(model, arguments, remarks) | {"left": left, "unplaced": unplaced}


def _adjusted(
    model: pycolmap.Reconstruction, arguments: Mapping[str, Any], report: Report
) -> pycolmap.Reconstruction:
    """Points from the matches of all units, and poses adjusted to them."""
    scratch, threads = Path(arguments["scratch"]) / "points", arguments["threads"]
    for i in range(ROUNDS):
        report("adjusting", i, ROUNDS)
        model = triangulate(model, arguments["database"], arguments["photos"], scratch, threads)
        adjust(model, threads=threads)
    return model


def _settled(
    model: pycolmap.Reconstruction,
    matches: Matches,
    arguments: Mapping[str, Any],
    remarks: list[str],
    report: Report,
) -> pycolmap.Reconstruction:
    """Place what is missing, take out what the others contradict, and place that anew."""
    for _ in range(ATTEMPTS):
        model = _complete(model, arguments, remarks, report)
        if not take_out_misplaced(model, matches, remarks):
            break
        adjust(model, threads=arguments["threads"])
    return model


def take_out_misplaced(
    model: pycolmap.Reconstruction,
    matches: Matches,
    remarks: list[str],
    trusted: Sequence[int] = (),
) -> int:
    """Take the pose of images whose matches contradict it; how many there were.

    Args:
        model: Changed in place.
        matches: Of all images.
        remarks: Added to.
        trusted: Ids of images that are right by definition.
    """
    wrong = misplaced(pair_agreements(model, matches), model.reg_image_ids(), trusted)
    if wrong:
        names = ", ".join(sorted(str(model.images[i].name) for i in wrong))
        remarks.append(f"{names}: matches with the other photos contradict the pose: taken out")
    for image_id in wrong:
        model.deregister_frame(model.images[image_id].frame_id)
    return len(wrong)


def _complete(
    model: pycolmap.Reconstruction,
    arguments: Mapping[str, Any],
    remarks: list[str],
    report: Report,
) -> pycolmap.Reconstruction:
    """Place what its own period could not: the other periods may have the points for it."""
    total, before = len(arguments["periods"]), int(model.num_reg_images())
    if before == total or not model.num_points3D():
        return model
    scratch, threads = Path(arguments["scratch"]) / "rest", arguments["threads"]
    fuller = place_rest(
        model, arguments["database"], arguments["photos"], scratch, threads, total, report
    )
    placed = int(fuller.num_reg_images()) - before
    if placed <= 0:
        return model
    adjust(fuller, threads=threads)
    remarks.append(f"{placed} more images placed against the merged model")
    return fuller
