"""Route joint: one reconstruction of the photos of all periods. Worker process only."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from chronoscene.registration.features.database import quiet
from chronoscene.registration.reconstruct.mapping import map_images, nothing_mapped
from chronoscene.registration.reconstruct.merge import join
from chronoscene.registration.reconstruct.submodels import Unit
from chronoscene.registration.worker import Report


def run(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Map all images together; parts that did not hold together are joined afterwards.

    Arguments: ``database``, ``photos``, ``periods`` (by name), ``priors`` (``enu`` and ``sigma`` by
    name, or null), ``keep_unplaced`` (see `combine`), ``out`` (model folder), ``scratch``,
    ``threads``.
    """
    quiet()
    database, photos = arguments["database"], arguments["photos"]
    scratch, threads = Path(arguments["scratch"]), arguments["threads"]
    names = sorted(arguments["periods"])
    models, remarks = map_images(database, photos, names, scratch, threads, report)
    if not models:
        raise nothing_mapped(len(names), tied=arguments["keep_unplaced"])
    units = [Unit(f"part {i}", model) for i, model in enumerate(models)]
    return join(units, arguments, remarks, report)
