"""``chronoscene stats``: images and points by scene and period."""

from __future__ import annotations

from pathlib import Path

import click

from chronoscene.cli.output import emit
from chronoscene.formats import find_scenes, format_names, read_scene
from chronoscene.stats import COUNT_RULES, WRITERS, CountRule, SceneCount, count_scene


@click.command("stats")
@click.argument(
    "folders", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="DIR..."
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
    "--dataset-format",
    type=click.Choice(format_names()),
    help="Format of the scenes.  [default: found out]",
)
def command(
    folders: tuple[Path, ...],
    count: CountRule,
    output_format: str,
    out: Path | None,
    dataset_format: str | None,
) -> None:
    """Images and points by scene and period, with totals.

    DIR is a scene, or a folder of scenes. Periods are numbered from 0; "-" stands where a scene
    has fewer periods.

    The point cloud of a scene is one for all periods, and the paper does not say how its table
    splits it. As its periods add up to the total, each point is counted once: in the period with
    the most observations of it, the earliest of several. A point may be seen in several periods;
    --count seen counts it in each, and then the periods add up to more than the total.
    """
    scenes = [path for folder in folders for path in find_scenes(folder, format=dataset_format)]
    counts = [count_scene(read_scene(p, format=dataset_format), count=count) for p in scenes]
    emit(WRITERS[output_format](counts), out)
    _remark_on_unseen(counts)


def _remark_on_unseen(counts: list[SceneCount]) -> None:
    for scene in counts:
        if scene.points_without_period:
            click.echo(
                f"{scene.name}: {scene.points_without_period} points are seen by no image; "
                "they count in the total and in no period",
                err=True,
            )
