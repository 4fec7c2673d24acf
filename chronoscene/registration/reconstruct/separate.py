"""Route separate: a model for each period, then all of them in one frame. Worker process only."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from chronoscene.registration.features.database import quiet
from chronoscene.registration.reconstruct.mapping import adjust, map_images, nothing_mapped
from chronoscene.registration.reconstruct.merge import join
from chronoscene.registration.reconstruct.submodels import Unit
from chronoscene.registration.worker import Report


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
        raise nothing_mapped(len(periods), tied=arguments["keep_unplaced"])
    return join(units, arguments, remarks, report)
