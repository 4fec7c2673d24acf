"""All runs of a folder on one HTML page: tables, quality against time, photos and predictions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from chronoscene import __version__
from chronoscene.arrays import Pixels
from chronoscene.harness.files.ground_truth import truth_of
from chronoscene.harness.files.predictions import ImageEntry, load_image, read_manifest
from chronoscene.harness.files.records import Failure, RunRecord
from chronoscene.harness.report.figures.comparison import (
    ShownRun,
    by_scene,
    chosen_views,
    psnr_text,
    shown_run,
)
from chronoscene.harness.report.quality_curves import draw_curves
from chronoscene.harness.report.summary import name_of, summarise
from chronoscene.harness.report.tables import footnotes, period_name, readable_tables
from chronoscene.harness.score.regions import scored_mask
from chronoscene.io.pages import data_uri, render_page
from chronoscene.io.tables import Table

MAX_BYTES = 16_000_000
"""Size of the pictures in a page, so that a phone opens it and a mail carries it."""
MAX_WIDTH = 960
"""Pixels of a picture in a page."""
QUALITY = 85


@dataclass(frozen=True, slots=True)
class ShownView:
    """A photo and its predictions by all methods."""

    name: str
    period: str
    photo: str
    """Data URI, like the pictures of the methods."""
    predictions: tuple[tuple[str, str, str], ...]
    """Method, PSNR and picture."""

    @property
    def size(self) -> int:
        """Bytes of the pictures."""
        return len(self.photo) + sum(len(picture) for _, _, picture in self.predictions)


def comparison_page(
    runs: Path,
    records: Sequence[RunRecord],
    failures: Sequence[Failure],
    worst: Sequence[Table],
    *,
    max_bytes: int = MAX_BYTES,
) -> str:
    """Make the page.

    Args:
        runs: The folder, with predictions and ground truth.
        records: Its finished runs with their rows, as `report.summary.read_runs` returns them.
        failures: Its failed runs.
        worst: Tables of single views.
        max_bytes: Limit of the pictures. If the test views do not all fit, those in the page are
            spread over the periods, and it says how many are left out.
    """
    entries = summarise(records)
    found = by_scene(records)
    views = _shown_views(found, max_bytes)
    scenes = [
        {
            "name": scene,
            "curves": draw_curves(of_scene),
            "views": views[scene],
            "total": len(read_manifest(truth_of(of_scene[0].folder)).images),
        }
        for scene, of_scene in found.items()
    ]
    return render_page(
        "comparison/page",
        title=runs.resolve().name,
        tables=readable_tables(entries, records),
        notes=footnotes(entries, records, failures),
        worst=worst,
        scenes=scenes,
        megabytes=max_bytes / 1e6,
        version=__version__,
    )


def _shown_views(found: dict[str, list[RunRecord]], max_bytes: int) -> dict[str, list[ShownView]]:
    """Return views of each scene, as many of each period as fit."""
    methods = {s: [(name_of(run), shown_run(run)) for run in runs] for s, runs in found.items()}

    def draw(scene: str, per_period: int) -> Iterator[ShownView]:
        first = found[scene][0]
        truth, labels = truth_of(first.folder), first.period_labels
        for entry in chosen_views(truth, per_period):
            yield _shown_view(truth, entry, methods[scene], labels)

    # The first view of each period shows how many fit.
    size = sum(view.size for scene in found for view in draw(scene, 1))
    left = max_bytes
    shown: dict[str, list[ShownView]] = {scene: [] for scene in found}
    for scene in found:
        for view in draw(scene, max(1, max_bytes // max(1, size))):
            if view.size <= left:
                shown[scene].append(view)
                left -= view.size
    return shown


def _shown_view(
    truth: Path, entry: ImageEntry, methods: Sequence[tuple[str, ShownRun]], labels: dict[str, str]
) -> ShownView:
    photo, mask = load_image(truth, entry), scored_mask(truth, entry, methods[0][1].fitted)
    predictions = []
    for name, run in methods:
        image = load_image(run.folder, run.entries[entry.view])
        predictions.append((name, psnr_text(image, photo, mask), _picture(image)))
    period = period_name(entry.camera_period, labels)
    return ShownView(entry.view, period, _picture(photo), tuple(predictions))


def _picture(pixels: Pixels) -> str:
    from PIL import Image

    picture = Image.fromarray(pixels)
    picture.thumbnail((MAX_WIDTH, picture.height))
    return data_uri(picture, form="webp", quality=QUALITY)
