"""Statistics of scenes: counts by period, geometry, overlap of the periods."""

from __future__ import annotations

from chronoscene.stats.counts import (
    COUNT_RULES,
    WRITERS,
    CountRule,
    PeriodCount,
    SceneCount,
    Unreadable,
    assign_points,
    count_scene,
    count_table,
    to_csv,
    to_json,
    to_latex,
    to_markdown,
    to_text,
)
from chronoscene.stats.details import DETAIL_WRITERS
from chronoscene.stats.measures import Measures, SceneStatistics, measure_scene

__all__ = [
    "COUNT_RULES",
    "DETAIL_WRITERS",
    "WRITERS",
    "CountRule",
    "Measures",
    "PeriodCount",
    "SceneCount",
    "SceneStatistics",
    "Unreadable",
    "assign_points",
    "count_scene",
    "count_table",
    "measure_scene",
    "to_csv",
    "to_json",
    "to_latex",
    "to_markdown",
    "to_text",
]
