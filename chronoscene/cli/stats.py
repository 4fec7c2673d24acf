"""``chronoscene stats``: what is in scenes, by period: tables, figures and pages."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import click

from chronoscene.cli.output import emit, writing_to
from chronoscene.cli.progress import tracked
from chronoscene.errors import ConfigError
from chronoscene.formats import find_scenes, format_names, read_scene
from chronoscene.parallel import map_parallel
from chronoscene.stats import (
    COUNT_RULES,
    DETAIL_WRITERS,
    WRITERS,
    CountRule,
    SceneCount,
    SceneStatistics,
    count_scene,
    measure_scene,
)

Layout = Literal["full", "paper"]
FIGURE_FORMATS = ("png", "pdf", "svg")


@dataclass(frozen=True, slots=True)
class Request:
    """What to do with each scene."""

    dataset_format: str | None
    count: CountRule
    layout: Layout
    figures: Path | None
    figure_format: str
    cameras: bool
    pages: Path | None


@click.command("stats")
@click.argument(
    "folders", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="DIR..."
)
@click.option(
    "--layout",
    type=click.Choice(["full", "paper"]),
    default="full",
    show_default=True,
    help="full: all that is measured, by period; paper: the paper's table of images and points.",
)
@click.option(
    "--count",
    type=click.Choice(COUNT_RULES),
    default="assigned",
    show_default=True,
    help="assigned: each point once; seen: in every period whose images see it.",
)
@click.option(
    "--format",
    "output_format",
    type=click.Choice(sorted(WRITERS)),
    default="table",
    show_default=True,
    help="What to write.",
)
@click.option("--out", type=click.Path(path_type=Path), help="Write to this file instead.")
@click.option(
    "--figures",
    type=click.Path(path_type=Path),
    metavar="OUT",
    help="Draw images and points of all scenes, and the points of each, into this folder.",
)
@click.option(
    "--figure-format",
    type=click.Choice(FIGURE_FORMATS),
    default="png",
    show_default=True,
    help="Of the figures.",
)
@click.option("--cameras", is_flag=True, help="Cameras in the figures, too.")
@click.option(
    "--pages",
    type=click.Path(path_type=Path),
    metavar="OUT",
    help="Write a page for the browser into this folder, one per scene, to look around in it.",
)
@click.option(
    "--dataset-format",
    type=click.Choice(format_names()),
    help="Format of the scenes.  [default: found out]",
)
def command(
    folders: tuple[Path, ...], output_format: str, out: Path | None, **options: object
) -> None:
    """What is in a scene, by period: images, points, tracks, error, overlap, coverage.

    DIR is a scene, or a folder of scenes. Periods are numbered from 0; "-" stands where there is
    nothing to measure.

    The point cloud of a scene is one for all periods, and the paper does not say how its table
    splits it. As its periods add up to the total, each point is counted once: in the period with
    the most observations of it, the earliest of several. A point may be seen in several periods;
    --count seen counts it in each, and then the periods add up to more than the total.

    Tracks and observations of a period are those of its images. The error is the mean distance
    between observation and projection. The baseline is the distance from a camera to the nearest
    of its period, relative to the median depth of what it sees. Coverage is the share of the space
    with points in which a period sees some. "Also seen by" is the share of the points of a period
    that another one sees, too.
    """
    request = Request(**options)  # type: ignore[arg-type]
    paths = [p for f in folders for p in find_scenes(f, format=request.dataset_format)]
    _check_places(request, paths)
    items = list(zip(paths, _file_names(paths), strict=True))
    work = map_parallel(partial(examine, request), items)
    results = list(tracked(work, "scenes", total=len(items)))
    counts = [r if isinstance(r, SceneCount) else r.counts for r in results]
    full = [r for r in results if isinstance(r, SceneStatistics)]
    text = WRITERS[output_format](counts) if not full else DETAIL_WRITERS[output_format](full)
    emit(text, out)
    if request.figures is not None:
        from chronoscene.figures.bars import draw_bars

        bars = request.figures / f"counts.{request.figure_format}"
        with writing_to("--figures", bars):
            draw_bars(counts, bars)
    _remark_on_unseen(counts)


def examine(request: Request, item: tuple[Path, str]) -> SceneCount | SceneStatistics:
    """Read one scene, measure it, and draw what is asked for.

    Args:
        request: What to do.
        item: Folder of the scene, and the name of its figure and page.
    """
    path, name = item
    scene = read_scene(path, format=request.dataset_format)
    if request.figures is not None:
        from chronoscene.figures.projections import draw_projections

        target = request.figures / f"{name}_points.{request.figure_format}"
        with writing_to("--figures", target):
            draw_projections(scene, target, cameras=request.cameras)
    if request.pages is not None:
        from chronoscene.figures.page import write_page

        page = request.pages / f"{name}.html"
        with writing_to("--pages", page):
            write_page(scene, page)
    if request.layout == "paper":
        return count_scene(scene, count=request.count)
    return measure_scene(scene, count=request.count)


def _file_names(paths: Sequence[Path]) -> list[str]:
    """Names of the scenes, numbered where folders of several places have the same name."""
    names: list[str] = []
    for path in paths:
        name, number = path.resolve().name or "scene", 1
        while name in names:
            number += 1
            name = f"{path.resolve().name}_{number}"
        names.append(name)
    return names


def _check_places(request: Request, paths: Iterable[Path]) -> None:
    """Make the folders for figures and pages; refuse to write into a scene."""
    for option, place in (("--figures", request.figures), ("--pages", request.pages)):
        if place is None:
            continue
        if any(place.resolve().is_relative_to(path.resolve()) for path in paths):
            raise ConfigError(
                f"{option} {place}",
                expected="a folder outside of the scenes",
                found="one inside",
                todo="choose another place: nothing is written into a dataset",
            )
        with writing_to(option, place, expected="a folder that can be made"):
            place.mkdir(parents=True, exist_ok=True)


def _remark_on_unseen(counts: list[SceneCount]) -> None:
    for scene in counts:
        if scene.points_without_period:
            click.echo(
                f"{scene.name}: {scene.points_without_period} points are seen by no image; "
                "they count in the total and in no period",
                err=True,
            )
