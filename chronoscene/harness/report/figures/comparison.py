"""Figures of runs: predictions side by side with the photos, and enlarged where methods differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten
from typing import Any

import numpy as np

from chronoscene.arrays import Array, Mask, Pixels
from chronoscene.figures import canvas
from chronoscene.harness.files.ground_truth import truth_of
from chronoscene.harness.files.predictions import ImageEntry, load_image, read_manifest, safe_part
from chronoscene.harness.files.records import FIGURES, PREDICTIONS, RunRecord
from chronoscene.harness.report.summary import kind_of
from chronoscene.harness.report.tables import period_name
from chronoscene.harness.score.regions import scored_mask
from chronoscene.metrics.psnr_ssim import psnr

CELL_WIDTH = 2.6  # Inches per image
ERROR_RANGE = 0.25
"""Mean absolute error over channels that saturates the error map, as a share of full scale."""
WINDOW = 0.25
"""Sides of what is enlarged, as a share of those of the image."""
FRAME = "#00c8ff"  # Colour around what is enlarged


@dataclass(frozen=True, slots=True)
class ShownRun:
    """One method in a figure."""

    title: str
    folder: Path
    """Its predictions."""
    entries: dict[str, ImageEntry]
    fitted: str = ""
    """Part of the photos, as `RunRecord.fitted`; the same for all methods in a figure."""


def draw_figures(
    runs: Path, records: Sequence[RunRecord], *, views_per_period: int = 1
) -> list[Path]:
    """Draw the comparison and the error maps of every scene with runs; returns the files."""
    written = []
    for scene, found in by_scene(records).items():
        methods = [shown_run(record) for record in found]
        truth = truth_of(found[0].folder)
        labels = found[0].period_labels
        rows = chosen_views(truth, views_per_period)
        if not rows:  # trained on all photos
            continue
        for errors, name in ((False, "comparison"), (True, "errors")):
            path = runs / FIGURES / f"{safe_part(scene)}_{name}.png"
            _draw(path, scene, truth, rows, methods, labels, errors=errors)
            written.append(path)
    return written


def by_scene(records: Sequence[RunRecord]) -> dict[str, list[RunRecord]]:
    """Choose the runs that are shown in pictures: `first_seeds` of each scene.

    A test that is not that of the frozen photos has none.
    """
    scenes: dict[str, list[RunRecord]] = {}
    for run in records:
        truth = read_manifest(truth_of(run.folder))
        width = truth.details.get("max_width", run.max_width)
        if (truth.scene_hash, width) == (run.scene_hash, run.max_width):
            scenes.setdefault(run.scene, []).append(run)
    return {scene: first_seeds(found) for scene, found in scenes.items()}


def first_seeds(records: Sequence[RunRecord]) -> list[RunRecord]:
    """Choose the lowest seed of each method, strategy, preset and variant."""
    chosen: dict[tuple[str, str], RunRecord] = {}
    for record in sorted(records, key=lambda record: record.seed):
        chosen.setdefault((record.method, kind_of(record)), record)
    return sorted(chosen.values(), key=lambda record: str(record.folder))


def chosen_views(truth: Path, per_period: int) -> list[ImageEntry]:
    """Choose views evenly spread over the test views of each period, in name order."""
    images = read_manifest(truth).images
    chosen = []
    for period in sorted({image.camera_period for image in images}):
        entries = [image for image in images if image.camera_period == period]
        count = min(per_period, len(entries))
        chosen += [entries[(2 * i + 1) * len(entries) // (2 * count)] for i in range(count)]
    return chosen


def shown_run(record: RunRecord) -> ShownRun:
    """Read the list of predictions of a run."""
    predictions = record.folder / PREDICTIONS
    entries = {e.view: e for e in read_manifest(predictions).images}
    return ShownRun(f"{record.title}\n{kind_of(record)}", predictions, entries, record.fitted)


def _draw(
    path: Path,
    scene: str,
    truth: Path,
    rows: Sequence[ImageEntry],
    methods: Sequence[ShownRun],
    labels: dict[str, str],
    *,
    errors: bool,
) -> None:
    aspect = float(np.mean([entry.height / entry.width for entry in rows]))
    # Space for a caption under each image, the titles above and the colour bar below; the rest is
    # cut off when the figure is saved.
    lines = len(rows) if errors else 2 * len(rows)
    size = (CELL_WIDTH * (1 + len(methods)), (CELL_WIDTH * aspect + 0.3) * lines + 1.2)
    figure = canvas.new_figure(*size, layout="compressed", dpi=150)
    axes: Any = figure.subplots(lines, 1 + len(methods), squeeze=False)
    image = None
    for row, entry in zip(np.split(axes, len(rows)), rows, strict=True):
        image = _draw_row(row, truth, entry, methods, labels, errors=errors)
    for axis, title in zip(axes[0], ["ground truth", *(c.title for c in methods)], strict=True):
        axis.set_title(canvas.plain_lines(title), fontsize=10)
    if errors and image is not None:
        bar = figure.colorbar(
            image, ax=axes, location="bottom", shrink=0.4, aspect=40, pad=0.01, extend="max"
        )
        bar.set_label("mean absolute error, share of full scale", fontsize=9)
    what = "error of the test views" if errors else "test views"
    where = "methods differ most" if len(methods) > 1 else "errors are largest"
    figure.suptitle(canvas.plain(f"{scene}: {what}; framed: where {where}"), fontsize=12)
    canvas.save(figure, path, bbox_inches="tight", pad_inches=0.1)


def _draw_row(
    axes: Any,
    truth: Path,
    entry: ImageEntry,
    methods: Sequence[ShownRun],
    labels: dict[str, str],
    *,
    errors: bool,
) -> Any:
    """Draw the photo, then each method with its PSNR. Returns the last error map.

    ``axes`` has a second row for what is enlarged, or one row for error maps.
    """
    photo, mask = load_image(truth, entry), scored_mask(truth, entry, methods[0].fitted)
    images = [load_image(run.folder, run.entries[entry.view]) for run in methods]
    maps = [mean_error(image, photo, mask) for image in images]
    window = where_methods_differ(maps)
    shown = None
    for axis, image, error in zip(axes[0, 1:], images, maps, strict=True):
        if errors:
            shown = axis.imshow(error, vmin=0, vmax=ERROR_RANGE, cmap="magma")
        else:
            axis.imshow(image)
        axis.set_xlabel(psnr_text(image, photo, mask), fontsize=9)
    axes[0, 0].imshow(photo)
    period = shorten(period_name(entry.camera_period, labels), 26)
    axes[0, 0].set_ylabel(canvas.plain(period), fontsize=10)
    axes[0, 0].set_xlabel(canvas.plain(entry.view), fontsize=8)
    for axis in axes[0]:
        axis.add_patch(_frame(window))
    for below in axes[1:]:
        for axis, image in zip(below, [photo, *images], strict=True):
            axis.imshow(image[window], interpolation="nearest")
            axis.spines[:].set_color(FRAME)
    for axis in axes.flat:
        axis.set_xticks([])
        axis.set_yticks([])
    return shown


def _frame(window: tuple[slice, slice]) -> Any:
    """Make a rectangle around pixels; matplotlib counts from the centre of the first one."""
    from matplotlib.patches import Rectangle

    (top, bottom), (left, right) = ((part.start, part.stop) for part in window)
    corner = left - 0.5, top - 0.5
    return Rectangle(corner, right - left, bottom - top, fill=False, edgecolor=FRAME, linewidth=1)


def where_methods_differ(errors: Sequence[Array]) -> tuple[slice, slice]:
    """Find the window, `WINDOW` wide and high, that shows most: its rows and columns.

    It has the largest sum of the variance of the error between methods, pixel by pixel; with one
    method, of its error.

    Args:
        errors: From `mean_error`, one per method; what is ignored counts as 0. [H, W] each
    """
    import cv2

    known = np.nan_to_num(np.stack(errors))
    differing = known.var(axis=0) if len(known) > 1 else known[0]
    h, w = (max(1, round(WINDOW * side)) for side in differing.shape)
    upto = cv2.integral(differing)
    sums = upto[h:, w:] - upto[:-h, w:] - upto[h:, :-w] + upto[:-h, :-w]
    y, x = (int(i) for i in np.unravel_index(sums.argmax(), sums.shape))
    return slice(y, y + h), slice(x, x + w)


def psnr_text(image: Pixels, photo: Pixels, mask: Mask | None) -> str:
    """Format the PSNR of a view; not scored where the mask ignores all of it."""
    if mask is not None and not mask.any():
        return "not scored"
    return f"{psnr(image, photo, mask):.2f} dB"


def mean_error(image: Pixels, photo: Pixels, mask: Mask | None = None) -> Array:
    """Average the absolute error over channels, 0..1; NaN where the mask ignores. [H, W]"""
    difference = image.astype(np.float64) - photo.astype(np.float64)
    error = np.abs(difference).mean(axis=2) / 255.0
    return error if mask is None else np.where(mask, error, np.nan)
