"""The public interface of ChronoScene in Python; ``import chronoscene as cs`` has all of it.

docs/guides/python-api.md shows it on a scene. Everything else in the package may change from one
version to the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from chronoscene.bench.use.trained_run import TrainedRun, open_run
from chronoscene.checks import check_choice
from chronoscene.errors import ChronoSceneError, SceneError
from chronoscene.formats import read_scene
from chronoscene.scene import Camera, Frame, Scene
from chronoscene.stats.counts import COUNT_RULES, CountRule
from chronoscene.stats.measures import measure_scene
from chronoscene.validation.rule import SceneReport
from chronoscene.validation.rules import choose_rules
from chronoscene.validation.run import Reading, find_folders, validate_scene

if TYPE_CHECKING:
    from pandas import DataFrame, Series

__all__ = [
    "Camera",
    "ChronoSceneError",
    "Frame",
    "Scene",
    "SceneReport",
    "Statistics",
    "TrainedRun",
    "open_run",
    "read_scene",
    "statistics",
    "validate",
]


def validate(
    path: str | Path,
    *,
    select: Sequence[str] = (),
    ignore: Sequence[str] = (),
    decode: bool = False,
    format: str | None = None,
    period_by: str | None = None,
) -> SceneReport:
    """Check a scene folder as ``chronoscene validate`` does. Writes nothing.

    Args:
        path: Folder of one scene.
        select: Codes or names of the rules to run, such as ``CS201``, ``CS3`` or ``split-line``;
            all if empty.
        ignore: Rules not to run.
        decode: Decode all images, which finds damaged and duplicate ones but takes time.
        format: Name of the dataset format; None to detect it.
        period_by: Grouping of images into periods, for formats with a choice.

    Returns:
        The report; ``report.is_valid`` is true if there are no errors.

    Raises:
        SceneError: If there is no scene in the folder, or several.
        ConfigError: If a rule, the format or the grouping is unknown.

    Example:
        >>> report = validate("data/plaza")
        >>> [f"{f.code} {f}" for f in report.findings if f.severity == "error"]
    """
    path = Path(path)
    rules = choose_rules(select, ignore)
    if (found := find_folders(path)) != [path]:
        raise SceneError(
            path,
            expected="the folder of one scene",
            found=f"a folder of {len(found)} scenes",
            todo="validate them one by one",
        )
    return validate_scene(path, rules=rules, decode=decode, reading=Reading(format, period_by))


@dataclass(frozen=True, slots=True, eq=False)
class Statistics:
    """Contents of a scene as pandas tables. Made by `statistics`."""

    periods: DataFrame
    """One row per period: ``label``, ``date``, ``images``, ``train``, ``test``, ``points`` and the
    fields of `chronoscene.stats.measures.Measures`. NaN or None if there is nothing to measure."""
    whole: Series
    """The same quantities of the whole scene."""
    overlap: DataFrame
    """Share of the points seen in a period (row) that another one (column) sees, too. 0..1"""
    in_view: DataFrame
    """Share of the points seen in a period (row) that lie in view of the cameras of another one
    (column). 0..1"""
    unit: str
    """Unit of the world: ``metre`` or ``unknown``."""


def statistics(
    scene: Scene | str | Path,
    *,
    count: CountRule = "assigned",
    format: str | None = None,
    period_by: str | None = None,
) -> Statistics:
    """Measure a scene as ``chronoscene stats`` does.

    Args:
        scene: A scene, or the folder of one.
        count: ``assigned`` counts each point once, in the period with most observations of it;
            ``seen`` counts it in every period whose images see it.
        format: Name of the dataset format of a folder; None to detect it.
        period_by: Grouping of images into periods, for formats with a choice.

    Raises:
        SceneError: If the folder cannot be read.
        ConfigError: If an argument has an unknown value.

    Example:
        >>> statistics("data/plaza").periods[["images", "points", "track_mean"]]
    """
    import pandas as pd

    check_choice("count", count, COUNT_RULES)
    if not isinstance(scene, Scene):
        scene = read_scene(scene, format=format, period_by=period_by)
    found = measure_scene(scene, count=count)
    counts = [asdict(period) for period in found.counts.periods]
    measures = [asdict(measured) for measured in found.periods]
    rows = [a | b for a, b in zip(counts, measures, strict=True)]
    periods = pd.DataFrame(rows).set_index("id").rename_axis("period")
    sums = {name: sum(row[name] for row in counts) for name in ("images", "train", "test")}
    return Statistics(
        periods=periods,
        whole=pd.Series({**sums, "points": found.counts.points, **asdict(found.whole)}),
        overlap=_between(periods, found.overlap),
        in_view=_between(periods, found.in_view),
        unit=found.unit,
    )


def _between(periods: DataFrame, shares: Sequence[Sequence[float | None]]) -> DataFrame:
    """Return a table of all pairs of periods."""
    import pandas as pd

    return pd.DataFrame(shares, periods.index, periods.index, dtype=float)
