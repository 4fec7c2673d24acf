"""Images and points of scenes by period, laid out as in the paper's table of counts."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from chronoscene import __version__
from chronoscene.arrays import Ints
from chronoscene.io import tables
from chronoscene.io.tables import Head, Table
from chronoscene.scene import Scene
from chronoscene.scene.splits import split_hash

SCHEMA_VERSION = 1
CountRule = Literal["assigned", "seen"]
COUNT_RULES = ("assigned", "seen")

PAPER_COUNTS: Mapping[str, tuple[tuple[int, int], ...]] = {
    "Lawncourt": ((234, 85_655), (193, 57_884), (277, 117_595)),
    "Overstreet": ((83, 35_513), (295, 235_537), (208, 132_957)),
    "BioBuilding": ((258, 120_122), (240, 143_694), (258, 171_462)),
    "Canteen": ((340, 101_523), (183, 99_915), (279, 159_250)),
    "Incubator": ((202, 98_073), (199, 126_315), (194, 125_461)),
    "TriPlot": ((365, 150_896), (94, 50_081), (189, 106_937)),
    "Street1": ((200, 110_591), (200, 108_932), (200, 95_038), (200, 101_074)),
    "Street2": ((200, 108_621), (200, 112_293), (200, 101_061), (200, 110_714)),
    "Aerial1": ((200, 136_491), (200, 116_790), (200, 136_624), (200, 101_494)),
    "Aerial2": ((200, 116_443), (200, 115_481), (200, 109_213), (200, 116_434)),
    "Aerial3": ((200, 171_323), (200, 145_781), (200, 139_733), (200, 73_597)),
    "Aerial4": ((200, 144_446), (200, 133_058), (200, 129_169), (200, 92_044)),
}
"""Scene to (images, points) of each period as the paper prints them, real scenes first.

Source: table of counts in "ChronoGS: Disentangling Invariants and Changes in Multi-Period Scenes",
CVPR 2026 (arXiv 2511.18794). Facts only; nothing here was measured by us.
"""

_BY_NAME = {name.casefold(): name for name in PAPER_COUNTS}


@dataclass(frozen=True, slots=True)
class PeriodCount:
    """Counts of one period."""

    id: int
    label: str
    date: str | None
    images: int
    train: int
    test: int
    points: int


@dataclass(frozen=True, slots=True)
class SceneCount:
    """Counts of one scene."""

    name: str
    path: str
    format: str
    split_rule: str
    split_hash: str
    count: CountRule
    """Rule by which points are counted."""
    periods: tuple[PeriodCount, ...]
    images: int
    points: int
    """All points of the model, each once."""
    points_without_period: int
    """Points that no image sees; they are in `points` and in no period."""


@dataclass(frozen=True, slots=True)
class Unreadable:
    """A scene that is missing in the tables."""

    path: str
    error: str


def period_name(period: int, label: str, date: str | None) -> str:
    """Name a period by label, and date where the label lacks the year, else by number."""
    named = label if label != str(period) else ""
    dated = date if date is not None and date[:4] not in label else ""
    return ", ".join(filter(None, (named, dated))) or str(period)


def period_title(period: int, label: str, date: str | None) -> str:
    """Title a period by its number, and its name where that is more than the number."""
    name = period_name(period, label, date)
    return name if name == str(period) else f"{period}: {name}"


def assign_points(views: Ints) -> Ints:
    """Choose the period of each point: the one with the most observations of it.

    Ties go to the earliest period; -1 marks a point that no image sees. [P, T] -> [P]
    """
    if not views.size:
        return np.full(len(views), -1, np.int64)
    return np.where(views.any(axis=1), views.argmax(axis=1), -1)


def count_scene(
    scene: Scene, *, count: CountRule = "assigned", views: Ints | None = None
) -> SceneCount:
    """Count the images and points of a scene by period.

    Args:
        scene: The scene.
        count: ``assigned`` counts each point once, in the period that `assign_points` gives, so
            that the periods add up to the total; ``seen`` counts it in every period whose images
            see it.
        views: What `Scene.count_views` gives, where that is at hand. [P, T]
    """
    if count == "assigned":
        assigned = assign_points(scene.count_views() if views is None else views)
        by_period = np.bincount(assigned[assigned >= 0], minlength=scene.num_periods)
    else:
        by_period = scene.point_periods().sum(axis=0)
    return SceneCount(
        name=scene.name,
        path=str(scene.root),
        format=scene.format,
        split_rule=scene.split_rule,
        split_hash=split_hash(scene),
        count=count,
        periods=tuple(
            PeriodCount(
                id=period.id,
                label=period.label,
                date=period.date,
                images=len(scene.select(period=period.id)),
                train=len(scene.select(split="train", period=period.id)),
                test=len(scene.select(split="test", period=period.id)),
                points=int(points),
            )
            for period, points in zip(scene.periods, by_period, strict=True)
        ),
        images=len(scene.frames),
        points=len(scene.points),
        points_without_period=int((np.diff(scene.points.track_start) == 0).sum()),
    )


def count_table(counts: Sequence[SceneCount]) -> list[list[int | str | None]]:
    """List the rows of the table: scene, images and points of each period and in total.

    The last row holds the totals; None stands where a scene has no such period.
    """
    periods = max((len(c.periods) for c in counts), default=0)
    rows: list[list[int | None]] = []
    for scene in counts:
        cells: list[int | None] = [n for p in scene.periods for n in (p.images, p.points)]
        rows.append([*cells, *[None] * (2 * periods - len(cells)), scene.images, scene.points])
    empty = [0] * (2 * periods + 2)
    sums = [sum(cell or 0 for cell in column) for column in zip(empty, *rows, strict=True)]
    names = [*(scene.name for scene in counts), "Total"]
    return [[name, *cells] for name, cells in zip(names, [*rows, sums], strict=True)]


def _period_names(counts: Sequence[SceneCount]) -> list[str]:
    """List the heads of the column pairs; periods are numbered from 0."""
    periods = max((len(c.periods) for c in counts), default=0)
    return [*(f"Period {i}" for i in range(periods)), "Total"]


def _table(counts: Sequence[SceneCount], images: str, points: str) -> Table:
    """Make the table for readers."""
    heads: list[Head] = ["Scene"]
    for name in _period_names(counts):
        heads += [(name, images), ("", points)]
    rows = [
        [str(name), *("-" if number is None else f"{number:,}" for number in numbers)]
        for name, *numbers in count_table(counts)
    ]
    return Table(heads, rows, breaks={len(counts) - 1})


def format_counts(
    counts: Sequence[SceneCount],
    style: str,
    *,
    width: int | None = None,
    unreadable: Sequence[Unreadable] = (),
) -> str:
    """Format the table of counts in one of `chronoscene.io.tables.FORMATS`.

    CSV has empty cells where a scene has no such period; JSON has train and test images and the
    fingerprint of the split, too.

    Args:
        counts: One per scene.
        style: The format.
        width: Characters of the terminal that ``table`` goes to; None for no limit.
        unreadable: Scenes that are missing, named in JSON.
    """
    if style == "json":
        scenes = [asdict(c) | {"paper": compared(c)} for c in counts]
        return document(scenes, counts, unreadable)
    if style == "csv":
        heads = [name.lower().replace(" ", "_") for name in _period_names(counts)]
        columns = ["scene", *(f"{h}_{what}" for h in heads for what in ("images", "points"))]
        return tables.csv_text(columns, count_table(counts))
    names = ("Images", "Points") if style == "latex" else ("images", "points")
    return tables.text_of(_table(counts, *names), style, width=width, cmidrules=True)


def document(
    scenes: Sequence[dict[str, Any]], counts: Sequence[SceneCount], unreadable: Sequence[Unreadable]
) -> str:
    """Format JSON of scenes. Keys are only added; the version changes when one changes meaning."""
    data = {
        "schema_version": SCHEMA_VERSION,
        "chronoscene_version": __version__,
        "scenes": scenes,
        "totals": totals(counts),
        "unreadable": [asdict(u) for u in unreadable],
    }
    return json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def published(name: str) -> tuple[tuple[int, int], ...] | None:
    """Return images and points of each period as printed, if the paper has a scene of this name."""
    return PAPER_COUNTS.get(_BY_NAME.get(name.casefold(), ""))


def in_paper_order(folders: Sequence[Path]) -> list[Path]:
    """Sort the scenes of the paper as its table does, then all others in their order."""
    ranks = {name: rank for rank, name in enumerate(PAPER_COUNTS)}
    return sorted(folders, key=lambda p: ranks.get(_BY_NAME.get(p.name.casefold(), ""), len(ranks)))


def compared(count: SceneCount) -> dict[str, Any] | None:
    """Compare a scene with its counts in the paper; None for scenes that are not in it."""
    paper = published(count.name)
    if paper is None:
        return None
    return {
        "images": sum(images for images, _ in paper),
        "points": sum(points for _, points in paper),
        "periods": [{"images": images, "points": points} for images, points in paper],
        "same": [(p.images, p.points) for p in count.periods] == list(paper),
    }


def totals(counts: Sequence[SceneCount]) -> dict[str, Any]:
    """Sum images and points over all scenes, by period and in all."""
    _, *sums = count_table(counts)[-1]
    pairs = [{"images": sums[i], "points": sums[i + 1]} for i in range(0, len(sums), 2)]
    return {"periods": pairs[:-1], "all": pairs[-1]}
