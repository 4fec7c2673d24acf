"""``chronoscene triangulate``: sparse points for a scene with known poses."""

from __future__ import annotations

from pathlib import Path

import click

from chronoscene.cli.options import LINK, PATH, reading_options
from chronoscene.cli.output import check_place, emit, showing_notes
from chronoscene.cli.progress import progress_bar
from chronoscene.cli.scenes.reading import LINKS, describe, show_note
from chronoscene.convert import obstacles, remarks_on
from chronoscene.formats import chronoscene as our_format
from chronoscene.formats import detect
from chronoscene.registration.output import copy_records
from chronoscene.registration.triangulation import Triangulated, triangulate


@click.command("triangulate")
@click.argument("source", type=PATH, metavar="SCENE")
@click.argument("out", type=PATH)
@click.option(
    "--threads",
    type=click.IntRange(1),
    help="With 1, every run gives bit-identical results.  [default: one per processor]",
)
@LINK
@reading_options("SCENE")
def command(
    source: Path,
    out: Path,
    threads: int | None,
    link: str | None,
    dataset_format: str | None,
    period_by: str | None,
) -> None:
    """Triangulate sparse points at the poses of a scene.

    For scenes with poses but without points, which methods start from. Photos of all periods are
    matched by their SIFT features. OUT is a new folder in the ChronoScene format; SCENE is not
    changed. Poses, cameras, periods and split stay; points that SCENE has are replaced. The same
    command continues a run that was stopped.
    """
    check_place("OUT", out, outside=[source])
    with showing_notes(), progress_bar(f"read {source}") as report:
        detected = detect(source, format=dataset_format, period_by=period_by)
        scene = detected.read()
        place = our_format.MODEL if detected.name == our_format.NAME else None
        if detected.model is not None and detected.is_by_names:
            place = detected.model[0]
        done = triangulate(
            scene,
            out,
            threads=threads,
            image_source=LINKS[link],
            model=None if place is None else source / place,
            report=report,
        )
    copied = copy_records(scene, out)
    emit(summary(done, out))
    for note in (*detected.notes, *remarks_on(scene, copied), *obstacles(done.scene)):
        show_note(note)


def summary(done: Triangulated, out: Path) -> str:
    """Counts and errors, for people."""
    scene = done.scene
    points = scene.points
    seen = (scene.count_views() > 0).sum(axis=0)
    lines = [f"{out}: {describe(scene)}"]
    lines += [f"  period {p.title}: sees {seen[p.id]} points" for p in scene.periods]
    lines.append(
        f"{done.agreeing} of {done.matches} matches in {done.pairs} pairs agree with the poses"
    )
    lines.append(
        f"{len(points.track_frame) / len(points):.1f} observations a point; reprojection error "
        f"{points.error.mean():.2f} px"
    )
    return "\n".join(lines) + "\n"
