"""Pictures of the test views for the site, from the runs that entries were made of."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from PIL import Image

from chronoscene.formats.shared.grouping import natural_key
from chronoscene.harness.files.ground_truth import ground_truth_folder
from chronoscene.harness.files.predictions import ImageEntry, load_image, read_manifest
from chronoscene.harness.files.records import PREDICTIONS, read_run, run_folders
from leaderboard.board import Standing

VIEWS = 3
"""Views of each period, spread over its test views."""
WIDTH = 640
"""In pixels, at most."""
QUALITY = 82


def find_runs(folders: Iterable[Path], standings: Iterable[Standing]) -> dict[Path, Standing]:
    """Find the folders of runs with the predictions of the first seed of an entry."""
    wanted = {frozenset(s.entry.runs[0].images.items()): s for s in standings}
    found = {}
    for run in (run for folder in folders for run in run_folders(folder)):
        own = read_manifest(run / PREDICTIONS).own_images
        hashes = frozenset((image.view, image.sha256) for image in own)
        if (known := wanted.get(hashes)) is not None:
            record, entered = read_run(run), known.records[0]
            if (entered.scene_hash, entered.config_hash) == (record.scene_hash, record.config_hash):
                found[run] = known
    return found


def gallery(runs: Mapping[Path, str], folder: Path, place: str) -> dict[str, Any]:
    """Copy pictures of a scene, and describe them.

    Args:
        runs: Folder of each run, and the label of its method.
        folder: Where the pictures go; made.
        place: That folder as the page names it.

    Returns:
        ``labels`` of the methods; ``views``: for each place on the list of views, one mapping per
        period with ``view``, ``truth`` and ``predictions``, which are names of files.

    Raises:
        CheckpointError: If an image is not the one that its manifest lists.
    """
    first = next(iter(runs))
    record = read_run(first)
    truth = ground_truth_folder(first.parents[2], record.scene)
    photos = {image.view: image for image in read_manifest(truth).images}
    images = {run: {i.view: i for i in read_manifest(run / PREDICTIONS).own_images} for run in runs}
    periods = sorted(map(int, record.periods))
    folder.mkdir(parents=True)

    def picture(source: Path, image: ImageEntry, name: str) -> str:
        shown = Image.fromarray(load_image(source, image))
        shown.thumbnail((WIDTH, WIDTH))
        shown.save(folder / f"{name}.webp", "WEBP", quality=QUALITY)
        return f"{place}/{name}.webp"

    views = []
    for k in range(VIEWS):
        of_periods = []
        for period in periods:
            names = [i.view for i in images[first].values() if i.camera_period == period]
            names = sorted(names, key=natural_key)
            view = names[k * len(names) // VIEWS]
            of_periods.append(
                {
                    "view": view,
                    "truth": picture(truth, photos[view], f"{k}-{period}"),
                    "predictions": [
                        picture(run / PREDICTIONS, images[run][view], f"{k}-{period}-{j}")
                        for j, run in enumerate(runs)
                    ],
                }
            )
        views.append(of_periods)
    return {
        "labels": [*runs.values()],
        "periods": [record.period_labels[str(period)] for period in periods],
        "views": views,
    }
