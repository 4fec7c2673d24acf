"""Route joint: one reconstruction of the photos of all periods. Worker process only."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from chronoscene.registration.georeferencing import finish
from chronoscene.registration.mapping import adjust, map_images, nothing_mapped, triangulate
from chronoscene.registration.separate import complete
from chronoscene.registration.sfm import quiet, verified_matches
from chronoscene.registration.units import Priors, Unit, combine
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
        raise nothing_mapped(len(names))
    left: list[list[str]] = []
    if len(models) == 1:
        model = models[0]
        adjust(model, threads=threads)
    else:
        units = [Unit(f"part {i}", m) for i, m in enumerate(models)]
        _, matches = verified_matches(database)
        combined = combine(
            units,
            matches,
            Priors.of(arguments["priors"]),
            database,
            keep_unplaced=arguments["keep_unplaced"],
        )
        remarks += combined.remarks
        left = [list(group) for group in combined.left]
        model = combined.model
        for _ in range(2):
            model = triangulate(model, database, photos, scratch / "points", threads)
            adjust(model, threads=threads)
        model = complete(model, arguments, remarks, report)
    report("adjusting", 0, 1)
    return finish(model, arguments, remarks) | {"left": left, "unplaced": []}
