"""Images and points of scenes by period, laid out as in the paper's table of counts."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from chronoscene import __version__
from chronoscene.io import tables
from chronoscene.io.tables import Table
from chronoscene.scene import Scene
from chronoscene.scene.splits import split_hash
from chronoscene.stats.published import published

SCHEMA_VERSION = 1
CountRule = Literal["assigned", "seen"]
COUNT_RULES = ("assigned", "seen")


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
    """How points are counted."""
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
    """Its label, and its date where the label lacks the year; the number if there is neither."""
    names = [label] if label != str(period) else []
    if date is not None and date[:4] not in label:
        names.append(date)
    return ", ".join(names) or str(period)


def period_title(period: int, label: str, date: str | None) -> str:
    """Its number, and its name where that is more than the number."""
    name = period_name(period, label, date)
    return name if name == str(period) else f"{period}: {name}"


def assign_points(scene: Scene) -> NDArray[np.int64]:
    """The one period that each point is counted in: that with the most observations of it.

    Ties go to the earliest period; -1 marks a point that no image sees. [P]
    """
    counts = scene.count_views()
    if not counts.size:
        return np.full(len(counts), -1, np.int64)
    return np.where(counts.any(axis=1), counts.argmax(axis=1), -1)


def count_scene(scene: Scene, *, count: CountRule = "assigned") -> SceneCount:
    """Count the images and points of a scene by period.

    Args:
        scene: The scene.
        count: ``assigned`` counts each point once, in the period that `assign_points` gives, so
            that the periods add up to the total; ``seen`` counts it in every period whose images
            see it.
    """
    if count == "assigned":
        assigned = assign_points(scene)
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
        periods=tuple(_count_period(scene, i, int(n)) for i, n in enumerate(by_period)),
        images=len(scene.frames),
        points=len(scene.points),
        points_without_period=int((np.diff(scene.points.track_start) == 0).sum()),
    )


def _count_period(scene: Scene, period: int, points: int) -> PeriodCount:
    info = scene.periods[period]
    train = len(scene.select(split="train", period=period))
    test = len(scene.select(split="test", period=period))
    return PeriodCount(period, info.label, info.date, train + test, train, test, points)


def count_table(counts: Sequence[SceneCount]) -> list[list[int | str | None]]:
    """Rows of the table: scene, images and points of each period, images and points in total.

    The last row holds the totals; None stands where a scene has no such period.
    """
    periods = max((len(c.periods) for c in counts), default=0)
    rows: list[list[int | str | None]] = []
    sums = [0] * (2 * periods + 2)
    for scene in counts:
        cells: list[int | None] = []
        for period in scene.periods:
            cells += [period.images, period.points]
        cells += [None] * (2 * periods - len(cells)) + [scene.images, scene.points]
        sums = [total + (cell or 0) for total, cell in zip(sums, cells, strict=True)]
        rows.append([scene.name, *cells])
    return [*rows, ["Total", *sums]]


def _period_names(counts: Sequence[SceneCount]) -> list[str]:
    """Heads of the column pairs; periods are numbered from 0."""
    periods = max((len(c.periods) for c in counts), default=0)
    return [*(f"Period {i}" for i in range(periods)), "Total"]


def _table(counts: Sequence[SceneCount], images: str = "images", points: str = "points") -> Table:
    """The table as it is read."""

    def text(cell: int | str | None) -> str:
        if cell is None:
            return "-"
        return cell if isinstance(cell, str) else f"{cell:,}"

    heads = [("Scene", "")]
    for name in _period_names(counts):
        heads += [(name, images), ("", points)]
    rows = [list(map(text, row)) for row in count_table(counts)]
    return Table(heads, rows, breaks={len(counts) - 1})


def to_csv(counts: Sequence[SceneCount]) -> str:
    """Wide table; empty cells where a scene has no such period."""
    heads = [name.lower().replace(" ", "_") for name in _period_names(counts)]
    columns = ["scene", *(f"{h}_{what}" for h in heads for what in ("images", "points"))]
    return tables.csv_text(columns, count_table(counts))


def to_markdown(counts: Sequence[SceneCount]) -> str:
    """Pipe table with one head row."""
    return tables.markdown(_table(counts))


def to_latex(counts: Sequence[SceneCount]) -> str:
    """A ``tabular`` for the booktabs package."""
    return tables.latex(_table(counts, "Images", "Points"), cmidrules=True)


def to_json(counts: Sequence[SceneCount], *, unreadable: Sequence[Unreadable] = ()) -> str:
    """Everything that was counted, with train and test images and the split's fingerprint."""
    return document([asdict(c) | {"paper": compared(c)} for c in counts], counts, unreadable)


def document(
    scenes: Sequence[dict[str, Any]],
    counts: Sequence[SceneCount],
    unreadable: Sequence[Unreadable],
) -> str:
    """JSON of some scenes. Keys are only added; the version changes when one changes meaning."""
    data = {
        "schema_version": SCHEMA_VERSION,
        "chronoscene_version": __version__,
        "scenes": scenes,
        "totals": totals(counts),
        "unreadable": [asdict(u) for u in unreadable],
    }
    return json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def compared(count: SceneCount) -> dict[str, Any] | None:
    """The counts that the paper prints for a scene, and whether these are the same; None for
    scenes that are not in it."""
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
    """Images and points over all scenes, by period and in all."""
    _, *sums = count_table(counts)[-1]
    pairs = [{"images": sums[i], "points": sums[i + 1]} for i in range(0, len(sums), 2)]
    return {"periods": pairs[:-1], "all": pairs[-1]}


def to_text(counts: Sequence[SceneCount], *, width: int | None = None) -> str:
    """Table for a terminal of this width, without colours; None for as wide as it is."""
    return tables.boxed_text(_table(counts), width=width)


WRITERS: dict[str, Callable[..., str]] = {
    "table": to_text,
    "csv": to_csv,
    "markdown": to_markdown,
    "latex": to_latex,
    "json": to_json,
}
"""Output format to the function that writes it. ``table`` takes a ``width``, ``json`` the scenes
that are ``unreadable``."""
