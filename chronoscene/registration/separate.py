"""Route separate: a model for each period, then all of them in one frame. Worker process only."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from chronoscene._pycolmap import pycolmap
from chronoscene.registration.georeferencing import finish
from chronoscene.registration.mapping import (
    adjust,
    map_images,
    nothing_mapped,
    place_rest,
    triangulate,
)
from chronoscene.registration.sfm import quiet, verified_matches
from chronoscene.registration.units import Priors, Unit, combine
from chronoscene.registration.worker import Report

ROUNDS = 2
"""Of triangulation with all matches and adjustment, after merging."""


def run(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Map each period alone, align the models, merge and adjust. Arguments as in `joint.run`."""
    quiet()
    database, photos = arguments["database"], arguments["photos"]
    scratch, threads = Path(arguments["scratch"]), arguments["threads"]
    periods: Mapping[str, int] = arguments["periods"]
    units, remarks = [], []
    for period in sorted(set(periods.values())):
        names = sorted(n for n, p in periods.items() if p == period)
        folder = scratch / f"period-{period}"
        models, told = map_images(database, photos, names, folder, threads, report)
        remarks += [f"period {period}: {remark}" for remark in told]
        for i, model in enumerate(models):
            adjust(model, threads=threads)
            label = f"period {period}" + (f" part {i}" if len(models) > 1 else "")
            units.append(Unit(label, model, period, is_largest=i == 0))
    if not units:
        raise nothing_mapped(len(periods))
    report("aligning", 0, 1)
    _, matches = verified_matches(database)
    combined = combine(
        units,
        matches,
        Priors.of(arguments["priors"]),
        database,
        keep_unplaced=arguments["keep_unplaced"],
    )
    remarks += combined.remarks
    model = combined.model
    for i in range(ROUNDS):
        report("adjusting", i, ROUNDS)
        model = triangulate(model, database, photos, scratch / "points", threads)
        adjust(model, threads=threads)
    model = complete(model, arguments, remarks, report)
    left = [list(group) for group in combined.left]
    unplaced = list(combined.unplaced)
    return finish(model, arguments, remarks) | {"left": left, "unplaced": unplaced}


def complete(
    model: pycolmap.Reconstruction,
    arguments: Mapping[str, Any],
    remarks: list[str],
    report: Report,
) -> pycolmap.Reconstruction:
    """Place what its own period could not: the other periods may have the points for it."""
    database, photos = arguments["database"], arguments["photos"]
    scratch, threads = Path(arguments["scratch"]) / "rest", arguments["threads"]
    total, before = len(arguments["periods"]), int(model.num_reg_images())
    if before == total or not model.num_points3D() or arguments["keep_unplaced"]:
        return model
    fuller = place_rest(model, database, photos, scratch, threads, total, report)
    placed = int(fuller.num_reg_images()) - before
    if placed <= 0:
        return model
    adjust(fuller, threads=threads)
    remarks.append(f"{placed} more images placed against the merged model")
    return fuller
