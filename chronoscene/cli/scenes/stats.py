"""``chronoscene stats``: tables, figures and pages of scenes, by period."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import click

from chronoscene.cli.options import PATH, reading_options, refuse_options
from chronoscene.cli.output import (
    FORMAT,
    OUT_FILE,
    check_file,
    check_place,
    emit,
    report_written,
    say,
    terminal_width,
    writing_to,
)
from chronoscene.cli.progress import tracked
from chronoscene.errors import ChronoSceneError, SceneError
from chronoscene.formats import detect, find_scenes, nearby_scenes, read_scene
from chronoscene.io.processes import map_parallel
from chronoscene.io.staging import check_outside
from chronoscene.kernels.runtime import keep_freed_memory
from chronoscene.statistics.counts import (
    COUNT_RULES,
    CountRule,
    SceneCount,
    Unreadable,
    count_scene,
    format_counts,
    in_paper_order,
    published,
)
from chronoscene.statistics.details import format_details
from chronoscene.statistics.measures import SceneStatistics, measure_scene

Layout = Literal["full", "paper"]
FIGURE_FORMATS = ("png", "pdf", "svg")

SCENE_PARTS = ("sparse", "images")  # Folders that only scenes have

SOME_FAILED, ALL_FAILED = 1, 2
"""Exit status when scenes cannot be read."""


@dataclass(frozen=True, slots=True)
class StatsRequest:
    """Work to do for each scene."""

    dataset_format: str | None
    period_by: str | None
    count: CountRule
    layout: Layout
    figures: Path | None
    figure_format: str
    cameras: bool
    pages: Path | None

    def figure(self, name: str) -> Path | None:
        """Return the file of a figure; None if no figures are asked for."""
        return self.figures and self.figures / f"{name}.{self.figure_format}"

    def page(self, name: str) -> Path | None:
        """Return the file of a page; None if no pages are asked for."""
        return self.pages and self.pages / f"{name}.html"


@click.command("stats")
@click.argument("folders", nargs=-1, type=PATH, metavar="[DIR]...")
@click.option(
    "--layout",
    type=click.Choice(["full", "paper"]),
    default="full",
    help="full: everything that is measured, by period. paper: the table of images and points in "
    "the paper.",
)
@click.option(
    "--count",
    type=click.Choice(COUNT_RULES),
    default="assigned",
    help="How to count points. assigned: each once. seen: in every period whose images see it.",
)
@FORMAT
@OUT_FILE
@click.option(
    "--figures",
    type=PATH,
    metavar="OUT",
    help="Draw the counts of all scenes, and the points of each scene, into this folder.",
)
@click.option(
    "--figure-format",
    type=click.Choice(FIGURE_FORMATS),
    default="png",
    help="File format of the figures.",
)
@click.option("--cameras", is_flag=True, help="Also draw the cameras in the figures.")
@click.option(
    "--pages",
    type=PATH,
    metavar="OUT",
    help="Write an interactive page of each scene, for a browser, to this folder.",
)
@reading_options("the scenes")
@click.pass_context
def command(
    context: click.Context,
    folders: tuple[Path, ...],
    style: str,
    out: Path | None,
    **options: object,
) -> None:
    """Print the contents of scenes, by period.

    DIR is a scene or a folder of scenes; without one, the current folder is searched, then data/.
    The table has images, points, tracks, error, overlap and coverage; docs/guides/statistics.md
    defines them. Periods are numbered from 0; "-" means that there is nothing to measure.

    All periods of a scene share one point cloud, and the paper does not say how its table splits
    it. Here, each point is counted once, in the period with the most observations of it, the
    earliest of several; with --count seen, in every period that sees it.

    Scenes that cannot be read are named, the others are reported. Exit status: 0 if all scenes
    were read, 1 if some were, 2 if none was or the command is used wrongly.
    """
    request = StatsRequest(**options)  # type: ignore[arg-type]
    if request.cameras and request.figures is None:
        raise click.UsageError("--cameras needs --figures")
    if request.figures is None:
        refuse_options(("figure_format",), "without --figures")
    reading = {"format": request.dataset_format, "period_by": request.period_by}
    folders = folders or (nearby_scenes(**reading),)
    alone = len(folders) == 1
    paths = [p for f in folders for p in in_paper_order(_scenes(f, request, alone=alone))]
    _check_places(request, out, paths)
    items = list(zip(paths, _file_names(paths), strict=True))
    work = map_parallel(partial(examine, request), items, lost=_lost)
    results = list(tracked(work, "measure scenes", total=len(items)))
    unreadable = [r for r in results if isinstance(r, Unreadable)]
    full = [r for r in results if isinstance(r, SceneStatistics)]
    counts = [s.counts for s in full] or [r for r in results if isinstance(r, SceneCount)]
    if counts:
        extra: Any = {"width": terminal_width(out), "unreadable": unreadable}
        if full:
            text = format_details(full, style, **extra)
        else:
            text = format_counts(counts, style, **extra)
        emit(text, out)
        written = []
        if (bars := request.figure("counts")) is not None:
            from chronoscene.figures.bars import draw_bars

            with writing_to("--figures", bars):
                draw_bars(counts, bars)
            written = [bars]
        for (_, name), result in zip(items, results, strict=True):
            if not isinstance(result, Unreadable):
                written += filter(None, (request.figure(f"{name}_points"), request.page(name)))
        report_written(*written)
    notes = (f"{s.name}: {n}" for s in counts for n in detect(Path(s.path), format=s.format).notes)
    for remark in [*notes, *unseen(counts), *against_paper(counts)]:
        say(remark)
    for scene in unreadable:
        say(f"error: {scene.error}", fg="red")
    if unreadable:
        context.exit(SOME_FAILED if counts else ALL_FAILED)


def examine(
    request: StatsRequest, item: tuple[Path, str]
) -> SceneCount | SceneStatistics | Unreadable:
    """Read one scene, measure it, and draw what is asked for.

    Args:
        request: What to do.
        item: Folder of the scene, and the name of its figure and page.
    """
    path, name = item
    keep_freed_memory()  # arrays as large as the model come and go
    try:
        scene = read_scene(path, format=request.dataset_format, period_by=request.period_by)
    except ChronoSceneError as error:
        return Unreadable(str(path), str(error))
    except OSError as error:
        return Unreadable(str(path), f"{error.filename or path}: {error.strerror or error}")
    if (figure := request.figure(f"{name}_points")) is not None:
        from chronoscene.figures.cloud import cloud_of
        from chronoscene.figures.projections import draw_cloud

        with writing_to("--figures", figure):
            draw_cloud(cloud_of(scene), figure, cameras=request.cameras)
    if (page := request.page(name)) is not None:
        from chronoscene.figures.viewer import write_page

        with writing_to("--pages", page):
            write_page(scene, page)
    if request.layout == "paper":
        return count_scene(scene, count=request.count)
    return measure_scene(scene, count=request.count)


def _scenes(folder: Path, request: StatsRequest, *, alone: bool) -> list[Path]:
    """Find the scenes of a folder, and folders that look like one, so that none is overlooked.

    A folder without a scene is an error if it is alone; of several, it is returned itself, and the
    attempt to read it fails.
    """
    try:
        scenes = find_scenes(folder, format=request.dataset_format, period_by=request.period_by)
    except SceneError:
        if alone:
            raise
        return [folder]
    found = [scene.path for scene in scenes]
    if found == [folder]:
        return found
    beside = {p for name in SCENE_PARTS for p in folder.glob(f"*/{name}") if p.is_dir()}
    return sorted({*found, *(p.parent for p in beside)})


def _lost(item: tuple[Path, str]) -> Unreadable:
    cause = "the process died; if memory ran out, run stats on this scene alone"
    return Unreadable(str(item[0]), f"{item[0]}: {cause}")


def _file_names(paths: Sequence[Path]) -> list[str]:
    """Name the files of scenes, numbered where folders have the same name."""
    names: list[str] = []
    for path in paths:
        folder = path.resolve().name or "scene"
        plain = "".join(c if c.isprintable() else "_" for c in folder)
        name, number = plain, 1
        while name in names:
            number += 1
            name = f"{plain}_{number}"
        names.append(name)
    return names


def _check_places(request: StatsRequest, out: Path | None, paths: Sequence[Path]) -> None:
    """Make the folders for figures and pages; refuse to write into a scene."""
    check_file("--out", out, outside=paths)
    for option, place in (("--figures", request.figures), ("--pages", request.pages)):
        if place is not None:
            check_outside(place, paths, option=option)
            with writing_to(option, place, expected="a folder that can be made"):
                place.mkdir(parents=True, exist_ok=True)
            check_place(option, place)


def unseen(counts: Sequence[SceneCount]) -> Iterator[str]:
    """Yield notes on points that no image sees."""
    for scene in counts:
        if scene.points_without_period:
            number = scene.points_without_period
            yield (
                f"{scene.name}: {number:,} {'point is' if number == 1 else 'points are'} seen by "
                "no image: in the total, and in no period"
            )


def against_paper(counts: Sequence[SceneCount]) -> Iterator[str]:
    """Yield notes on scenes with names of the paper: equal and different counts."""
    same = []
    for scene in counts:
        paper = published(scene.name)
        if paper is None:
            continue
        here = [(p.images, p.points) for p in scene.periods]
        if here == list(paper):
            same.append(scene.name)
        else:
            yield f"{scene.name}: {_difference(scene, paper)}"
    if same:
        yield f"images and points of all periods are those of the paper: {', '.join(same)}"


def _difference(scene: SceneCount, paper: Sequence[tuple[int, int]]) -> str:
    images, points = ([row[i] for row in paper] for i in (0, 1))
    if [p.images for p in scene.periods] == images and scene.points == sum(points):
        return (
            "images of all periods and points in all are those of the paper, which does not say "
            f"how it splits points into periods: it has {_listed(points)}"
        )
    return (
        f"the paper has {_listed(images)} images and {_listed(points)} points in the periods of "
        "its scene of this name"
    )


def _listed(numbers: Sequence[int]) -> str:
    return " + ".join(f"{n:,}" for n in numbers)
