"""``chronoscene changes``: where the periods of a finished run differ."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import click
import numpy as np

from chronoscene.cli.options import DEVICE, PATH, PLUGIN, RUN, SCENE, OneOfSeveral
from chronoscene.cli.output import emit, report_written, say, terminal_width
from chronoscene.cli.progress import tracked
from chronoscene.errors import ConfigError
from chronoscene.figures.canvas import short_name
from chronoscene.figures.change_map import ChangePanel, colors_of, draw_changes
from chronoscene.figures.cloud import cloud_of
from chronoscene.formats.shared.ply import write_vertices
from chronoscene.harness.use.change_scores import changes_csv, changes_table, map_run
from chronoscene.harness.use.changes import ALL_PAIRS, ChangeMap, usual_pairs
from chronoscene.harness.use.trained_run import open_run
from chronoscene.io.staging import check_outside, staged_folder
from chronoscene.io.tables import boxed_text
from chronoscene.scene.orbit import find_up

TITLE = 42  # Letters of both labels that fit above a map
BETWEEN = click.option(
    "--between",
    type=OneOfSeveral(),
    nargs=2,
    multiple=True,
    metavar="PERIOD PERIOD",
    help="Compare these two periods (numbers or labels); may be repeated.  [default: all pairs of "
    f"up to {ALL_PAIRS} periods; of more, each with the next]",
)


@click.command("changes")
@RUN
@click.option(
    "--out",
    type=PATH,
    required=True,
    help="New folder for the point clouds, the picture and the table.",
)
@BETWEEN
@SCENE
@PLUGIN
@DEVICE
def command(
    folder: Path,
    out: Path,
    between: tuple[tuple[str, str], ...],
    scene: Path | None,
    device: str,
    plugin: tuple[str, ...],
) -> None:
    """Map what changes between the periods of a finished run.

    OUT gets a point cloud (PLY) with scores and colours for each pair of periods, a picture of all
    pairs from above, and a table (CSV). If gt/ of the scene has change masks, the map is scored
    with them and compared with differences of images. docs/guides/changes.md explains the
    scores.
    """
    run = open_run(folder, device=device, plugin=plugin)
    labels = [run.record.period_labels[str(period)] for period in range(run.num_periods)]
    pairs = parse_pairs(labels, between) or usual_pairs(run.num_periods)
    if not pairs:
        raise ConfigError(
            folder,
            expected="a run of two periods or more",
            found="one period",
            todo="open another run",
        )
    found = run.scene(scene)
    check_outside(out, [found.root], option="--out")
    with staged_folder(out) as staged:
        maps = list(tracked(map_run(run, found, pairs), "compare periods", total=len(pairs)))
        for made, _ in maps:
            _write_cloud(staged / "changes_{}_{}.ply".format(*made.periods), made)
        (staged / "changes.csv").write_text(changes_csv(maps), encoding="utf-8", newline="\n")
        panels = [_panel(made, run.record.period_labels) for made, _ in maps]
        up = find_up(found.frame_poses)
        draw_changes(cloud_of(found), panels, staged / "changes.png", up=up)
    table = changes_table(maps, run.record.period_labels, run.record.label)
    emit(boxed_text(table, width=terminal_width()))
    if (sharing := run.record.sharing) is not None:
        unit, count = run.record.primitive, sum(sharing.blocks)
        emit(
            f"the model has one block of features for all periods in "
            f"{100 * sharing.invariant_share:.1f} % of its {count:,} {unit}, and "
            f"{sharing.mean_blocks:.2f} of {len(sharing.blocks)} on average\n"
        )
    report_written(out)
    if not any(scores for _, scores in maps):
        say(f"not scored: no change masks of test views in {found.root / 'gt'}")


def parse_pairs(labels: Sequence[str], between: Iterable[Sequence[str]]) -> list[tuple[int, int]]:
    """Parse all values of ``--between`` as `parse_pair` does, each pair once."""
    return list(dict.fromkeys(parse_pair(labels, names) for names in between))


def parse_pair(labels: Sequence[str], names: Sequence[str]) -> tuple[int, int]:
    """Parse two periods, by numbers or labels; the earlier comes first.

    Args:
        labels: Of all periods.
        names: Values of the option ``--between``.

    Raises:
        ConfigError: If one is unknown, or they are equal, or several periods have a label.
    """
    if shared := [name for name in names if labels.count(name) > 1]:
        raise ConfigError(
            f"--between {' '.join(names)}",
            expected="labels of one period each",
            found=f"{shared[0]!r}, the label of several",
            todo="name them by their numbers",
        )
    known = {str(i): i for i in range(len(labels))} | {label: i for i, label in enumerate(labels)}
    first, second = sorted(known.get(name, -1) for name in names)
    if first < 0 or first == second:
        raise ConfigError(
            f"--between {' '.join(names)}",
            expected="two periods of the scene",
            found="an unknown one" if first < 0 else "the same one twice",
            todo=f"choose among {', '.join(f'{i} ({name})' for i, name in enumerate(labels))}",
        )
    return first, second


def _write_cloud(path: Path, made: ChangeMap) -> None:
    """Places with the colours of their classes, scores, and the period of their surface."""
    write_vertices(
        path,
        made.xyz,
        colors_of(made.classes),
        geometry=made.geometry.astype(np.float32),
        appearance=made.appearance.astype(np.float32),
        known=made.known.astype(np.uint8),
        period=np.where(made.later, *made.periods[::-1]).astype(np.int32),
    )


def _panel(made: ChangeMap, labels: Mapping[str, str]) -> ChangePanel:
    names = [labels[str(period)] for period in made.periods]
    if sum(map(len, names)) > TITLE:  # numbers tell apart what begins alike
        shown = zip(made.periods, names, strict=True)
        names = [short_name(f"{period}: {name}", TITLE // 2) for period, name in shown]
    title = " \N{RIGHTWARDS ARROW} ".join(names)
    return ChangePanel(title, made.xyz, made.classes)
